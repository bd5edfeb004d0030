"""Gradients through a minimisation, by the implicit function theorem.

At a minimum theta the gradient g(theta, y) of the objective is zero for any data y. So d theta / dy = -H^-1 dg/dy with the
exact Hessian H. The backward pass solves one linear system in H, ``H v = u`` with the incoming gradient u. Then it
differentiates the directional derivative ``g . v`` with respect to the data. The gradient modes differ in how they solve the
linear system.

Reference: Gould et al., "On differentiating parameterized argmin and argmax problems with application to bi-level
optimization", 2016.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchstickcal.errors import ConfigError
from torchstickcal.geometry.cameras import Intrinsics
from torchstickcal.losses import Quadratic
from torchstickcal.model.objective import Objective
from torchstickcal.model.state import State
from torchstickcal.solvers.elimination.normal_equations import NormalEquations
from torchstickcal.workers import on_worker

_RIG_INPUTS = 3
"""Number of inputs that describe the rig: rotations, translations, lens and clock unknowns. They come first."""
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


class GradientMode(Protocol):
    """A way to solve the linear system of the backward pass."""

    def solve(self, objective: Objective, state: State, cameras_free: bool, gradient: Tangent) -> Tangent:
        """``H^-1`` times a gradient, with the Hessian at a minimum. Zero for sessions whose system cannot be solved."""
        ...


@dataclass(frozen=True)
class Implicit:
    """Exact gradient: solve with the exact Hessian.

    Example:
        >>> from torchstickcal import CalibrationLayer, Implicit
        >>> from torchstickcal.simulate import golf_session
        >>> observations, truth = golf_session(cameras=3, frames=5)
        >>> keypoints = observations.keypoints.requires_grad_()
        >>> layer = CalibrationLayer(observations.sticks, gradient=Implicit())
        >>> layer(keypoints, observations.cameras).translations.norm(dim=-1).sum().backward()
        >>> keypoints.grad.shape
        torch.Size([3, 5, 21, 2])
    """

    def solve(self, objective: Objective, state: State, cameras_free: bool, gradient: Tangent) -> Tangent:
        return _solve(objective, state, cameras_free, gradient, exact=True)


@dataclass(frozen=True)
class GaussNewton:
    """Approximate gradient: solve with the Gauss-Newton approximation of the Hessian.

    It is accurate if the residuals are small and the robust kernels almost quadratic.

    Example:
        >>> from torchstickcal import CalibrationLayer, GaussNewton
        >>> from torchstickcal.simulate import golf_session
        >>> observations, truth = golf_session(cameras=3, frames=5)
        >>> keypoints = observations.keypoints.requires_grad_()
        >>> layer = CalibrationLayer(observations.sticks, gradient=GaussNewton())
        >>> layer(keypoints, observations.cameras).translations.norm(dim=-1).sum().backward()
        >>> keypoints.grad.shape
        torch.Size([3, 5, 21, 2])
    """

    def solve(self, objective: Objective, state: State, cameras_free: bool, gradient: Tangent) -> Tangent:
        return _solve(objective, state, cameras_free, gradient, exact=False)


@dataclass(frozen=True)
class Unrolled:
    """Approximate gradient, equal to backpropagation through k Gauss-Newton iterations at the minimum.

    No iterations are stored. Backpropagation through k steps ``theta <- theta - A^-1 g`` equals k steps
    ``v <- v + A^-1 (gradient - H v)`` from v = 0, where A is the Gauss-Newton approximation of H. With larger k the result
    converges to the exact gradient of :class:`Implicit`.

    Args:
        iterations: k.

    Example:
        >>> from torchstickcal import CalibrationLayer, Unrolled
        >>> from torchstickcal.simulate import golf_session
        >>> observations, truth = golf_session(cameras=3, frames=5)
        >>> keypoints = observations.keypoints.requires_grad_()
        >>> layer = CalibrationLayer(observations.sticks, gradient=Unrolled(iterations=2))
        >>> layer(keypoints, observations.cameras).translations.norm(dim=-1).sum().backward()
        >>> keypoints.grad.shape
        torch.Size([3, 5, 21, 2])
    """

    iterations: int = 5

    def solve(self, objective: Objective, state: State, cameras_free: bool, gradient: Tangent) -> Tangent:
        solution = _solve(objective, state, cameras_free, gradient, exact=False)
        for _ in range(self.iterations - 1):
            residual = gradient.plus(_hessian_product(objective, state, solution), -1.0)
            solution = solution.plus(_solve(objective, state, cameras_free, residual, exact=False))
        return solution


def gradient_mode(mode: str | GradientMode) -> GradientMode:
    """The mode with a name (``implicit``, ``gauss_newton`` or ``unrolled``), or the given mode itself.

    Raises:
        ConfigError: for an unknown name.
    """
    named = {"implicit": Implicit(), "gauss_newton": GaussNewton(), "unrolled": Unrolled()}
    if isinstance(mode, str) and mode not in named:
        raise ConfigError("unknown gradient mode", where="gradient", got=repr(mode), expected=f"one of {', '.join(named)}")
    return named[mode] if isinstance(mode, str) else mode


def attach(objective: Objective, minimum: State, mode: GradientMode, fixed: State | None = None) -> State:
    """A copy of a minimum that carries gradients with respect to the measurements of its objective.

    If clocks are among the unknowns, the velocity of the keypoints in the image is treated as a constant.

    Args:
        objective: the minimised objective. Pixels, confidence, cameras, lengths and priors of its measurements may require
            gradients.
        minimum: the state that minimises the objective.
        mode: how to solve the linear system of the backward pass.
        fixed: if the cameras were held fixed, the state with their rotations, translations, lens and clock unknowns, which may
            require gradients; None if they were estimated.

    Raises:
        ConfigError: if the gradients are to be exact, and a track loss has a robust kernel, whose curvature is not computed.
    """
    curved = [name for name, loss in objective.track_losses.items() if not isinstance(loss.kernel, Quadratic)]
    if curved and isinstance(mode, Implicit):
        raise ConfigError(
            "exact gradients need track losses without a robust kernel",
            where=f"loss {', '.join(curved)}",
            got=", ".join(type(objective.track_losses[name].kernel).__name__ for name in curved),
            expected="no kernel",
            remedy="Or choose gradient='gauss_newton', an approximation.",
        )
    m, rig = objective.measurements, fixed or minimum
    cameras = (rig.rotations, rig.translations, rig.unknowns)
    data = (m.pixels, m.confidence, m.lengths_m, m.cameras.matrix, m.cameras.distortion, m.unknowns.prior_sigma)
    return State(*_Minimum.apply(objective, minimum, mode, fixed is None, *cameras, *data))


class _Minimum(torch.autograd.Function):
    """Forward: a copy of the minimum. Backward: the gradient with respect to the inputs, by the implicit function theorem."""

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
        return on_worker(gradients[0].device, _Minimum._backward, ctx, *gradients)

    @staticmethod
    def _backward(ctx: Any, *gradients: Tensor) -> tuple[Any, ...]:
        by_rotations, by_translations, by_points, by_unknowns = gradients
        minimum, inputs = ctx.minimum, [None if v is None else v.detach() for v in ctx.saved_tensors]

        # 1. Solve H v = u. Cameras that are held fixed have no rows in this system.
        objective = _with_data(ctx.objective, inputs[_RIG_INPUTS:])
        gradient = Tangent(
            _tangent_gradient(minimum.rotations, by_rotations, by_translations)[:, 1:],
            by_unknowns,
            by_points.where(objective.measurements.active[:, None], 0.0),
        )
        if not ctx.cameras_free:
            gradient = gradient._replace(cameras=gradient.cameras[:, :0], unknowns=by_unknowns[:, :0])
        adjoint = _for_all_cameras(minimum, ctx.mode.solve(objective, minimum, ctx.cameras_free, gradient))

        # 2. Differentiate -g . v with respect to the inputs.
        needed = ctx.needs_input_grad[4:]
        leaves = [None if v is None else v.requires_grad_(need) for v, need in zip(inputs, needed, strict=True)]
        with torch.enable_grad():
            state = minimum
            if not ctx.cameras_free:
                rotations, translations, unknowns = leaves[:_RIG_INPUTS]
                state = replace(minimum, rotations=rotations, translations=translations, unknowns=unknowns)
            slope = _slope(_with_data(ctx.objective, leaves[_RIG_INPUTS:]), state, adjoint)
            differentiable = [leaf for leaf in leaves if leaf is not None and leaf.requires_grad]
            found = iter(torch.autograd.grad(-slope, differentiable, allow_unused=True))
        by_inputs = [next(found) if leaf is not None and leaf.requires_grad else None for leaf in leaves]
        by_inputs = [None if v is None else _where_nonzero(adjoint, v) for v in by_inputs]

        # 3. Cameras that are held fixed are also passed through unchanged: add the incoming gradient.
        if not ctx.cameras_free:
            by_inputs[:_RIG_INPUTS] = [
                direct if through_points is None else direct + through_points
                for direct, through_points in zip(
                    (by_rotations, by_translations, by_unknowns), by_inputs[:_RIG_INPUTS], strict=True
                )
            ]
        return None, None, None, None, *by_inputs


def _solve(objective: Objective, state: State, cameras_free: bool, gradient: Tangent, exact: bool) -> Tangent:
    """``H^-1`` times a gradient, with the smallest of the damping values that makes H positive definite."""
    dampings = torch.zeros(len(gradient.points), dtype=torch.float64, device=gradient.points.device)
    *solution, solved = NormalEquations(objective, state, cameras_free, dampings, exact).solve(*gradient)
    for damping in _DAMPINGS[1:]:
        if bool(solved.all()):
            break
        dampings = dampings.where(solved, damping)
        *solution, solved = NormalEquations(objective, state, cameras_free, dampings, exact).solve(*gradient)
    return Tangent(*(part.where(solved.view(-1, *[1] * (part.ndim - 1)), 0.0) for part in solution))


def _hessian_product(objective: Objective, state: State, vector: Tangent) -> Tangent:
    """The exact Hessian times a vector: the derivative of the slope along the vector."""
    with torch.enable_grad():
        leaves = [v.detach().requires_grad_() for v in (state.rotations, state.translations, state.points, state.unknowns)]
        slope = _slope(objective, State(*leaves), _for_all_cameras(state, vector))
        found = torch.autograd.grad(slope, leaves, allow_unused=True, materialize_grads=True)
    by_rotations, by_translations, by_points, by_unknowns = found
    by_cameras = _tangent_gradient(state.rotations, by_rotations, by_translations)
    fixed = by_cameras.shape[1] - vector.cameras.shape[1]
    return Tangent(by_cameras[:, fixed:], by_unknowns[:, : vector.unknowns.shape[1]], by_points)


def _slope(objective: Objective, state: State, step: Tangent) -> Tensor:
    """Half the directional derivative of the objective along a step: ``g . step``."""
    return objective.slope(state, step.cameras, step.points, step.unknowns)


def _tangent_gradient(rotations: Tensor, by_rotations: Tensor, by_translations: Tensor) -> Tensor:
    """Gradient (B, C, 6) with respect to the tangents of ``T Exp(tangent)``, from gradients by rotations and translations."""
    turned = rotations.mT @ by_rotations
    skew = turned - turned.mT
    by_rotation = torch.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], dim=-1)
    return torch.cat([(rotations.mT @ by_translations[..., None])[..., 0], by_rotation], dim=-1)


def _where_nonzero(adjoint: Tangent, gradient: Tensor) -> Tensor:
    """A gradient (B, ...), exactly zero for sessions whose adjoint is zero: 0 times infinity may have made it NaN there."""
    nonzero = torch.stack([part.flatten(1).any(1) for part in adjoint]).any(0)
    return gradient.where(nonzero.view(-1, *[1] * (gradient.ndim - 1)), 0.0)


def _for_all_cameras(state: State, step: Tangent) -> Tangent:
    """A step for all C cameras and K lens and clock unknowns, with zeros for those that are held fixed."""
    fixed_cameras = state.translations.shape[1] - step.cameras.shape[1]
    fixed_unknowns = state.unknowns.shape[1] - step.unknowns.shape[1]
    return step._replace(cameras=pad(step.cameras, (0, 0, fixed_cameras, 0)), unknowns=pad(step.unknowns, (0, fixed_unknowns)))


def _with_data(objective: Objective, data: list[Tensor | None]) -> Objective:
    """The same losses with other pixels, confidence, lengths, camera matrices, distortion and priors."""
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
