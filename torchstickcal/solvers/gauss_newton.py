"""Levenberg-Marquardt on the exactly reduced system; robust kernels by iteratively re-weighted least squares.

Several sessions descend side by side: each round builds one system for all of them, each session judges its own step, chooses
its own damping and stops for its own reason.
"""

from __future__ import annotations

import math

import torch

from torchstickcal.model.objective import Objective
from torchstickcal.model.state import State
from torchstickcal.solvers.base import IterationRecord, Listener, Outcome, Stop, Termination
from torchstickcal.solvers.elimination.normal_equations import NormalEquations, Step

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
    keypoints = objective.measurements.visible.sum((1, 2)).tolist()
    descents = [_Descent(termination, _EXACT_COST_PER_KEYPOINT * count) for count in keypoints]
    records: list[list[IterationRecord]] = [[] for _ in descents]
    best = trial = state
    steps_m = [0.0] * len(descents)
    while True:
        damping = torch.tensor([descent.damping for descent in descents], dtype=torch.float64, device=state.points.device)
        system = NormalEquations(objective, trial, cameras_free, damping)
        lowered = [descent.judge(cost) for descent, cost in zip(descents, system.cost.tolist(), strict=True)]
        if all(lowered):
            best = trial
        elif any(lowered):
            best = best.replaced(torch.tensor(lowered, device=state.points.device), trial)
        if any(lowered):
            iterations = [descent.iteration for descent in descents]
            found = system.records(stage, iterations, damping.tolist(), steps_m)
            for session, record in enumerate(found):
                if lowered[session]:
                    records[session].append(record)
                    listener(record)
        moving = [False] * len(descents)
        if any(descent.ready for descent in descents):
            step = system.step()
            promises = (step.solved, step.predicted_decrease, step.leash, step.camera_sigmas)
            for descent, *promise in zip(descents, *(promise.tolist() for promise in promises), strict=True):
                descent.propose(*promise)
            moving = [descent.moving for descent in descents]
            steps_m = _largest_movements(step)
            trial = best.retracted(step.cameras, step.points, step.unknowns)
            del step
        del system
        if all(descent.stop for descent in descents):
            stops = tuple(descent.stop or Stop.ITERATIONS for descent in descents)
            return Outcome(best, stops, tuple(map(tuple, records)))
        if not all(moving):
            trial = best.replaced(torch.tensor(moving, device=state.points.device), trial) if any(moving) else best


class _Descent:
    """How one session goes down: it judges where its step has led, and proposes the next.

    The system at a trial is built with the damping of the step to follow, chosen before the trial's cost is known. Where
    that turns out wrong, the session goes back to the best state and builds its system there again.
    """

    def __init__(self, termination: Termination, exact_cost: float) -> None:
        self._termination, self._exact_cost = termination, exact_cost
        self._cost, self._predicted, self._leash, self._sigmas = math.inf, 0.0, 0.0, math.inf
        self._step_damping, self._factor, self._refused = _INITIAL_DAMPING, _LOOSEN, False
        self.damping = _INITIAL_DAMPING
        self.iteration = -1
        self.stop: Stop | None = None
        self.moving = True
        """whether the trial is another state than the best"""
        self.ready = False
        """whether the system just built is that of the best state"""

    def judge(self, cost: float) -> bool:
        """Take in the cost of the trial; True if it is the new best."""
        self.ready = self.stop is None
        if self.stop is not None or not self.moving:
            return False
        if self.iteration >= 0:
            if not cost < self._cost:
                self._refuse()
                return False
            self._conclude(self._cost - cost)
        self._cost = cost
        self.iteration += 1
        if not math.isfinite(cost):
            self.stop = Stop.DIVERGED
        elif cost <= self._exact_cost:
            self.stop = Stop.EXACT
        elif self.stop is None and self.iteration == self._termination.max_iterations:
            self.stop = Stop.ITERATIONS
        self.ready = self.stop is None
        return True

    def propose(self, solved: bool, predicted: float, leash: float, sigmas: float) -> None:
        """Take in what the step from the best state promises: go there, stay with another damping, or stop."""
        self.moving = False
        if not self.ready:
            return
        if not solved:
            self._raise_damping(self.damping)
        elif predicted <= _NOTHING * self._termination.cost_tolerance * self._cost:
            # A step that promises next to nothing is a sign of convergence only if it is not damping that keeps it short.
            if self._refused or leash < _SHORT_LEASH or self.damping <= _MIN_DAMPING:
                self.stop = Stop.COST
            self.damping = max(self.damping * _LOOSEN, _MIN_DAMPING)
        else:
            self.moving = True
            self._predicted, self._leash, self._sigmas = predicted, leash, sigmas
            self._step_damping = self.damping
            self.damping = max(self.damping * self._factor, _MIN_DAMPING)

    def _conclude(self, decrease: float) -> None:
        """After a step that lowered the cost: how far to trust the next, and whether this was the last."""
        agreement = decrease / self._predicted
        self._factor = _LOOSEN if agreement > 0.75 else 1.0 if agreement > 0.25 else 4.0
        self._refused = False
        if self._leash < _SHORT_LEASH:
            if decrease <= self._termination.cost_tolerance * self._cost:
                self.stop = Stop.COST
            elif self._sigmas <= self._termination.camera_tolerance:
                self.stop = Stop.CAMERAS

    def _refuse(self) -> None:
        """After a step that did not lower the cost."""
        self.ready = self.moving = False
        if self._predicted <= self._termination.cost_tolerance * self._cost:
            self.stop = Stop.COST
        else:
            self._raise_damping(self._step_damping)

    def _raise_damping(self, above: float) -> None:
        self._refused, self._factor = True, 1.0
        self.damping = max(above, 1e-8) * 10
        if self.damping > _MAX_DAMPING:
            self.stop = Stop.DIVERGED


def _keep_freed_memory() -> None:
    """Have the C library keep freed blocks of the size of our arrays, as it does once it has seen a larger one freed.

    glibc otherwise gives each back to the system, and the first touch of every page of the next one costs more than the
    arithmetic on it.
    """
    torch.empty(_LARGE_BLOCK_BYTES, dtype=torch.uint8)


def _largest_movements(step: Step) -> list[float]:
    largest = step.points.abs().amax((1, 2))
    if step.cameras.numel():
        largest = torch.maximum(largest, step.cameras.abs().amax((1, 2)))
    return largest.tolist()
