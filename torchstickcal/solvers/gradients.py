"""Gradients through a minimum, by the implicit function theorem.

At a minimum theta the gradient ``g(theta, y)`` of the objective is zero for any data y. So d theta / dy = -G^-1 dg/dy with the
derivative G of g by theta. Where nothing else depends on theta, G is the exact Hessian H. The noise that the objective
uses may be estimated at the minimum itself, as levels ``n(theta, y)``. Then G = H + dg/dn dn/dtheta.

The backward pass solves one linear system, ``G^T v = u`` with the incoming gradient u. Then it differentiates the directional
derivative ``g . v`` with respect to the data, directly and by the levels. The gradient modes differ in how they solve linear
systems in H. The levels are few, so that a short iteration leads from H to G.

Reference: Gould et al., "On differentiating parameterized argmin and argmax problems with application to bi-level
optimization", 2016.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import torch
from torch import Tensor

from torchstickcal.errors import ConfigError
from torchstickcal.geometry.cameras import Intrinsics
from torchstickcal.losses import Quadratic
from torchstickcal.model.measurements import Measurements
from torchstickcal.model.objective import Objective
from torchstickcal.model.state import State
from torchstickcal.shapes import extended
from torchstickcal.solvers.acceleration import Acceleration
from torchstickcal.solvers.linearised import Linearised, Tangent, slope_along, tangent_gradient
from torchstickcal.workers import on_worker

_RIG_INPUTS = 3
"""Number of inputs that describe the rig: rotations, translations, lens and clock unknowns. They come first."""
_DATA_INPUTS = 6
"""Number of inputs after them that describe the measurements. Levels of the noise come last."""
_MAX_ROUNDS = 20
_ACCURACY = 1e-8
"""Length of a step towards the adjoint v, as a share of its own, below which it has converged."""

Levels = tuple[Tensor, ...]
"""Numbers that say how large the errors are."""


class NoiseModel(Protocol):
    """An objective that uses the noise that is found at a state."""

    def levels(self, measurements: Measurements, state: State) -> Levels:
        """The levels of the noise at a state, differentiable by measurements and state."""
        ...

    def objective(self, measurements: Measurements, levels: Levels) -> Objective:
        """The objective with some levels, differentiable by measurements and levels."""
        ...


class GradientMode(Protocol):
    """A way to solve the linear system of the backward pass."""

    def solve(self, minimum: Linearised, gradient: Tangent) -> Tangent:
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

    def solve(self, minimum: Linearised, gradient: Tangent) -> Tangent:
        return minimum.solve(gradient)


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

    def solve(self, minimum: Linearised, gradient: Tangent) -> Tangent:
        return minimum.solve(gradient, exact=False)


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

    def solve(self, minimum: Linearised, gradient: Tangent) -> Tangent:
        solution = minimum.solve(gradient, exact=False)
        for _ in range(self.iterations - 1):
            residual = gradient.plus(minimum.hessian_times(solution), -1.0)
            solution = solution.plus(minimum.solve(residual, exact=False))
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


def attach(
    model: NoiseModel,
    measurements: Measurements,
    minimum: Linearised,
    mode: GradientMode,
    fixed: State | None = None,
    levels: Levels | None = None,
) -> State:
    """A copy of a minimum that carries gradients with respect to the measurements.

    If clocks are among the unknowns, the velocity of the keypoints in the image is treated as a constant.

    Args:
        model: the objective, and the noise that it uses.
        measurements: what was measured. Pixels, confidence, cameras, lengths and priors may require gradients.
        minimum: the minimised objective at its minimum.
        mode: how to solve linear systems in the Hessian.
        fixed: if the cameras were held fixed, the state with their rotations, translations, lens and clock unknowns, which may
            require gradients; None if they were estimated.
        levels: of the noise, where they do not belong to the minimum itself; they may require gradients. None where they do.

    Raises:
        ConfigError: if the gradients are to be exact, and a track loss has a robust kernel, whose curvature is not computed.
    """
    tracks = minimum.objective.track_losses
    curved = [name for name, loss in tracks.items() if not isinstance(loss.kernel, Quadratic)]
    if curved and isinstance(mode, Implicit):
        raise ConfigError(
            "exact gradients need track losses without a robust kernel",
            where=f"loss {', '.join(curved)}",
            got=", ".join(type(tracks[name].kernel).__name__ for name in curved),
            expected="no kernel",
            remedy="Or choose gradient='gauss_newton', an approximation.",
        )
    m, rig = measurements, fixed or minimum.state
    cameras = (rig.rotations, rig.translations, rig.unknowns)
    data = (m.pixels, m.confidence, m.lengths_m, m.cameras.matrix, m.cameras.distortion, m.unknowns.prior_sigma)
    return State(*_Minimum.apply(model, m.detached(), minimum, mode, *cameras, *data, *(levels or ())))


class _Minimum(torch.autograd.Function):
    """Forward: a copy of the minimum. Backward: the gradient with respect to the inputs, by the implicit function theorem."""

    @staticmethod
    def forward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any, model: NoiseModel, measurements: Measurements, minimum: Linearised, mode: GradientMode, *inputs: Tensor | None
    ) -> tuple[Tensor, ...]:
        ctx.model, ctx.measurements, ctx.minimum, ctx.mode = model, measurements, minimum, mode
        ctx.save_for_backward(*inputs)
        state = minimum.state
        return tuple(v.clone() for v in (state.rotations, state.translations, state.points, state.unknowns))

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Any, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        return on_worker(gradients[0].device, _Minimum._backward, ctx, *gradients)

    @staticmethod
    def _backward(ctx: Any, *gradients: Tensor) -> tuple[Any, ...]:
        minimum, needed = ctx.minimum, ctx.needs_input_grad[4:]
        at, free = minimum.state, minimum.cameras_free
        incoming = State(*gradients)
        known = minimum.objective.measurements.active[:, None]
        gradient = tangent_gradient(at, replace(incoming, points=incoming.points.where(known, 0.0)), free)
        if bool(gradient.nonzero.any()):
            by_inputs = _Minimum._by_inputs(ctx, gradient, needed)
        else:
            by_inputs = [torch.zeros_like(v) if need else None for v, need in zip(ctx.saved_tensors, needed, strict=True)]

        # Cameras that are held fixed are also passed through unchanged: add the incoming gradient.
        if not free:
            passed = (incoming.rotations, incoming.translations, incoming.unknowns)
            by_inputs[:_RIG_INPUTS] = [
                direct if through_points is None else direct + through_points
                for direct, through_points in zip(passed, by_inputs[:_RIG_INPUTS], strict=True)
            ]
        return None, None, None, None, *by_inputs

    @staticmethod
    def _by_inputs(ctx: Any, gradient: Tangent, needed: Sequence[bool]) -> list[Tensor | None]:
        """The derivatives by the inputs that need them, through the minimum, for a gradient by its tangents."""
        minimum = ctx.minimum
        at, free = minimum.state, minimum.cameras_free

        # 1. The objective once more, differentiable by all inputs and by the levels of the noise.
        inputs = zip(ctx.saved_tensors, needed, strict=True)
        leaves = [None if v is None else v.detach().requires_grad_(need) for v, need in inputs]
        rig, data, given = leaves[:_RIG_INPUTS], leaves[_RIG_INPUTS:][:_DATA_INPUTS], leaves[_RIG_INPUTS + _DATA_INPUTS :]
        with torch.enable_grad():
            objective, levels = _objective(ctx.model, _with_data(ctx.measurements, data), at, given)

            # 2. Solve G^T v = u. Cameras that are held fixed have no rows in this system.
            adjoint = _adjoint(minimum, ctx.mode, gradient, objective, levels)

            # 3. Differentiate -g . v with respect to the inputs.
            state = at if free else replace(at, rotations=rig[0], translations=rig[1], unknowns=rig[2])
            slope = -slope_along(objective, state, adjoint)
            differentiable = [leaf for leaf in leaves if leaf is not None and leaf.requires_grad]
            found = iter(levels.total(slope, differentiable))
        by_inputs = [next(found) if leaf is not None and leaf.requires_grad else None for leaf in leaves]
        return [None if v is None else _where_nonzero(adjoint, v) for v in by_inputs]


class _Levels:
    """The levels of the noise that an objective uses, as leaves, and what they follow from.

    Args:
        found: as functions of a state and of what was measured; empty where they were given.
        used: as the objective uses them.
        state: the state.
    """

    def __init__(self, found: Levels, used: Levels, state: State) -> None:
        follow = [(level, leaf) for level, leaf in zip(found, used, strict=False) if level.requires_grad]
        self._found, self._used = [level for level, _ in follow], [leaf for _, leaf in follow]
        self._state = state

    @property
    def follow(self) -> bool:
        """Whether any of them follows from the state."""
        return bool(self._found)

    def by_state(self, slope: Tensor) -> State:
        """The derivative of a slope by the state, through the levels alone."""
        (by_levels,) = [_derivatives(slope, self._used)]
        return State(*_derivatives(self._found, list(vars(self._state).values()), by_levels))

    def total(self, slope: Tensor, leaves: Sequence[Tensor]) -> list[Tensor]:
        """The derivatives of a slope by leaves, directly and through the levels."""
        direct = _derivatives(slope, [*leaves, *self._used])
        through = _derivatives(self._found, leaves, direct[len(leaves) :]) if self.follow else [torch.zeros(())] * len(leaves)
        return [a + b.to(a) for a, b in zip(direct, through, strict=False)]


def _derivatives(of: Tensor | Sequence[Tensor], by: Sequence[Tensor], weights: Sequence[Tensor] | None = None) -> list[Tensor]:
    return list(torch.autograd.grad(of, by, weights, retain_graph=True, allow_unused=True, materialize_grads=True))


def _objective(
    model: NoiseModel, measurements: Measurements, at: State, given: Sequence[Tensor | None]
) -> tuple[Objective, _Levels]:
    """The objective, with the given levels, or with those of a state where none are given."""
    state = at.leaves()
    found = () if given else model.levels(measurements, state)
    used = tuple(level for level in given if level is not None) or tuple(level.detach().requires_grad_() for level in found)
    return model.objective(measurements, used), _Levels(found, used, state)


def _adjoint(minimum: Linearised, mode: GradientMode, gradient: Tangent, objective: Objective, levels: _Levels) -> Tangent:
    """The solution of ``G^T v = u``.

    Args:
        minimum: the objective at its minimum.
        mode: how to solve linear systems in the Hessian.
        gradient: u.
        objective: the same, differentiable by the levels.
        levels: of the noise.
    """
    adjoint = mode.solve(minimum, gradient)
    if not levels.follow:
        return adjoint
    times_hessian, whole, acceleration = gradient, adjoint.dot(gradient).abs(), Acceleration()
    before = whole
    for _ in range(_MAX_ROUNDS):
        by_levels = levels.by_state(slope_along(objective, minimum.state, adjoint))
        through = tangent_gradient(minimum.state, by_levels, minimum.cameras_free)
        residual = gradient.plus(through, -1.0).plus(times_hessian, -1.0)
        step = mode.solve(minimum, residual)
        squared, limit = step.dot(residual).abs(), _ACCURACY**2 * whole
        missing = squared > limit
        if not bool(missing.any()):
            break
        moved = acceleration.step(step.where(missing).flat(), residual.where(missing).flat())
        adjoint, times_hessian = (
            total.plus(total.like(part)) for total, part in zip((adjoint, times_hessian), moved, strict=True)
        )
        if bool((~missing | (squared.square() <= 0.01 * limit * before)).all()):  # the next step would be as short
            break
        before = squared
    return adjoint


def _where_nonzero(adjoint: Tangent, gradient: Tensor) -> Tensor:
    """A gradient (B, ...), exactly zero for sessions whose adjoint is zero: 0 times infinity may have made it NaN there."""
    return gradient.where(extended(adjoint.nonzero, gradient.ndim), 0.0)


def _with_data(measurements: Measurements, data: Sequence[Tensor | None]) -> Measurements:
    """The measurements with other pixels, confidence, lengths, camera matrices, distortion and priors."""
    pixels, confidence, lengths_m, matrix, distortion, prior_sigma = data
    assert pixels is not None
    assert confidence is not None
    assert lengths_m is not None
    assert matrix is not None
    assert prior_sigma is not None
    cameras = Intrinsics(matrix, distortion, measurements.cameras.fisheye)
    unknowns = replace(measurements.unknowns, prior_sigma=prior_sigma)
    return replace(measurements, pixels=pixels, confidence=confidence, lengths_m=lengths_m, cameras=cameras, unknowns=unknowns)
