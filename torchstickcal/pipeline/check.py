"""Do the given lenses and clocks agree with the keypoints? What they would be if they were unknown, from one linearisation.

At the solution the reduced camera system is built with a column for every unknown of every camera. Any choice of unknowns, own
or shared, is then a small system in which the other columns are left out. The decrease of the cost that it promises says how
strongly the keypoints ask for this choice.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from torchstickcal.geometry.singular import covariance_of, solve_information
from torchstickcal.model.measurements import Measurements
from torchstickcal.model.noise import residual_correlation
from torchstickcal.model.state import State
from torchstickcal.model.unknowns import RigUnknowns, all_unknowns, with_refinements
from torchstickcal.pipeline.adjust import Adjustment
from torchstickcal.solvers.elimination.normal_equations import NormalEquations
from torchstickcal.solvers.uncertainty import likelihood

_CHECKED_FRAMES = 5000
_SIGMAS = 4.0
_LEAST_EVIDENCE = 1e-6
_PRICE = 4.0
"""Decrease of the cost that each further unknown has to bring, in units of a squared standard deviation; chance brings 1."""


class Suggestion(NamedTuple):
    """What an unknown would be by the keypoints, as a deviation from the present value, everything else being as it is."""

    deviation: Tensor
    """(C, n)"""
    std: Tensor
    """(C, n)"""


class CameraCheck:
    """One session's cameras at a solution, examined as if their lenses and clocks were unknown.

    Args:
        adjustment: one session where it has ended. Of a long one the middle is examined.
        groups: a label for each camera; cameras with the same label share what is shared.
    """

    def __init__(self, adjustment: Adjustment, groups: Sequence[str]) -> None:
        part = adjustment.within(_CHECKED_FRAMES)
        result, state = part.last, part.state
        support = part.support
        kept = part.exposures.at_common_times(part.seen, state, support).keeping(result.inliers)
        cameras = kept.cameras_at(state).to(torch.float64)
        self._cameras, self._groups = cameras, groups
        self._choices: dict[tuple[str, ...], tuple[Tensor, RigUnknowns]] = {}
        self._variants = {unknown.name: next(iter(unknown.variants)) for unknown in all_unknowns().values()}
        self._every = RigUnknowns.of(tuple(self._variants.values()), cameras, groups)
        examined = _with_every_unknown(kept, state, self._every)
        objective = likelihood(examined, part.last_camera_stage.losses, result.sigma_px)
        system = NormalEquations(objective, replace(state, unknowns=self._every.given), cameras_free=True)
        self._information, self._gradient = system.reduced[0], system.reduced_gradient[0]
        correlation = residual_correlation(kept, state, result.sigma_px)
        self._evidence = (1 - correlation) / (1 + correlation)

    def suggestions(self) -> dict[str, Suggestion]:
        """What the keypoints suggest for each unknown by itself, by its name."""
        found: dict[str, Suggestion] = {}
        for name, variant in self._variants.items():
            unknowns, values, covariance = self._solved((variant,))
            deviation, variance = unknowns.by_name(values[None])[name][0], unknowns.variances(covariance)[name]
            found[name] = Suggestion(deviation, variance.sqrt())
        return found

    def wanted(
        self, allowed: Collection[str], refined: Sequence[str] = (), failed: Sequence[tuple[str, ...]] = ()
    ) -> tuple[str, ...]:
        """The refinements that the keypoints ask for most beside those made; none where the cameras agree with the keypoints.

        Args:
            allowed: what may be refined.
            refined: the refinements made.
            failed: choices that were tried and did not converge.
        """
        best, choice = _SIGMAS**2, ()
        for names in _choices():
            if names in failed or not set(names) <= set(allowed) or with_refinements(refined, names) == tuple(refined):
                continue
            gain = self._gain(names)
            if gain > best:
                best, choice = gain, names
        return choice

    def _gain(self, names: tuple[str, ...]) -> float:
        """Decrease of the cost that a choice promises, less a price for each of its unknowns.

        Residuals that are alike from frame to frame count as the smaller number of independent ones that they are worth.
        """
        promised = self._evidence * (self._decrease(names) - self._decrease(()))
        _, unknowns = self._chosen(names)
        return promised - _PRICE * unknowns.count

    def _decrease(self, names: tuple[str, ...]) -> float:
        chosen, _ = self._chosen(names)
        gradient = chosen.mT @ self._gradient
        return float(gradient @ solve_information(chosen.mT @ self._information @ chosen, gradient))

    def _solved(self, names: tuple[str, ...]) -> tuple[RigUnknowns, Tensor, Tensor]:
        """A choice's unknowns, their values and their covariance."""
        chosen, unknowns = self._chosen(names)
        information = chosen.mT @ self._information @ chosen
        poses = len(self._gradient) - self._every.count
        values = -solve_information(information, chosen.mT @ self._gradient)[poses:]
        return unknowns, values, covariance_of(information)[poses:, poses:] / max(self._evidence, _LEAST_EVIDENCE)

    def _chosen(self, names: tuple[str, ...]) -> tuple[Tensor, RigUnknowns]:
        """The map from poses and a choice's unknowns to poses and all unknowns, and the choice's unknowns."""
        if names in self._choices:
            return self._choices[names]
        unknowns = RigUnknowns.of(names, self._cameras, self._groups)
        poses = torch.eye(len(self._gradient) - self._every.count).to(self._gradient)
        every = [(unknown.name, component) for unknown in self._every.unknowns for component in unknown.components]
        chosen = [(unknown.name, component) for unknown in unknowns.unknowns for component in unknown.components]
        picked = unknowns.share.new_zeros(len(unknowns.share), len(every), unknowns.count)
        picked[:, [every.index(component) for component in chosen]] = unknowns.share
        means = self._every.share / self._every.share.sum((0, 1))
        self._choices[names] = torch.block_diag(poses, torch.einsum("cki,ckj->ij", means, picked)), unknowns
        return self._choices[names]


def _with_every_unknown(kept: Measurements, state: State, every: RigUnknowns) -> Measurements:
    """Measurements with more unknowns, which are zero where the cameras are as a state has them."""
    assert kept.motion is not None
    return replace(
        kept,
        pixels=kept.pixels_at(state),
        cameras=kept.cameras_at(state).to(torch.float64),
        unknowns=every,
        motion=kept.motion._replace(reference=every.given),
    )


def _choices() -> Iterator[tuple[str, ...]]:
    """What ``auto`` compares: every combination of the unknowns of one family, each in any of its variants."""
    for family in ("clock", "lens"):
        variants = [
            [None, *unknown.variants]
            for unknown in all_unknowns().values()
            if unknown.family == family and unknown.tried_by_auto
        ]
        for names in itertools.product(*variants):
            if any(names):
                yield tuple(name for name in names if name is not None)
