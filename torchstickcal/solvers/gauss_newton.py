"""Levenberg-Marquardt on the exactly reduced system; robust kernels by iteratively re-weighted least squares."""

from __future__ import annotations

from typing import NamedTuple

import torch

from torchstickcal.objective import Objective
from torchstickcal.problem import State
from torchstickcal.solvers.base import IterationRecord, Listener, Outcome, Stop, Termination
from torchstickcal.solvers.normal_equations import NormalEquations, Step, linearise

_INITIAL_DAMPING = 1e-5
_MIN_DAMPING = 1e-14
_MAX_DAMPING = 1e8
_LOOSEN = 0.03
_SHORT_LEASH = 0.5
_NOTHING = 0.01
_LARGE_BLOCK_BYTES = 31 * 2**20
_EXACT_COST_PER_KEYPOINT = 1e-18


def gauss_newton(
    objective: Objective,
    state: State,
    *,
    cameras_free: bool,
    termination: Termination,
    stage: str,
    listener: Listener,
) -> Outcome:
    """Minimise an objective over the points and, unless held, all cameras but the first.

    A step is taken only if it lowers the cost, so the state returned is never worse than the one given.
    """
    _keep_freed_memory()
    damping, step_m = _INITIAL_DAMPING, 0.0
    exact = _EXACT_COST_PER_KEYPOINT * float(objective.measurements.visible.sum())
    records: list[IterationRecord] = []
    system = linearise(objective, state, cameras_free)
    stop: Stop | None = None
    for iteration in range(termination.max_iterations + 1):
        records.append(system.record(stage, iteration, damping, step_m))
        listener(records[-1])
        if system.cost <= exact:
            stop = Stop.EXACT
        if stop is not None or iteration == termination.max_iterations:
            break
        move = _descend(objective, state, system, damping, termination, cameras_free)
        if isinstance(move, Stop):
            stop = move
            break
        decrease = system.cost - move.system.cost
        if move.step.leash < _SHORT_LEASH:
            if decrease <= termination.cost_tolerance * system.cost:
                stop = Stop.COST
            elif move.step.camera_sigmas <= termination.camera_tolerance:
                stop = Stop.CAMERAS
        state, system, damping, step_m = move.state, move.system, move.next_damping, _largest_movement(move.step)
    return Outcome(state, stop or Stop.ITERATIONS, tuple(records))


class _Move(NamedTuple):
    """An accepted step: where it led, the system there, and the next damping."""

    state: State
    system: NormalEquations
    step: Step
    next_damping: float


def _descend(
    objective: Objective,
    state: State,
    system: NormalEquations,
    damping: float,
    termination: Termination,
    cameras_free: bool,
) -> _Move | Stop:
    """Raise the damping until a step lowers the cost, or say why none does.

    A step that promises next to nothing is a sign of convergence only where it is not the damping that keeps it short.
    """
    refused = False
    while damping <= _MAX_DAMPING:
        step = system.step(damping)
        if step is not None:
            if step.predicted_decrease <= _NOTHING * termination.cost_tolerance * system.cost:
                if refused or step.leash < _SHORT_LEASH or damping <= _MIN_DAMPING:
                    return Stop.COST
                damping = max(damping * _LOOSEN, _MIN_DAMPING)
                continue
            candidate = state.retracted(step.cameras, step.points)
            reached = linearise(objective, candidate, cameras_free, replaced=system)
            decrease = system.cost - reached.cost
            if decrease > 0:
                agreement = decrease / step.predicted_decrease
                factor = _LOOSEN if agreement > 0.75 else 1.0 if agreement > 0.25 else 4.0
                return _Move(candidate, reached, step, max(damping * factor, _MIN_DAMPING))
            if step.predicted_decrease <= termination.cost_tolerance * system.cost:
                return Stop.COST
            system = linearise(objective, state, cameras_free, replaced=reached)
        refused = True
        damping = max(damping, 1e-8) * 10
    return Stop.DIVERGED


def _keep_freed_memory() -> None:
    """Have the C library keep freed blocks of the size of our arrays, as it does once it has seen a larger one freed.

    glibc otherwise gives each back to the system, and the first touch of every page of the next one costs more than the
    arithmetic on it.
    """
    torch.empty(_LARGE_BLOCK_BYTES, dtype=torch.uint8)


def _largest_movement(step: Step) -> float:
    cameras = float(step.cameras.abs().max()) if step.cameras.numel() else 0.0
    return max(cameras, float(step.points.abs().max()))
