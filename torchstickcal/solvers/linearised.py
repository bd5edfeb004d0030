"""An objective near a state: linear systems in its Hessian, and its gradient elsewhere."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchstickcal.geometry.symmetric import are_definite
from torchstickcal.lazy import cached_property
from torchstickcal.model.objective import Objective
from torchstickcal.model.state import State
from torchstickcal.shapes import extended
from torchstickcal.solvers.elimination.evaluated import Gradient
from torchstickcal.solvers.elimination.normal_equations import NormalEquations

_DAMPINGS = (0.0, 1e-10, 1e-7)
"""Damping values, tried in turn until the Hessian is positive definite. It is singular if nothing determines the scale; the
damping then does not change gradients orthogonal to that direction."""


class Tangent(NamedTuple):
    """A step of the unknowns of B sessions, or a gradient with respect to them."""

    cameras: Tensor
    """(B, C', 6), tangents of the C' free cameras"""
    unknowns: Tensor
    """(B, K), lens and clock unknowns; (B, 0) if the cameras are held fixed"""
    points: Tensor
    """(B, 3, N)"""

    def plus(self, other: Tangent, factor: float = 1.0) -> Tangent:
        """This plus ``factor`` times another."""
        return Tangent(*(mine + factor * theirs for mine, theirs in zip(self, other, strict=True)))

    def dot(self, other: Tangent) -> Tensor:
        """The inner product with another, (B,)."""
        products = ((mine * theirs).flatten(1).sum(1) for mine, theirs in zip(self, other, strict=True))
        return sum(products, self.points.new_zeros(len(self.points)))

    def where(self, kept: Tensor) -> Tangent:
        """The same for some sessions (B,), True where kept; zero for the others."""
        return Tangent(*(part.where(extended(kept, part.ndim), 0.0) for part in self))

    @property
    def nonzero(self) -> Tensor:
        """Whether any number is not zero, (B,)."""
        return torch.stack([part.flatten(1).any(1) for part in self]).any(0)

    def flat(self) -> Tensor:
        """All numbers of each session side by side, (B, D)."""
        return torch.cat([part.flatten(1) for part in self], dim=1)

    def like(self, flat: Tensor) -> Tangent:
        """The tangent that :meth:`flat` makes such numbers of, in the shapes of this one."""
        parts = flat.split([part[0].numel() for part in self], dim=1)
        return Tangent(*(flat.view_as(part) for flat, part in zip(parts, self, strict=True)))


class Linearised:
    """An objective at a state. Factored Hessians are kept.

    Args:
        objective: the objective. Its track losses must be quadratic for the exact Hessian.
        state: where.
        cameras_free: whether all cameras but the first are unknowns too.
    """

    def __init__(self, objective: Objective, state: State, cameras_free: bool) -> None:
        self.objective, self.state, self.cameras_free = objective, state, cameras_free
        self._systems: dict[bool, NormalEquations] = {}

    @cached_property
    def _points_definite(self) -> Tensor:
        """Whether the exact Hessians of all points are positive definite, (B,)."""
        return are_definite(self._system(exact=True).point_hessian)

    @property
    def gradient(self) -> Tangent:
        """Half the derivative of the objective."""
        system = self._system(exact=True)
        return Tangent(system.camera_gradient, system.unknown_gradient, system.point_gradient)

    def descent(self, gradient: Tangent) -> Tangent:
        """The Newton step that belongs to a gradient, with a minus sign.

        Where the exact Hessian is not positive definite, Newton's step leads anywhere, and that of Gauss-Newton is taken.
        """
        step = self.solve(gradient)
        falling = step.dot(gradient) > 0
        definite = self._points_definite & (falling if bool(falling.all()) else falling | ~gradient.nonzero)
        if bool(definite.all()):
            return step
        return step.where(definite).plus(self.solve(gradient, exact=False).where(~definite))

    @torch.no_grad()
    def solve(self, gradient: Tangent, exact: bool = True) -> Tangent:
        """The Hessian's inverse times a gradient; zero for sessions in which it is not positive definite.

        Args:
            gradient: of the shapes of :attr:`gradient`.
            exact: whether with the exact Hessian, or with its Gauss-Newton approximation.
        """
        *solution, solved = self._system(exact).solve(*gradient)
        dampings = torch.zeros_like(solved, dtype=torch.float64)
        for damping in _DAMPINGS:
            if bool(solved.all()):
                break
            dampings = dampings.where(solved, damping)
            self._systems[exact] = NormalEquations(self.objective, self.state, self.cameras_free, dampings, exact)
            *solution, solved = self._systems[exact].solve(*gradient)
        return Tangent(*solution).where(solved)

    def hessian_times(self, vector: Tangent) -> Tangent:
        """The exact Hessian times a vector: the derivative of the slope along the vector."""
        with torch.enable_grad():
            state = self.state.leaves()
            slope = slope_along(self.objective, state, vector)
            return tangent_gradient(self.state, state.gradient(slope), self.cameras_free)

    def _system(self, exact: bool) -> NormalEquations:
        if exact not in self._systems:
            self._systems[exact] = NormalEquations(self.objective, self.state, self.cameras_free, 0.0, exact)
        return self._systems[exact]


def slope_along(objective: Objective, state: State, step: Tangent) -> Tensor:
    """Half the derivative of an objective along a step from a state, differentiable by its measurements, losses and state."""
    fixed_cameras = state.translations.shape[1] - step.cameras.shape[1]
    fixed_unknowns = state.unknowns.shape[1] - step.unknowns.shape[1]
    cameras, unknowns = pad(step.cameras, (0, 0, fixed_cameras, 0)), pad(step.unknowns, (0, fixed_unknowns))
    return objective.slope(state, cameras, step.points, unknowns)


def tangent_gradient(state: State, gradient: State, cameras_free: bool) -> Tangent:
    """A gradient by the entries of a state as one by its tangents ``T Exp(tangent)``."""
    turned = state.rotations.mT @ gradient.rotations
    skew = turned - turned.mT
    by_rotation = torch.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], dim=-1)
    by_translation = (state.rotations.mT @ gradient.translations[..., None])[..., 0]
    by_camera, by_unknowns = torch.cat([by_translation, by_rotation], dim=-1)[:, 1:], gradient.unknowns
    if not cameras_free:
        by_camera, by_unknowns = by_camera[:, :0], by_unknowns[:, :0]
    return Tangent(by_camera, by_unknowns, gradient.points)


def gradient_at(objective: Objective, state: State, cameras_free: bool) -> Tangent:
    """Half the derivative of an objective at a state, without its Hessian."""
    found = Gradient(objective, state, cameras_free, torch.float64)
    return Tangent(found.camera_gradient, found.unknown_gradient, found.point_gradient)
