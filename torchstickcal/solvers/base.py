"""What every solver takes and gives: when to stop, why it stopped, and a record of each iteration."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import Protocol

from torchstickcal.model.objective import Objective
from torchstickcal.model.state import State


class Stop(StrEnum):
    """Why a solver stopped; the value is the sentence to show."""

    COST = "converged: the cost no longer falls"
    CAMERAS = "converged: the cameras no longer move"
    EXACT = "converged: the residuals are at rounding"
    ITERATIONS = "stopped at the limit of iterations"
    DIVERGED = "stopped: no step lowers the cost"

    @property
    def converged(self) -> bool:
        """Whether the state is a minimum to the tolerance asked for."""
        return self in {Stop.COST, Stop.CAMERAS, Stop.EXACT}


@dataclass(frozen=True)
class Termination:
    """When to stop.

    Args:
        max_iterations: limit of iterations, each one evaluation of the derivatives.
        cost_tolerance: relative decrease of the cost, promised or reached, below which it has converged.
        camera_tolerance: step of the cameras below which it has converged, in standard deviations of their estimate. It
            ends a run in which nothing moves any more but single points that outliers leave undetermined.
    """

    max_iterations: int = 100
    cost_tolerance: float = 1e-9
    camera_tolerance: float = 1e-4


@dataclass(frozen=True)
class IterationRecord:
    """One iteration of one stage."""

    session: int
    """which of the sessions solved together"""
    stage: str
    iteration: int
    cost: float
    terms: dict[str, float]
    """value of each loss; they add up to the cost"""
    damping: float
    """Levenberg-Marquardt's factor; 0 where the solver has none"""
    step_m: float
    """largest movement of a camera or point by the step that led here, metres"""
    reprojection_px: tuple[float, ...]
    """weighted root mean square reprojection residual of each camera"""
    stick_length_m: float
    """mean length of the reconstructed sticks; NaN without sticks"""


@dataclass(frozen=True)
class StageRecord:
    """What happened in one stage."""

    name: str
    stop: Stop
    seconds: float
    iterations: tuple[IterationRecord, ...]


Listener = Callable[[IterationRecord], None]


def unheard(record: IterationRecord) -> None:
    """The listener where nobody listens."""


@dataclass(frozen=True)
class Outcome:
    """Where a solver ended, why, and how it got there, for B sessions."""

    state: State
    stops: tuple[Stop, ...]
    """one for each session"""
    iterations: tuple[tuple[IterationRecord, ...], ...]
    """those of each session"""


class Solver(Protocol):
    """Minimises an objective from a state, each session on its own."""

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
        """Minimise; the first camera, or with ``cameras_free=False`` every camera, stays where it is."""
        ...
