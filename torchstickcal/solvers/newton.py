"""Newton's method with the exact Hessian, to take a solver's result to the minimum up to rounding errors.

It converges quickly where Gauss-Newton converges only linearly. Where the noise that the objective uses depends on the
state, both are brought to agree: the state is the minimum for the noise that is found there.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from torchstickcal.model.objective import Objective
from torchstickcal.model.state import State
from torchstickcal.solvers.acceleration import Acceleration
from torchstickcal.solvers.linearised import Linearised, Tangent, gradient_at

_MAX_ROUNDS = 40
_ROUNDING_SIGMAS, _NEAR_SIGMAS, _FLOAT32_SIGMAS = 1e-8, 1e-4, 1e-3
"""Length of a step, in standard deviations of the estimate, below which it is the last: for a minimum up to rounding errors,
near enough for everything but gradients, and as near as float32 allows."""
_FAR_SIGMAS, _FAR_FROM_NEAR_SIGMAS = 1e-4, 1e-2
"""The same, above which steps that do not become shorter any more say that there is no minimum: rounding errors are smaller."""
_REMAINING = 0.001
"""What a step leaves, as a share of that length, below which it is the last as well: as much shorter as it was made shorter."""
_SLOW, _OLD = 0.3, 3
"""Ratio of the lengths of two steps, and number of steps with one Hessian, from which on it is built anew."""


def polish(objective: Objective, state: State, cameras_free: bool) -> State:
    """The minimum near a state. A session in which the steps do not become shorter keeps its state.

    Args:
        objective: the objective to minimise. Its track losses must be quadratic.
        state: the result of a solver.
        cameras_free: whether all cameras but the first are unknowns too.
    """
    return minimum_near(lambda _: objective, state, cameras_free)[0].state


def minimum_near(
    objective_at: Callable[[State], Objective], state: State, cameras_free: bool, to_rounding: bool = True
) -> tuple[Linearised, Tensor]:
    """The state near another that minimises the objective that belongs to it, and that objective there.

    The Hessian is built once, and again only if the steps do not quickly become shorter: the way is short.

    Args:
        objective_at: the objective with the noise that is found at a state; otherwise as of :func:`polish`.
        state: the result of a solver.
        cameras_free: whether all cameras but the first are unknowns too.
        to_rounding: whether to go on up to rounding errors.

    Returns:
        The objective at its minimum, and in which sessions that was found, (B,).
    """
    best = trial = state
    at, acceleration = Linearised(objective_at(trial), trial, cameras_free), Acceleration()
    objective, gradient, age, age_of_step, back = at.objective, at.gradient, 0, 0, False
    is_double = objective.measurements.pixels.dtype == torch.float64
    tolerance = _FLOAT32_SIGMAS if not is_double else _ROUNDING_SIGMAS if to_rounding else _NEAR_SIGMAS
    far = _FAR_SIGMAS if tolerance == _ROUNDING_SIGMAS else _FAR_FROM_NEAR_SIGMAS
    shortest = torch.full_like(state.points[:, 0, 0], torch.inf)
    moving = torch.ones_like(shortest, dtype=torch.bool)
    for _ in range(_MAX_ROUNDS):
        step = at.descent(gradient)
        length = step.dot(gradient).clamp_min(0.0).sqrt()
        shorter = length < shortest
        slow = bool((moving & ~(length < _SLOW * shortest)).any())
        if not back:
            best = trial if bool((shorter | ~moving).all()) else best.replaced(moving & shorter, trial)
            last = shorter & shortest.isfinite() & (length.square() <= _REMAINING * tolerance * shortest)
            shortest = torch.where(moving & shorter, length, shortest)
            ended = moving & (last | (shortest <= tolerance))
            best = best.replaced(ended, _moved(best, step, -1.0)) if bool(ended.any()) else best
            moving &= ~ended & (shorter if age_of_step == 0 else True)
        if not bool(moving.any()):
            break
        # A step that has become longer is undone. It is tried again with a new Hessian, unless it had one.
        back = not back and bool((moving & ~shorter).any())
        if back:
            trial = best
        else:
            moved, _ = acceleration.step(-step.where(moving).flat(), -gradient.where(moving).flat())
            trial = best.replaced(moving, _moved(best, step.like(moved), 1.0))
        objective, age_of_step = objective_at(trial), age
        if back or (slow and age >= _OLD):
            at, age, acceleration = Linearised(objective, trial, cameras_free), 0, Acceleration()
            gradient = at.gradient
        else:
            gradient, age = gradient_at(objective, trial, cameras_free), age + 1
    return Linearised(objective_at(best), best, cameras_free), shortest < far


def _moved(state: State, step: Tangent, factor: float) -> State:
    """The state after so many times a step."""
    return state.retracted(factor * step.cameras, factor * step.points, factor * step.unknowns)
