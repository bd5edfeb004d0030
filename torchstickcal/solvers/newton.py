"""Newton iterations with the exact Hessian, to take a solver's result to the minimum up to rounding errors.

Newton's method converges quadratically where Gauss-Newton converges only linearly.
"""

from __future__ import annotations

import torch

from torchstickcal.model.objective import Objective
from torchstickcal.model.state import State
from torchstickcal.solvers.elimination.normal_equations import NormalEquations

_MAX_STEPS = 8
_STEP_SIGMAS = 1e-9
"""Length of a step, in standard deviations of the estimate, below which a session has converged."""
_ROUNDING = 1e-12
"""Relative increase of the cost that counts as rounding error."""


def polish(objective: Objective, state: State, cameras_free: bool) -> State:
    """The minimum near a state, by Newton's method. A session in which no step lowers the cost keeps its state.

    Args:
        objective: the objective to minimise. Its track losses must be quadratic.
        state: the result of a solver.
        cameras_free: whether all cameras but the first are unknowns too.
    """
    best, cost = state, torch.full((objective.measurements.sessions,), torch.inf, dtype=torch.float64)
    cost = cost.to(state.points.device)
    trial = state
    for _ in range(_MAX_STEPS):
        system = NormalEquations(objective, trial, cameras_free, exact=True)
        accepted = system.cost <= cost * (1 + _ROUNDING)
        best, cost = best.replaced(accepted, trial), torch.minimum(system.cost, cost)
        gradient = system.camera_gradient, system.unknown_gradient, system.point_gradient
        *step, solved = system.solve(*gradient)
        products = ((part * by).flatten(1).sum(1) for part, by in zip(gradient, step, strict=True))
        squared_sigmas = sum(products, torch.zeros_like(cost))
        moving = accepted & solved & (squared_sigmas > _STEP_SIGMAS**2)
        if not bool(moving.any()):
            break
        cameras, unknowns, points = step
        trial = best.replaced(moving, best.retracted(-cameras, -points, -unknowns))
    return best
