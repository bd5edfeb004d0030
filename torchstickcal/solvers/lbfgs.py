"""torch.optim.LBFGS on the same objective, with gradients by autograd.

The unknowns are preconditioned by the Gauss-Newton system: with Cholesky factors of each point's Hessian block and of the
reduced camera system, and with the movement of the points that a camera step implies (``-H_xx^-1 H_xc``). Without
preconditioning the method needs thousands of iterations. It then stalls in directions that each single point determines weakly,
such as the scale.
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

_ITERATIONS_PER_ROUND, _MAX_ROUNDS = 100, 20
_DAMPING = 1e-6
_NEGLIGIBLE = 1e-7
"""Step of the preconditioned unknowns, in standard deviations, or decrease of the cost, at which a round ends."""


class _PreconditionedState:
    """The state of one session as a function of preconditioned unknowns, which are zero at the initial state.

    Args:
        system: the normal equations at the initial state.
        camera_factor: the upper triangular factor of the reduced camera system.
        start: the initial state.
    """

    def __init__(self, system: NormalEquations, camera_factor: Tensor, start: State) -> None:
        hessian, no_pairs = raised(system.point_hessian, _DAMPING), system.objective.measurements.sticks[:0, 0]
        self._point_factor = PointElimination(hessian, no_pairs, no_pairs, None)
        self._camera_factor = camera_factor
        self._point_response = system.point_response()[0].flatten(1).mT
        self._extrinsics = Extrinsics(start.rotations[0], start.translations[0])
        self._start, self._free_cameras = start, start.rotations.shape[1] - 1
        self.cameras = start.points.new_zeros(len(self._camera_factor), 1).requires_grad_()
        self.points = torch.zeros_like(start.points).requires_grad_()

    def state(self) -> State:
        """The state, differentiable with respect to the preconditioned unknowns."""
        points = self._start.points + self._point_factor.backward_solve(self.points.flatten(1))
        if not self.cameras.numel():
            return replace(self._start, points=points)
        step = torch.linalg.solve_triangular(self._camera_factor, self.cameras, upper=True)
        tangents, unknowns = step.split([6 * self._free_cameras, len(step) - 6 * self._free_cameras])
        rotations, translations = self._extrinsics.compose(tangents.view(-1, 6))
        points = points + (self._point_response @ step).view_as(points)
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
    """Minimise an objective over the points and, with ``cameras_free``, over all cameras but the first.

    The sessions are solved one after another, in rounds. Each round renews the preconditioner and starts LBFGS with an empty
    history. There is one record per round, and ``max_iterations`` counts rounds, of which there are at most 20: a session that
    needs more does not converge.
    """
    states: list[State] = []
    stops: list[Stop] = []
    records: list[tuple[IterationRecord, ...]] = []
    for session in range(objective.measurements.sessions):
        one = slice(session, session + 1)
        final, stop, rounds = _solve_session(objective[one], state[one], session, cameras_free, termination, stage, listener)
        states.append(final)
        stops.append(stop)
        records.append(rounds)
    return Outcome(State.stack(states), tuple(stops), tuple(records))


def _solve_session(
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
    last = min(termination.max_iterations, _MAX_ROUNDS)
    for iteration in range(last + 1):
        system = NormalEquations(objective, state, cameras_free, _DAMPING)
        (record,) = system.records(stage, [iteration], [0.0], [step_m])
        records.append(replace(record, session=session))
        listener(records[-1])
        if iteration and records[-2].cost - records[-1].cost <= termination.cost_tolerance * records[-1].cost:
            stop = Stop.COST
            break
        if iteration == last:
            break
        factor, failed = torch.linalg.cholesky_ex(system.reduced[0])
        moved = None if int(failed) else _run_round(objective, _PreconditionedState(system, factor.mT, state))
        if moved is None or not bool(moved.points.isfinite().all()):
            stop = Stop.DIVERGED
            break
        step_m = float((moved.points - state.points).abs().max())
        state = moved
    return state, stop, tuple(records)


class _NotFiniteError(Exception):
    """A cost that is not finite."""


def _run_round(objective: Objective, preconditioned: _PreconditionedState) -> State | None:
    """The state after one run of LBFGS; None if the line search fails."""
    optimiser = torch.optim.LBFGS(
        [preconditioned.cameras, preconditioned.points],
        max_iter=_ITERATIONS_PER_ROUND,
        history_size=_ITERATIONS_PER_ROUND,
        line_search_fn="strong_wolfe",
        tolerance_grad=0.0,
        tolerance_change=_NEGLIGIBLE,
    )

    def closure() -> Tensor:
        optimiser.zero_grad()
        cost = torch.stack(list(objective.terms(preconditioned.state()).values())).sum()
        if not bool(cost.isfinite()):
            raise _NotFiniteError
        cost.backward()
        return cost

    try:
        optimiser.step(closure)  # pyright: ignore[reportArgumentType]
    except (_NotFiniteError, IndexError):  # torch's line search has no bracket where every slope is zero up to rounding
        return None
    with torch.no_grad():
        return preconditioned.state()
