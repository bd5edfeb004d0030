"""Newton's method for the cameras of a long session, whose points follow them.

With known cameras each point has a minimum of its own. So the points are no unknowns of the method: after each step of the
cameras they are brought to where they belong, and the gradient by the cameras alone says how to go on. Nothing that a step
needs is as large as the coupling of all points with all cameras, which a long session could neither keep nor quickly build
again: the reduced system of the cameras and the blocks of the points are built once.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from torchstickcal.model.objective import Objective
from torchstickcal.model.state import State
from torchstickcal.solvers.acceleration import Acceleration
from torchstickcal.solvers.elimination.evaluated import Gradient
from torchstickcal.solvers.elimination.normal_equations import NormalEquations
from torchstickcal.solvers.linearised import Linearised

_MAX_ROUNDS, _MUCH_LONGER = 10, 3.0
"""Number of steps at most, and length of a step over the shortest one, from which on they lead away."""
_DAMPING = 1e-7
"""So little that it matters only where nothing determines the scale."""
_LAST = 1e-2
"""Length of a step of the cameras, in their standard deviations, below which it is the last."""


@torch.no_grad()
def minimum_with_points_following(objective_at: Callable[[State], Objective], state: State) -> tuple[Linearised, Tensor]:
    """The state near another that minimises the objective that belongs to it, and that objective there, for one session.

    Args:
        objective_at: the objective with the noise that is found at a state. It has no track losses.
        state: the result of a solver.

    Returns:
        The objective at its minimum, and whether that was found, (1,).
    """
    objective = objective_at(state)
    system = _definite(objective, state)
    factor, acceleration = torch.linalg.cholesky_ex(system.reduced).L, Acceleration()
    rig_gradient = system.reduced_gradient
    del system.point_gradient  # as large as all points
    length = shortest = torch.full_like(rig_gradient[:, 0], torch.inf)
    for _ in range(_MAX_ROUNDS):
        plain = -torch.cholesky_solve(rig_gradient[..., None], factor)[..., 0]
        length = (-(plain * rig_gradient).sum(1)).clamp_min(0.0).sqrt()
        if not bool(length < _MUCH_LONGER * shortest):
            break
        shortest = torch.minimum(length, shortest)
        taken = acceleration.step(plain, -rig_gradient)[0]
        state = _followed(system, Gradient(objective, system.moved(state, taken), True, torch.float64))
        objective = objective_at(state)
        if bool(length <= _LAST):
            break
        slopes = Gradient(objective, state, True, torch.float64)
        rig_gradient = torch.cat([slopes.camera_gradient.flatten(1), slopes.unknown_gradient], dim=1)
        state = _followed(system, slopes)
        del slopes
    return Linearised(objective, state, cameras_free=True), length <= _LAST


def _definite(objective: Objective, state: State) -> NormalEquations:
    """The system with the exact Hessian of the images or, where that is not positive definite, with its approximation."""
    system = NormalEquations(objective, state, True, _DAMPING, exact=True, exact_frames=False)
    if bool(torch.linalg.cholesky_ex(system.reduced).info == 0) and bool(system.reduced.isfinite().all()):
        return system
    del system
    return NormalEquations(objective, state, True, _DAMPING)


def _followed(system: NormalEquations, slopes: Gradient) -> State:
    """The state at which the gradient was computed, after one step of its points towards their minima."""
    return replace(slopes.state, points=slopes.state.points - system.solve_points(slopes.point_gradient))
