"""Gradients through a minimisation, by the implicit function theorem (Gould et al., "On differentiating parameterized argmin
and argmax problems", 2016).

At a minimum the gradient g(theta, y) of the objective vanishes whatever the data y, so d theta / d y = -H^-1 dg/dy with the
exact Hessian H. The way back from the unknowns to the data is one linear system in H, and then the derivative by the data of
the objective's slope along the solution. How the system is solved tells the gradient modes apart.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

from torchstickcal.cameras import Intrinsics
from torchstickcal.errors import ConfigError
from torchstickcal.objective import Objective
from torchstickcal.problem import State
from torchstickcal.solvers.normal_equations import NormalEquations
from torchstickcal.workers import on_worker

_DAMPINGS = (0.0, 1e-10, 1e-7)
"""Tried in turn: a minimum that leaves a scale open is singular along it, which a gradient across it does not feel."""


class Adjoint(NamedTuple):
    """The solution of the adjoint system, for B sessions; zero for those that have none."""

    cameras: Tensor
    """(B, C', 6)"""
    points: Tensor
    """(B, 3, N)"""
    solved: Tensor
    """(B,)"""


class GradientMode(Protocol):
    """How the adjoint system is solved."""

    def solve(self, objective: Objective, state: State, cameras_free: bool, camera_rhs: Tensor, point_rhs: Tensor) -> Adjoint:
        """``H^-1`` times gradients by the tangents (B, C', 6) and the points (B, 3, N), at a minimum."""
        ...


@dataclass(frozen=True)
class Implicit:
    """The exact gradient: the exact Hessian, factored."""

    def solve(self, objective: Objective, state: State, cameras_free: bool, camera_rhs: Tensor, point_rhs: Tensor) -> Adjoint:
        return _solved(objective, state, cameras_free, camera_rhs, point_rhs, exact=True)


@dataclass(frozen=True)
class GaussNewton:
    """Gauss and Newton's approximation of the Hessian: as exact as the residuals are small and the kernels quadratic."""

    def solve(self, objective: Objective, state: State, cameras_free: bool, camera_rhs: Tensor, point_rhs: Tensor) -> Adjoint:
        return _solved(objective, state, cameras_free, camera_rhs, point_rhs, exact=False)


@dataclass(frozen=True)
class Unrolled:
    """What backpropagation through some more iterations of Gauss-Newton at the minimum gives, without keeping them.

    Backpropagated, k steps ``theta <- theta - A^-1 g`` are k steps ``v <- v + A^-1 (gradient - H v)``; they tend to the
    implicit gradient as k grows.

    Args:
        iterations: k.
    """

    iterations: int = 5

    def solve(self, objective: Objective, state: State, cameras_free: bool, camera_rhs: Tensor, point_rhs: Tensor) -> Adjoint:
        found = _solved(objective, state, cameras_free, camera_rhs, point_rhs, exact=False)
        for _ in range(self.iterations - 1):
            by_cameras, by_points = _hessian_product(objective, state, found)
            rest = camera_rhs - by_cameras, point_rhs - by_points
            step = _solved(objective, state, cameras_free, *rest, exact=False)
            found = Adjoint(found.cameras + step.cameras, found.points + step.points, found.solved & step.solved)
        return found


def gradient_mode(mode: str | GradientMode) -> GradientMode:
    """The mode of a name, ``implicit``, ``gauss_newton`` or ``unrolled``, or the one given.

    Raises:
        ConfigError: for an unknown name.
    """
    named = {"implicit": Implicit(), "gauss_newton": GaussNewton(), "unrolled": Unrolled()}
    if isinstance(mode, str) and mode not in named:
        raise ConfigError("unknown gradient mode", where="gradient", got=repr(mode), expected=f"one of {', '.join(named)}")
    return named[mode] if isinstance(mode, str) else mode


def attach(objective: Objective, minimum: State, mode: GradientMode, held: tuple[Tensor, Tensor] | None = None) -> State:
    """A minimum with gradients by the measurements of its objective.

    Args:
        objective: of measurements whose pixels, confidence, cameras and lengths may require gradients.
        minimum: where the objective is least.
        mode: how the gradients are found.
        held: the rotations and translations, which may require gradients, where the cameras were held; None where they were
            unknowns.
    """
    m = objective.measurements
    poses = held or (minimum.rotations, minimum.translations)
    data = (m.pixels, m.confidence, m.lengths_m, m.cameras.matrix, m.cameras.distortion)
    return State(*_Attached.apply(objective, minimum, mode, held is None, *poses, *data))


class _Attached(torch.autograd.Function):
    """The identity of a minimum; backwards, the adjoint."""

    @staticmethod
    def forward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any, objective: Objective, minimum: State, mode: GradientMode, cameras_free: bool, *inputs: Tensor | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        ctx.objective, ctx.minimum, ctx.mode, ctx.cameras_free = objective, minimum, mode, cameras_free
        ctx.save_for_backward(*inputs)
        return minimum.rotations.clone(), minimum.translations.clone(), minimum.points.clone()

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Any, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        return on_worker(gradients[0].device, _Attached._pulled_back, ctx, *gradients)

    @staticmethod
    def _pulled_back(ctx: Any, *gradients: Tensor) -> tuple[Any, ...]:
        by_rotations, by_translations, by_points = gradients
        given: list[Tensor | None] = [None if v is None else v.detach() for v in ctx.saved_tensors]
        minimum, needed = ctx.minimum, ctx.needs_input_grad[4:]
        objective = _with_data(ctx.objective, given[2:])
        by_cameras = _by_tangents(minimum.rotations, by_rotations, by_translations)[
            :, 1 if ctx.cameras_free else len(by_points) :
        ]
        if not ctx.cameras_free:
            by_cameras = by_cameras.new_zeros(len(by_points), 0, 6)
        by_points = by_points.where(objective.measurements.active[:, None], 0.0)
        adjoint = ctx.mode.solve(objective, minimum, ctx.cameras_free, by_cameras, by_points)
        leaves = [v.requires_grad_(need) if v is not None else None for v, need in zip(given, needed, strict=True)]
        with torch.enable_grad():
            at = minimum if ctx.cameras_free else replace(minimum, rotations=leaves[0], translations=leaves[1])
            slope = _with_data(ctx.objective, leaves[2:]).slope(at, _of_all(minimum, adjoint.cameras), adjoint.points)
            wanted = [leaf for leaf in leaves if leaf is not None and leaf.requires_grad]
            found = iter(torch.autograd.grad(-slope, wanted, allow_unused=True))
        by_inputs = [next(found) if leaf is not None and leaf.requires_grad else None for leaf in leaves]
        if not ctx.cameras_free:
            by_inputs[:2] = [
                passed if through is None else passed + through
                for passed, through in zip((by_rotations, by_translations), by_inputs[:2], strict=True)
            ]
        return None, None, None, None, *by_inputs


def _solved(
    objective: Objective, state: State, cameras_free: bool, camera_rhs: Tensor, point_rhs: Tensor, exact: bool
) -> Adjoint:
    """The system solved with as little damping as it takes."""
    dampings = torch.zeros(len(point_rhs), dtype=torch.float64, device=point_rhs.device)
    none = point_rhs.new_zeros(len(point_rhs), 0)
    system = NormalEquations(objective, state, cameras_free, dampings, exact)
    cameras, _, points, solved = system.solve(camera_rhs, none, point_rhs)
    for damping in _DAMPINGS[1:]:
        if bool(solved.all()):
            break
        dampings = dampings.where(solved, damping)
        system = NormalEquations(objective, state, cameras_free, dampings, exact)
        cameras, _, points, solved = system.solve(camera_rhs, none, point_rhs)
    return Adjoint(cameras.where(solved[:, None, None], 0.0), points.where(solved[:, None, None], 0.0), solved)


def _hessian_product(objective: Objective, state: State, vector: Adjoint) -> tuple[Tensor, Tensor]:
    """The exact Hessian times a vector of tangents (B, C', 6) and points (B, 3, N)."""
    with torch.enable_grad():
        leaves = [v.detach().requires_grad_() for v in (state.rotations, state.translations, state.points)]
        slope = objective.slope(State(*leaves), _of_all(state, vector.cameras), vector.points)
        by_rotations, by_translations, by_points = torch.autograd.grad(slope, leaves)
    by_cameras = _by_tangents(state.rotations, by_rotations, by_translations)
    return by_cameras[:, by_cameras.shape[1] - vector.cameras.shape[1] :], by_points


def _by_tangents(rotations: Tensor, by_rotations: Tensor, by_translations: Tensor) -> Tensor:
    """Gradients by poses as gradients (B, C, 6) by the tangents of ``T Exp(tangent)``."""
    turned = rotations.mT @ by_rotations
    twist = turned - turned.mT
    rotation = torch.stack([twist[..., 2, 1], twist[..., 0, 2], twist[..., 1, 0]], dim=-1)
    return torch.cat([(rotations.mT @ by_translations[..., None])[..., 0], rotation], dim=-1)


def _of_all(state: State, camera_step: Tensor) -> Tensor:
    """Tangents (B, C, 6) of all cameras from those of the cameras solved for, the others zero."""
    sessions, cameras = state.translations.shape[:2]
    held = camera_step.new_zeros(sessions, cameras - camera_step.shape[1], 6)
    return torch.cat([held, camera_step], dim=1)


def _with_data(objective: Objective, data: list[Tensor | None]) -> Objective:
    """The same losses on other pixels, confidence, lengths, camera matrices and distortion."""
    pixels, confidence, lengths_m, matrix, distortion = data
    assert pixels is not None
    assert confidence is not None
    assert lengths_m is not None
    assert matrix is not None
    m = objective.measurements
    cameras = Intrinsics(matrix, distortion, m.cameras.fisheye)
    measurements = replace(m, pixels=pixels, confidence=confidence, lengths_m=lengths_m, cameras=cameras)
    return Objective(measurements, objective.losses)
