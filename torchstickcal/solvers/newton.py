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
_TO_ROUNDING, _NEAR, _IN_FLOAT32 = (1e-8, 1e-9), (1e-4, 1e-7), (1e-3, 1e-6)
"""Length of a step, in standard deviations of the estimate, below which it is the last, and what the last step may leave, by
how much shorter it is than the one before: for a minimum up to rounding errors, near enough for everything but gradients, and
as near as float32 allows. The first step is no measure of that: it corrects what the solver has left."""
_POINTS_ALONE = 10.0
"""So many times as much may be left where the cameras are held: what is left of points is small in metres, too."""
_FAR_SIGMAS, _FAR_FROM_NEAR_SIGMAS = 1e-4, 1e-2
"""The same, above which steps that do not become shorter any more say that there is no minimum: rounding errors are smaller."""
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
    tolerance, remaining = _IN_FLOAT32 if not is_double else _TO_ROUNDING if to_rounding else _NEAR
    remaining = remaining if cameras_free else _POINTS_ALONE * remaining
    far = _FAR_SIGMAS if is_double and to_rounding else _FAR_FROM_NEAR_SIGMAS
    before = shortest = torch.full_like(state.points[:, 0, 0], torch.inf)
    moving = torch.ones_like(shortest, dtype=torch.bool)
    for _ in range(_MAX_ROUNDS):
        step = at.descent(gradient)
        length = step.dot(gradient).clamp_min(0.0).sqrt()
        shorter = length < shortest
        slow = bool((moving & ~(length < _SLOW * shortest)).any())
        falling = moving if back else moving & shorter
        taken = step.like(acceleration.step(-step.where(falling).flat(), -gradient.where(falling).flat())[0])
        if not back:
            best = trial if bool((shorter | ~moving).all()) else best.replaced(falling, trial)
            last = shorter & before.isfinite() & (length.square() <= remaining * shortest)
            before, shortest = (torch.where(falling, new, old) for new, old in ((shortest, before), (length, shortest)))
            ended = moving & (last | (shortest <= tolerance))
            best = best.replaced(ended, _moved(best, taken)) if bool(ended.any()) else best
            moving &= ~ended & (shorter if age_of_step == 0 else True)
        if not bool(moving.any()):
            break
        # A step that has become longer is undone. It is tried again with a new Hessian, unless it had one.
        back = not back and bool((moving & ~shorter).any())
        trial = best if back else best.replaced(moving, _moved(best, taken))
        objective, age_of_step = objective_at(trial), age
        if back or (slow and age >= _OLD):
            at, age, acceleration = Linearised(objective, trial, cameras_free), 0, Acceleration()
            gradient = at.gradient
        else:
            gradient, age = gradient_at(objective, trial, cameras_free), age + 1
    return Linearised(objective_at(best), best, cameras_free), shortest < far


def _moved(state: State, step: Tangent) -> State:
    """The state after a step."""
    return state.retracted(step.cameras, step.points, step.unknowns)
