"""Do lenses and clocks as given agree with the data? What they would be if they were unknown, from one linearisation.

At the solution the reduced camera system is built with a column for every parameter of every camera. Any choice of parameters,
own or shared, is then a small system in which the others are held, and the decrease of the cost that it promises says how much
the data want it.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from torchstickcal.model.measurements import Measurements, State
from torchstickcal.model.noise import residual_correlation
from torchstickcal.model.unknowns import REFINEMENTS, CameraUnknowns
from torchstickcal.solvers.elimination.normal_equations import NormalEquations
from torchstickcal.solvers.uncertainty import normal_objective

_EVERY = ("focal", "principal_point", "radial", "time_offset", "readout")
_CHOICES = (
    ("time_offset",),
    ("readout",),
    ("time_offset", "readout"),
    ("focal_shared",),
    ("focal",),
    ("radial",),
    ("principal_point",),
    ("focal_shared", "radial"),
    ("focal", "radial"),
    ("focal_shared", "principal_point"),
    ("focal", "principal_point"),
    ("focal_shared", "principal_point", "radial"),
    ("focal", "principal_point", "radial"),
)
_SIGMAS = 4.0
_LEAST_EVIDENCE = 1e-6
_PRICE = 4.0
"""What a further parameter has to lower the cost by, a standard deviation's being 1: chance gives 1 each."""


class FocalCheck(NamedTuple):
    """Each camera's focal length as the data have it, all else of the lenses being as it is."""

    ratio: Tensor
    """(C,), over the one in use"""
    std: Tensor
    """(C,), of the ratio"""


class ClockCheck(NamedTuple):
    """When each camera looks as the data have it, all else being as it is."""

    late_frames: Tensor
    """(C,), how much later than reckoned with, against the first camera"""
    std: Tensor
    """(C,), zero for the first camera"""


class CameraCheck:
    """One session's cameras at a solution, looked at as if their lenses and clocks were unknown.

    Args:
        measurements: those that took part, with their motion.
        state: the solution.
        sigma_px: noise of each point's keypoints, (1, P).
        sigma_length_m: how well the sticks' lengths hold.
        groups: a label for each camera; those with the same share what is shared.
    """

    def __init__(
        self, measurements: Measurements, state: State, sigma_px: Tensor, sigma_length_m: float | Tensor, groups: Sequence[str]
    ) -> None:
        in_use, motion = measurements.cameras_at(state).to(torch.float64), measurements.motion
        assert motion is not None
        self._cameras, self._groups = in_use, groups
        self._every = CameraUnknowns.of(_EVERY, in_use)
        looked_at = replace(
            measurements,
            pixels=measurements.pixels_at(state),
            cameras=in_use,
            unknowns=self._every,
            motion=motion._replace(reckoned=torch.zeros_like(self._every.prior_sigma)),
        )
        objective = normal_objective(looked_at, sigma_px, sigma_length_m)
        system = NormalEquations(objective, replace(state, unknowns=None), cameras_free=True)
        self._information, self._gradient = system.reduced[0], system.reduced_gradient[0]
        correlation = residual_correlation(measurements, state, sigma_px)
        self._evidence = (1 - correlation) / (1 + correlation)

    def focal(self) -> FocalCheck:
        """The focal lengths, each camera's on its own."""
        values, covariance = self._solved(("focal",))
        return FocalCheck(values.exp(), covariance.diagonal().sqrt())

    def clocks(self) -> ClockCheck:
        """The clocks, each camera's on its own but the first's."""
        values, covariance = self._solved(("time_offset",))
        late, std = (torch.nn.functional.pad(own, (1, 0)) for own in (values, covariance.diagonal().sqrt()))
        return ClockCheck(late, std)

    def wanted(
        self, allowed: Collection[str], refined: Sequence[str] = (), failed: Sequence[tuple[str, ...]] = ()
    ) -> tuple[str, ...]:
        """The refinements that the data call for beside those made; none where the cameras in use agree with the data.

        Args:
            allowed: what may be refined.
            refined: the refinements made.
            failed: choices that have been tried in vain.
        """
        best, choice = _SIGMAS**2, ()
        for names in _CHOICES:
            if names in failed or not set(names) <= set(allowed) or with_refinements(refined, names) == tuple(refined):
                continue
            gain = self._gain(names)
            if gain > best:
                best, choice = gain, names
        return choice

    def _gain(self, names: tuple[str, ...]) -> float:
        """Decrease of the cost that a choice promises, less a price for each of its parameters.

        Residuals that are alike from frame to frame count as the fewer independent ones that they are worth.
        """
        promised = self._evidence * (self._decrease(names) - self._decrease(()))
        return promised - _PRICE * CameraUnknowns.of(names, self._cameras).count

    def _decrease(self, names: tuple[str, ...]) -> float:
        chosen = self._chosen(names)
        gradient = chosen.mT @ self._gradient
        return float(gradient @ torch.linalg.solve(chosen.mT @ self._information @ chosen, gradient))

    def _solved(self, names: tuple[str, ...]) -> tuple[Tensor, Tensor]:
        """Values and covariance of a choice's parameters."""
        chosen = self._chosen(names)
        covariance = torch.linalg.inv(chosen.mT @ self._information @ chosen)
        cameras = len(self._gradient) - self._every.count
        values = -(covariance @ (chosen.mT @ self._gradient))[cameras:]
        return values, covariance[cameras:, cameras:] / max(self._evidence, _LEAST_EVIDENCE)

    def _chosen(self, names: tuple[str, ...]) -> Tensor:
        """The map from poses and a choice's parameters to poses and all parameters."""
        cameras = len(self._gradient) - self._every.count
        poses = torch.eye(cameras).to(self._gradient)
        if not names:
            return torch.nn.functional.pad(poses, (0, 0, 0, self._every.count))
        unknowns = CameraUnknowns.of(names, self._cameras, self._groups or None)
        of_all = [kind.name for kind in self._every.kinds]
        picked = unknowns.share.new_zeros(unknowns.share.shape[0], len(of_all), unknowns.count)
        picked[:, [of_all.index(kind.name) for kind in unknowns.kinds]] = unknowns.share
        return torch.block_diag(poses, torch.einsum("cki,ckj->ij", self._every.share, picked))


def with_refinements(names: Sequence[str], contradicted: Sequence[str]) -> tuple[str, ...]:
    """Refinements made so far with others added: a focal length of its own takes the place of a shared one."""
    together = {*names, *contradicted}
    if "focal" in together:
        together.discard("focal_shared")
    return tuple(name for name in REFINEMENTS if name in together)
