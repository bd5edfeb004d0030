"""torch.optim.LBFGS on the same objective, through autograd.

The unknowns are scaled by Cholesky factors of the Gauss-Newton system at the start, of each point's block and of the reduced
camera system, so that a unit of each changes the cost by about the same: without it the method needs thousands of iterations.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchstickcal.extrinsics import Extrinsics
from torchstickcal.objective import Objective
from torchstickcal.problem import State
from torchstickcal.solvers.base import IterationRecord, Listener, Outcome, Stop, Termination
from torchstickcal.solvers.normal_equations import linearise
from torchstickcal.solvers.point_elimination import PointElimination

_HISTORY = 30
_ITERATIONS_A_ROUND = 10
_DAMPING = 1e-6


class _ScaledUnknowns:
    """Poses and points as functions of well-scaled unknowns that are zero at the start."""

    def __init__(self, objective: Objective, start: State, cameras_free: bool) -> None:
        system = linearise(objective, start, cameras_free)
        hessian = system.point_hessian.clone()
        hessian[[0, 3, 5]] *= 1 + _DAMPING
        self._points = PointElimination(hessian, None)
        self._cameras = torch.linalg.cholesky(system.reduced_system(_DAMPING)[0]).mT
        self._extrinsics = Extrinsics(start.rotations, start.translations)
        self._start = start
        self.camera = start.points.new_zeros(len(self._cameras), 1).requires_grad_()
        self.point = torch.zeros_like(start.points).requires_grad_()

    def state(self) -> State:
        """The state, differentiable by the unknowns."""
        points = self._start.points + self._points.back_solve(self.point)
        if not self.camera.numel():
            return State(self._start.rotations, self._start.translations, points)
        tangents = torch.linalg.solve_triangular(self._cameras, self.camera, upper=True).view(-1, 6)
        rotations, translations = self._extrinsics.compose(tangents)
        return State(
            torch.cat([self._start.rotations[:1], rotations]), torch.cat([self._start.translations[:1], translations]), points
        )


def lbfgs(
    objective: Objective,
    state: State,
    *,
    cameras_free: bool,
    termination: Termination,
    stage: str,
    listener: Listener,
) -> Outcome:
    """Minimise an objective over the points and, unless held, all cameras but the first.

    A record stands for a round of ten iterations, and ``termination.max_iterations`` counts rounds.
    """
    unknowns = _ScaledUnknowns(objective, state, cameras_free)
    optimiser = torch.optim.LBFGS(
        [unknowns.camera, unknowns.point],
        max_iter=_ITERATIONS_A_ROUND,
        history_size=_HISTORY,
        line_search_fn="strong_wolfe",
        tolerance_grad=0.0,
        tolerance_change=0.0,
    )

    def closure() -> Tensor:
        optimiser.zero_grad()
        current = unknowns.state()
        points = objective.measurements.by_frame(current.points).movedim(0, -1)
        cost = torch.stack(list(objective.terms(current.rotations, current.translations, points).values())).sum()
        cost.backward()
        return cost

    stop, step_m = Stop.ITERATIONS, 0.0
    records: list[IterationRecord] = []
    for iteration in range(termination.max_iterations + 1):
        system = linearise(objective, state, cameras_free)
        records.append(system.record(stage, iteration, damping=0.0, step_m=step_m))
        listener(records[-1])
        if iteration:
            decrease = records[-2].cost - records[-1].cost
            if decrease <= termination.cost_tolerance * records[-1].cost:
                stop = Stop.COST
                break
        if iteration < termination.max_iterations:
            optimiser.step(closure)  # pyright: ignore[reportArgumentType]
            with torch.no_grad():
                moved = unknowns.state()
            step_m = float((moved.points - state.points).abs().max())
            if not bool(moved.points.isfinite().all()):
                stop = Stop.DIVERGED
                break
            state = moved
    return Outcome(state, stop, tuple(records))
