"""The last steps to a minimum, with the exact Hessian: quadratic where Gauss-Newton is linear."""

from __future__ import annotations

import torch

from torchstickcal.model.objective import Objective
from torchstickcal.model.state import State
from torchstickcal.solvers.elimination.normal_equations import NormalEquations

_MAX_STEPS = 8
_STEP_SIGMAS = 1e-9
_ROUNDING = 1e-12


def polish(objective: Objective, state: State, cameras_free: bool) -> State:
    """Where Newton's method leads from a state near a minimum; a session in which it leads nowhere stays as it is.

    Args:
        objective: what is least at the minimum; its track losses have to be quadratic.
        state: where a solver has ended.
        cameras_free: whether all cameras but the first are unknowns too.
    """
    best, cost = state, torch.full((objective.measurements.sessions,), torch.inf, dtype=torch.float64)
    cost = cost.to(state.points.device)
    trial = state
    for _ in range(_MAX_STEPS):
        system = NormalEquations(objective, trial, cameras_free, exact=True)
        lower = system.cost <= cost * (1 + _ROUNDING)
        best, cost = best.replaced(lower, trial), torch.minimum(system.cost, cost)
        gradient = system.camera_gradient, system.unknown_gradient, system.point_gradient
        cameras, unknowns, points, solved = system.solve(*gradient)
        squared_sigmas = sum(
            ((by * of).flatten(1).sum(1) for by, of in zip(gradient, (cameras, unknowns, points), strict=True)),
            torch.zeros_like(cost),
        )
        moving = lower & solved & (squared_sigmas > _STEP_SIGMAS**2)
        if not bool(moving.any()):
            break
        trial = best.replaced(moving, best.retracted(-cameras, -points, -unknowns))
    return best
