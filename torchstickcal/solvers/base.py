"""The interface of the solvers: stopping criteria, stopping reasons, and a record of each iteration."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Protocol

from torch import Tensor

from torchstickcal.model.objective import Objective
from torchstickcal.model.state import State


class Stop(StrEnum):
    """Why a solver stopped. The value is the message for the user."""

    COST = "converged: the cost no longer falls"
    CAMERAS = "converged: the cameras no longer move"
    EXACT = "converged: the residuals are zero up to rounding errors"
    ITERATIONS = "stopped at the limit of iterations"
    DIVERGED = "stopped: no step lowers the cost"
    UNDETERMINED = "stopped: too few keypoints agree with each other to determine the cameras"
    UNSCALED = "stopped: no frame is left in which the points are known whose distance sets the scale"

    @property
    def converged(self) -> bool:
        """Whether the state is a minimum within the requested tolerance."""
        return self in {Stop.COST, Stop.CAMERAS, Stop.EXACT}


@dataclass(frozen=True)
class Termination:
    """Stopping criteria.

    Args:
        max_iterations: largest number of iterations. Each iteration evaluates the derivatives once.
        cost_tolerance: the solver has converged when the predicted or the actual relative decrease of the cost is below this.
        camera_tolerance: the solver has converged when the step of the cameras is below this, in standard deviations of the
            cameras. This criterion stops a run in which only poorly determined points still move, such as points with
            outliers.
        newton_follows: whether Newton's method goes on from where the solver stops. It then stops as soon as the next step
            promises to decrease the cost by less than the tolerance, without trying it, unless only one step is allowed.
        leaves_last_step: whether then the last step that is taken is not tried either. Newton's method evaluates the objective
            there, and whoever runs it begins again where that leads to no minimum.
    """

    max_iterations: int = 100
    cost_tolerance: float = 1e-9
    camera_tolerance: float = 1e-4
    newton_follows: bool = False
    leaves_last_step: bool = False


@dataclass(frozen=True)
class IterationRecord:
    """One iteration of one stage."""

    session: int
    """index of the session in the batch"""
    stage: str
    iteration: int
    cost: float
    terms: dict[str, float]
    """value of each loss; the cost is their sum"""
    damping: float
    """damping factor of Levenberg-Marquardt; 0 for a solver without damping"""
    step_m: float
    """largest component of the last step of cameras and points (m; radians for rotations)"""
    reprojection_px: tuple[float, ...]
    """weighted root mean square reprojection error of each camera"""
    stick_length_m: float
    """mean length of the reconstructed sticks; NaN without sticks"""
    rotations: Tensor | None = field(default=None, compare=False, repr=False)
    """(C, 3, 3), world to camera; None in a record that was read from a file"""
    translations: Tensor | None = field(default=None, compare=False, repr=False)
    """(C, 3), world to camera, metres (in a first stage before the scale is known, in its own unit); likewise"""


@dataclass(frozen=True)
class StageRecord:
    """The course of one stage."""

    name: str
    stop: Stop
    seconds: float
    iterations: tuple[IterationRecord, ...]

    def of_one(self, sessions: int) -> StageRecord:
        """The record of one of so many sessions as that of a session alone, with its share of the time."""
        iterations = tuple(replace(record, session=0) for record in self.iterations)
        return replace(self, seconds=self.seconds / sessions, iterations=iterations)


Listener = Callable[[IterationRecord], None]


def ignore_record(record: IterationRecord) -> None:
    """A listener that ignores the record."""


@dataclass(frozen=True)
class Outcome:
    """Result of a solver for B sessions."""

    state: State
    stops: tuple[Stop, ...]
    """why each session stopped"""
    iterations: tuple[tuple[IterationRecord, ...], ...]
    """the records of each session"""


class Solver(Protocol):
    """A function that minimises an objective, for each session independently."""

    def __call__(
        self,
        objective: Objective,
        state: State,
        *,
        cameras_free: bool,
        termination: Termination,
        stage: str,
        listener: Listener,
    ) -> Outcome:
        """Minimise from a state. The first camera is held fixed; with ``cameras_free=False`` all cameras are."""
        ...
