"""torch.optim.LBFGS on the same objective, through autograd.

The unknowns are scaled by Cholesky factors of the Gauss-Newton system, of each point's block and of the reduced camera
system, and the points follow the cameras as that system has them do. Without it the method needs thousands of iterations,
and stalls where only the sum of all points sees a direction, as it is with the scale.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from torchstickcal.extrinsics import Extrinsics
from torchstickcal.geometry.symmetric import raised
from torchstickcal.model.objective import Objective
from torchstickcal.model.state import State
from torchstickcal.solvers.base import IterationRecord, Listener, Outcome, Stop, Termination
from torchstickcal.solvers.elimination.normal_equations import NormalEquations
from torchstickcal.solvers.elimination.points import PointElimination

_ITERATIONS_A_ROUND = 100
_DAMPING = 1e-6


class _ScaledUnknowns:
    """Poses and points of one session as functions of well-scaled unknowns that are zero at the start."""

    def __init__(self, system: NormalEquations, start: State) -> None:
        hessian, no_pairs = raised(system.point_hessian, _DAMPING), system.objective.measurements.sticks[:0, 0]
        self._points = PointElimination(hessian, no_pairs, no_pairs, None)
        self._cameras = torch.linalg.cholesky(system.reduced[0]).mT
        self._response = system.response()[0].flatten(1).mT
        self._extrinsics = Extrinsics(start.rotations[0], start.translations[0])
        self._start, self._count = start, start.rotations.shape[1] - 1
        self.camera = start.points.new_zeros(len(self._cameras), 1).requires_grad_()
        self.point = torch.zeros_like(start.points).requires_grad_()

    def state(self) -> State:
        """The state, differentiable by the unknowns."""
        points = self._start.points + self._points.back_solve(self.point)
        if not self.camera.numel():
            return replace(self._start, points=points)
        step = torch.linalg.solve_triangular(self._cameras, self.camera, upper=True)
        tangents, unknowns = step.split([6 * self._count, len(step) - 6 * self._count])
        rotations, translations = self._extrinsics.compose(tangents.view(-1, 6))
        points = points + (self._response @ step).view_as(points)
        return State(
            torch.cat([self._start.rotations[:, :1], rotations[None]], dim=1),
            torch.cat([self._start.translations[:, :1], translations[None]], dim=1),
            points,
            self._start.unknowns + unknowns.mT,
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
    """Minimise an objective over the points and, unless held, all cameras but the first, one session after the other.

    It runs in rounds, each with fresh scales and a fresh history; a record stands for a round, and the limit of iterations
    counts rounds.
    """
    states: list[State] = []
    stops: list[Stop] = []
    records: list[tuple[IterationRecord, ...]] = []
    for session in range(objective.measurements.sessions):
        one = slice(session, session + 1)
        ended, stop, heard = _descend(objective[one], state[one], session, cameras_free, termination, stage, listener)
        states.append(ended)
        stops.append(stop)
        records.append(heard)
    return Outcome(State.stack(states), tuple(stops), tuple(records))


def _descend(
    objective: Objective,
    state: State,
    session: int,
    cameras_free: bool,
    termination: Termination,
    stage: str,
    listener: Listener,
) -> tuple[State, Stop, tuple[IterationRecord, ...]]:
    stop, step_m = Stop.ITERATIONS, 0.0
    records: list[IterationRecord] = []
    for iteration in range(termination.max_iterations + 1):
        system = NormalEquations(objective, state, cameras_free, _DAMPING)
        (record,) = system.records(stage, [iteration], [0.0], [step_m])
        records.append(replace(record, session=session))
        listener(records[-1])
        if iteration and records[-2].cost - records[-1].cost <= termination.cost_tolerance * records[-1].cost:
            stop = Stop.COST
            break
        if iteration == termination.max_iterations:
            break
        moved = _round(objective, _ScaledUnknowns(system, state))
        if not bool(moved.points.isfinite().all()):
            stop = Stop.DIVERGED
            break
        step_m = float((moved.points - state.points).abs().max())
        state = moved
    return state, stop, tuple(records)


def _round(objective: Objective, unknowns: _ScaledUnknowns) -> State:
    optimiser = torch.optim.LBFGS(
        [unknowns.camera, unknowns.point],
        max_iter=_ITERATIONS_A_ROUND,
        history_size=_ITERATIONS_A_ROUND,
        line_search_fn="strong_wolfe",
        tolerance_grad=0.0,
        tolerance_change=0.0,
    )

    def closure() -> Tensor:
        optimiser.zero_grad()
        cost = torch.stack(list(objective.terms(unknowns.state()).values())).sum()
        cost.backward()
        return cost

    optimiser.step(closure)  # pyright: ignore[reportArgumentType]
    with torch.no_grad():
        return unknowns.state()
