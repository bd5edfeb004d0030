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
from torch.nn.functional import pad

from torchstickcal.errors import ConfigError
from torchstickcal.geometry.cameras import Intrinsics
from torchstickcal.model.objective import Objective
from torchstickcal.model.state import State
from torchstickcal.solvers.elimination.normal_equations import NormalEquations
from torchstickcal.workers import on_worker

_RIG = 3
"""How many of the inputs are a rig's: rotations, translations and further unknowns."""
_DAMPINGS = (0.0, 1e-10, 1e-7)
"""Tried in turn: a minimum that leaves a scale open is singular along it, which a gradient across it does not feel."""


class Tangent(NamedTuple):
    """A direction of the unknowns of B sessions, or a gradient by them."""

    cameras: Tensor
    """(B, C', 6)"""
    unknowns: Tensor
    """(B, K), of what else is unknown of the cameras; (B, 0) where the cameras are held"""
    points: Tensor
    """(B, 3, N)"""

    def plus(self, other: Tangent, factor: float = 1.0) -> Tangent:
        """The sum with a multiple of another."""
        return Tangent(*(mine + factor * theirs for mine, theirs in zip(self, other, strict=True)))


class GradientMode(Protocol):
    """How the adjoint system is solved."""

    def solve(self, objective: Objective, state: State, cameras_free: bool, gradient: Tangent) -> Tangent:
        """``H^-1`` times a gradient, at a minimum; zero for sessions that have no solution."""
        ...


@dataclass(frozen=True)
class Implicit:
    """The exact gradient: the exact Hessian, factored."""

    def solve(self, objective: Objective, state: State, cameras_free: bool, gradient: Tangent) -> Tangent:
        return _solved(objective, state, cameras_free, gradient, exact=True)


@dataclass(frozen=True)
class GaussNewton:
    """Gauss and Newton's approximation of the Hessian: as exact as the residuals are small and the kernels quadratic."""

    def solve(self, objective: Objective, state: State, cameras_free: bool, gradient: Tangent) -> Tangent:
        return _solved(objective, state, cameras_free, gradient, exact=False)


@dataclass(frozen=True)
class Unrolled:
    """What backpropagation through some more iterations of Gauss-Newton at the minimum gives, without keeping them.

    Backpropagated, k steps ``theta <- theta - A^-1 g`` are k steps ``v <- v + A^-1 (gradient - H v)``; they tend to the
    implicit gradient as k grows.

    Args:
        iterations: k.
    """

    iterations: int = 5

    def solve(self, objective: Objective, state: State, cameras_free: bool, gradient: Tangent) -> Tangent:
        found = _solved(objective, state, cameras_free, gradient, exact=False)
        for _ in range(self.iterations - 1):
            rest = gradient.plus(_hessian_product(objective, state, found), -1.0)
            found = found.plus(_solved(objective, state, cameras_free, rest, exact=False))
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


def attach(objective: Objective, minimum: State, mode: GradientMode, held: State | None = None) -> State:
    """A minimum with gradients by the measurements of its objective.

    The motion of the keypoints, where clocks are among the unknowns, counts as a constant.

    Args:
        objective: of measurements whose pixels, confidence, cameras, lengths and priors may require gradients.
        minimum: where the objective is least.
        mode: how the gradients are found.
        held: the state whose rotations, translations and further unknowns, which may require gradients, were held; None where
            they were unknowns.
    """
    m, rig = objective.measurements, held or minimum
    cameras = (rig.rotations, rig.translations, rig.unknowns)
    data = (m.pixels, m.confidence, m.lengths_m, m.cameras.matrix, m.cameras.distortion, m.unknowns.prior_sigma)
    return State(*_Attached.apply(objective, minimum, mode, held is None, *cameras, *data))


