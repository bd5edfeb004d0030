"""Levenberg-Marquardt on the reduced camera system, with robust kernels by iteratively re-weighted least squares.

All sessions of a batch are solved together: each round builds one system for all of them. Each session accepts or rejects its
own step, has its own damping, and stops by its own criterion.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from torchstickcal.allocator import keep_freed_arrays
from torchstickcal.model.measurements import count_of
from torchstickcal.model.objective import Objective
from torchstickcal.model.state import State
from torchstickcal.solvers.base import IterationRecord, Listener, Outcome, Stop, Termination
from torchstickcal.solvers.elimination.evaluated import Gradient
from torchstickcal.solvers.elimination.normal_equations import NormalEquations, Step

_INITIAL_DAMPING = 1e-5
_MIN_DAMPING, _MAX_DAMPING = 1e-14, 1e8
_DECREASE, _KEEP, _INCREASE = 0.03, 1.0, 4.0
"""Factors on the damping after an accepted step."""
_GOOD_AGREEMENT, _FAIR_AGREEMENT = 0.75, 0.25
"""Actual over predicted decrease of the cost from which the damping is decreased, and from which it is kept."""
_MAX_DAMPED_SHARE = 0.5
"""A step with a larger ``Step.damped_share`` is short because of its damping, and no sign of convergence."""
_NEGLIGIBLE_SHARE = 0.01
"""A step that predicts less than this share of the cost tolerance is not tried."""
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
    """Minimise an objective over the points and, with ``cameras_free``, over all cameras but the first.

    A step is accepted only if it lowers the cost. So the result is never worse than the initial state.
    """
    keep_freed_arrays()
    device = state.points.device
    keypoints = count_of(objective.measurements.visible).sum(1).tolist()
    sessions = [_SessionControl(termination, _EXACT_COST_PER_KEYPOINT * count) for count in keypoints]
    records: list[list[IterationRecord]] = [[] for _ in sessions]
    best = trial = state
    steps_m = [0.0] * len(sessions)
    while True:
        damping = torch.tensor([session.damping for session in sessions], dtype=torch.float64, device=device)
        system = _system(objective, trial, cameras_free, damping, sessions)
        accepted = [session.accept(cost) for session, cost in zip(sessions, system.cost.tolist(), strict=True)]
        if any(accepted):
            best = trial if all(accepted) else best.replaced(torch.tensor(accepted, device=device), trial)
            iterations = [session.iteration for session in sessions]
            for number, record in enumerate(system.records(stage, iterations, damping.tolist(), steps_m)):
                if accepted[number]:
                    records[number].append(record)
                    listener(record)
        has_trial = [False] * len(sessions)
        if isinstance(system, NormalEquations) and any(session.at_best for session in sessions):
            step = system.step()
            results = (step.solved, step.predicted_decrease, step.damped_share, step.camera_sigmas)
            for session, *result in zip(sessions, *(result.tolist() for result in results), strict=True):
                session.plan(*result)
            has_trial = [session.has_trial for session in sessions]
            steps_m = _largest_components(step)
            trial = best.retracted(step.cameras, step.points, step.unknowns)
            del step
            left = [session.leaves_step for session in sessions]
            if any(left):
                best = best.replaced(torch.tensor(left, device=device), trial)
        del system
        if all(session.stop for session in sessions):
            stops = tuple(session.stop or Stop.ITERATIONS for session in sessions)
            return Outcome(best, stops, tuple(map(tuple, records)))
        if not all(has_trial):
            trial = best.replaced(torch.tensor(has_trial, device=device), trial) if any(has_trial) else best


def _system(
    objective: Objective, trial: State, cameras_free: bool, damping: Tensor, sessions: Sequence[_SessionControl]
) -> NormalEquations | Gradient:
    """The normal equations at a trial state, or only the value there where that ends all sessions."""
    if all(session.is_ending for session in sessions if session.stop is None):
        value = Gradient(objective, trial, cameras_free)
        if all(session.ends_with(cost) for session, cost in zip(sessions, value.cost.tolist(), strict=True)):
            return value
    return NormalEquations(objective, trial, cameras_free, damping)


class _SessionControl:
    """Step acceptance, damping and convergence of one session.

    The system at a trial state already needs the damping of the next step, before the cost of the trial is known. If the trial
    is rejected, the session goes back to its best state, and the next round builds the system there with a larger damping.
    """

    def __init__(self, termination: Termination, exact_cost: float) -> None:
        self._termination, self._exact_cost = termination, exact_cost
        self._cost, self._predicted, self._damped_share, self._camera_sigmas = math.inf, 0.0, 0.0, math.inf
        hands_over = termination.newton_follows and termination.max_iterations > 1
        self._shrinkage = 0.0 if hands_over else 1.0
        """predicted decrease of the cost over that of the step before; for the first step, what is assumed"""
        self._negligible_share = 1.0 if hands_over else _NEGLIGIBLE_SHARE
        self._leaves_last_step = hands_over and termination.leaves_last_step
        self._trial_damping, self._factor, self._rejected = _INITIAL_DAMPING, _DECREASE, False
        self.damping = _INITIAL_DAMPING
        self.iteration = -1
        self.stop: Stop | None = None
        self.has_trial = True
        """whether the session has a trial state that differs from its best state"""
        self.at_best = False
        """whether the last system was built at the session's best state"""

    @property
    def leaves_step(self) -> bool:
        """Whether the session has stopped at its trial state, which nobody has tried."""
        return self.stop is not None and self.has_trial

    @property
    def is_ending(self) -> bool:
        """Whether the session stops at its trial state if the cost falls there as predicted."""
        return self.stop is None and self.has_trial and self.iteration >= 0 and self._stop_after(self._predicted) is not None

    def ends_with(self, cost: float) -> bool:
        """Whether the session stops at its trial state if it has this cost, or has stopped already."""
        return self.stop is not None or self._stop_after(self._cost - cost) is not None

    def accept(self, cost: float) -> bool:
        """Take the cost of the last system; True if its state is the new best state."""
        self.at_best = self.stop is None
        if self.stop is not None or not self.has_trial:
            return False
        if self.iteration >= 0:
            if not cost < self._cost:
                self._on_rejected()
                return False
            self._on_accepted(self._cost - cost)
        self._cost = cost
        self.iteration += 1
        if not math.isfinite(cost):
            self.stop = Stop.DIVERGED
        elif cost <= self._exact_cost:
            self.stop = Stop.EXACT
        elif self.stop is None and self.iteration == self._termination.max_iterations:
            self.stop = Stop.ITERATIONS
        self.at_best = self.stop is None
        return True

    def plan(self, solved: bool, predicted: float, damped_share: float, camera_sigmas: float) -> None:
        """Decide about a step from the best state, by the fields of :class:`Step`: try it, change the damping, or stop."""
        self.has_trial = False
        if not self.at_best:
            return
        if not solved:
            self._raise_damping(self.damping)
        elif predicted <= _NEGLIGIBLE_SHARE * self._termination.cost_tolerance * self._cost:
            # A small predicted decrease means convergence only if the damping is not the reason for it.
            if self._rejected or damped_share < _MAX_DAMPED_SHARE or self.damping <= _MIN_DAMPING:
                self.stop = Stop.COST
            self.damping = max(self.damping * _DECREASE, _MIN_DAMPING)
        else:
            self.has_trial = True
            self._shrinkage = predicted / self._predicted if self._predicted else self._shrinkage
            self._predicted, self._damped_share, self._camera_sigmas = predicted, damped_share, camera_sigmas
            self._trial_damping = self.damping
            self.damping = max(self.damping * self._factor, _MIN_DAMPING)
            if self._leaves_last_step:
                self.stop = self._stop_after(predicted)

    def _on_accepted(self, decrease: float) -> None:
        """Choose the next damping by the actual decrease of the cost, and test for convergence."""
        agreement = decrease / self._predicted
        self._factor = _DECREASE if agreement > _GOOD_AGREEMENT else _KEEP if agreement > _FAIR_AGREEMENT else _INCREASE
        self._rejected = False
        self.stop = self._stop_after(decrease)

    def _on_rejected(self) -> None:
        """Go back to the best state with a larger damping, or stop if the step predicted almost nothing."""
        self.at_best = self.has_trial = False
        self.stop = self._stop_after(-1.0)
        if self.stop is None:
            self._raise_damping(self._trial_damping)

    def _stop_after(self, decrease: float) -> Stop | None:
        """Why the session stops if the last step has decreased the cost by so much; None if it goes on.

        The next step is not needed if it would be negligible. By how much steps become shorter is seen from the last two steps,
        and from how well the prediction of the last one was kept.
        """
        limit = self._termination.cost_tolerance * self._cost
        if not decrease > 0:
            return Stop.COST if self._predicted <= limit else None
        if self._damped_share >= _MAX_DAMPED_SHARE:
            return None
        shrinkage = max(self._shrinkage, (1 - decrease / self._predicted) ** 2)
        if decrease <= limit or self._predicted * shrinkage <= self._negligible_share * limit:
            return Stop.COST
        return Stop.CAMERAS if self._camera_sigmas * min(1.0, shrinkage**0.5) <= self._termination.camera_tolerance else None

    def _raise_damping(self, damping: float) -> None:
        """Set the damping to ten times a value that was too small, or stop if it becomes too large."""
        self._rejected, self._factor = True, _KEEP
        self.damping = max(damping, 1e-8) * 10
        if self.damping > _MAX_DAMPING:
            self.stop = Stop.DIVERGED


def _largest_components(step: Step) -> list[float]:
    """Largest absolute component of each session's step."""
    largest = step.points.abs().amax((1, 2))
    if step.cameras.numel():
        largest = torch.maximum(largest, step.cameras.abs().amax((1, 2)))
    return largest.tolist()