class _Attached(torch.autograd.Function):
    """The identity of a minimum; backwards, the adjoint."""

    @staticmethod
    def forward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any, objective: Objective, minimum: State, mode: GradientMode, cameras_free: bool, *inputs: Tensor | None
    ) -> tuple[Tensor, ...]:
        ctx.objective, ctx.minimum, ctx.mode, ctx.cameras_free = objective, minimum, mode, cameras_free
        ctx.save_for_backward(*inputs)
        return tuple(v.clone() for v in (minimum.rotations, minimum.translations, minimum.points, minimum.unknowns))

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Any, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        return on_worker(gradients[0].device, _Attached._pulled_back, ctx, *gradients)

    @staticmethod
    def _pulled_back(ctx: Any, *gradients: Tensor) -> tuple[Any, ...]:
        by_rotations, by_translations, by_points, by_unknowns = gradients
        given: list[Tensor | None] = [None if v is None else v.detach() for v in ctx.saved_tensors]
        minimum, needed = ctx.minimum, ctx.needs_input_grad[4:]
        objective = _with_data(ctx.objective, given[_RIG:])
        gradient = Tangent(
            _by_tangents(minimum.rotations, by_rotations, by_translations)[:, 1:],
            by_unknowns,
            by_points.where(objective.measurements.active[:, None], 0.0),
        )
        if not ctx.cameras_free:
            gradient = gradient._replace(cameras=gradient.cameras[:, :0], unknowns=by_unknowns[:, :0])
        adjoint = _of_all(minimum, ctx.mode.solve(objective, minimum, ctx.cameras_free, gradient))
        leaves = [v.requires_grad_(need) if v is not None else None for v, need in zip(given, needed, strict=True)]
        with torch.enable_grad():
            rotations, translations, unknowns = leaves[:_RIG]
            held = replace(minimum, rotations=rotations, translations=translations, unknowns=unknowns)
            at = minimum if ctx.cameras_free else held
            slope = _slope(_with_data(ctx.objective, leaves[_RIG:]), at, adjoint)
            wanted = [leaf for leaf in leaves if leaf is not None and leaf.requires_grad]
            found = iter(torch.autograd.grad(-slope, wanted, allow_unused=True))
        by_inputs = [next(found) if leaf is not None and leaf.requires_grad else None for leaf in leaves]
        if not ctx.cameras_free:
            by_inputs[:_RIG] = [
                passed if through is None else passed + through
                for passed, through in zip((by_rotations, by_translations, by_unknowns), by_inputs[:_RIG], strict=True)
            ]
        return None, None, None, None, *by_inputs


def _solved(objective: Objective, state: State, cameras_free: bool, gradient: Tangent, exact: bool) -> Tangent:
    """The system solved with as little damping as it takes."""
    dampings = torch.zeros(len(gradient.points), dtype=torch.float64, device=gradient.points.device)
    *found, solved = NormalEquations(objective, state, cameras_free, dampings, exact).solve(*gradient)
    for damping in _DAMPINGS[1:]:
        if bool(solved.all()):
            break
        dampings = dampings.where(solved, damping)
        *found, solved = NormalEquations(objective, state, cameras_free, dampings, exact).solve(*gradient)
    return Tangent(*(part.where(solved.view(-1, *[1] * (part.ndim - 1)), 0.0) for part in found))


def _hessian_product(objective: Objective, state: State, vector: Tangent) -> Tangent:
    """The exact Hessian times a vector."""
    with torch.enable_grad():
        leaves = [v.detach().requires_grad_() for v in (state.rotations, state.translations, state.points, state.unknowns)]
        slope = _slope(objective, State(*leaves), _of_all(state, vector))
        found = torch.autograd.grad(slope, leaves, allow_unused=True, materialize_grads=True)
    by_rotations, by_translations, by_points, by_unknowns = found
    by_cameras = _by_tangents(state.rotations, by_rotations, by_translations)
    held = by_cameras.shape[1] - vector.cameras.shape[1]
    return Tangent(by_cameras[:, held:], by_unknowns[:, : vector.unknowns.shape[1]], by_points)


def _slope(objective: Objective, state: State, step: Tangent) -> Tensor:
    return objective.slope(state, step.cameras, step.points, step.unknowns)


def _by_tangents(rotations: Tensor, by_rotations: Tensor, by_translations: Tensor) -> Tensor:
    """Gradients by poses as gradients (B, C, 6) by the tangents of ``T Exp(tangent)``."""
    turned = rotations.mT @ by_rotations
    twist = turned - turned.mT
    rotation = torch.stack([twist[..., 2, 1], twist[..., 0, 2], twist[..., 1, 0]], dim=-1)
    return torch.cat([(rotations.mT @ by_translations[..., None])[..., 0], rotation], dim=-1)


def _of_all(state: State, step: Tangent) -> Tangent:
    """A step of all cameras (B, C, 6) and further unknowns (B, K), zero for those that are held."""
    held_cameras = state.translations.shape[1] - step.cameras.shape[1]
    held_unknowns = state.unknowns.shape[1] - step.unknowns.shape[1]
    return step._replace(cameras=pad(step.cameras, (0, 0, held_cameras, 0)), unknowns=pad(step.unknowns, (0, held_unknowns)))


def _with_data(objective: Objective, data: list[Tensor | None]) -> Objective:
    """The same losses on other pixels, confidence, lengths, camera matrices, distortion and priors."""
    pixels, confidence, lengths_m, matrix, distortion, prior_sigma = data
    assert pixels is not None
    assert confidence is not None
    assert lengths_m is not None
    assert matrix is not None
    assert prior_sigma is not None
    m = objective.measurements
    cameras = Intrinsics(matrix, distortion, m.cameras.fisheye)
    unknowns = replace(m.unknowns, prior_sigma=prior_sigma)
    measurements = replace(m, pixels=pixels, confidence=confidence, lengths_m=lengths_m, cameras=cameras, unknowns=unknowns)
    return Objective(measurements, objective.losses)
