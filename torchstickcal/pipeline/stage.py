"""Running one stage: its losses with their noise, its solver, and the closed-form scale."""

from __future__ import annotations

import time
from typing import NamedTuple

import torch
from torch import Tensor

from torchstickcal.config import Stage
from torchstickcal.losses import Loss, LossContext, LossSettings, TrackLoss
from torchstickcal.model.measurements import Measurements
from torchstickcal.model.noise import estimate_acceleration_m, estimate_sigma_px
from torchstickcal.model.objective import Objective
from torchstickcal.model.state import State
from torchstickcal.pipeline.run import Run
from torchstickcal.pipeline.scale import rulers, scale_factors
from torchstickcal.solvers import StageRecord, Termination, solver
from torchstickcal.solvers.elimination.normal_equations import NormalEquations

_RESOLUTION = {torch.float64: 0.0, torch.float32: 1e-6}
"""Relative decrease of the cost that can be told from rounding."""


class StageResult(NamedTuple):
    """Where a stage ended, for B sessions."""

    stage: Stage
    state: State
    minimum: State
    """the state before the scene was brought to scale, where the stage does so"""
    losses: dict[str, Loss]
    inliers: Tensor
    """(B, C, N), True where a keypoint took part"""
    sigma_px: Tensor
    """(B, P), noise of each point's keypoints, estimated before the stage, pixels"""
    records: tuple[StageRecord, ...]
    """one for each session"""

    def replaced(self, where: Tensor, other: StageResult) -> StageResult:
        """The result with some sessions (B,), True where, taken from another of the same stage."""
        return StageResult(
            self.stage,
            self.state.replaced(where, other.state),
            self.minimum.replaced(where, other.minimum),
            {name: loss.replaced(where, other.losses[name]) for name, loss in self.losses.items()},
            torch.where(where[:, None, None], other.inliers, self.inliers),
            torch.where(where[:, None], other.sigma_px, self.sigma_px),
            tuple(new if taken else old for old, new, taken in zip(self.records, other.records, where.tolist(), strict=True)),
        )


def run_stage(
    name: str,
    stage: Stage,
    measurements: Measurements,
    state: State,
    run: Run,
) -> StageResult:
    """Run one stage from a state, for all sessions.

    Args:
        name: of the stage.
        stage: its settings.
        measurements: the sessions.
        state: where it starts.
        run: what all steps share.
    """
    began = time.perf_counter()
    squared_residuals = measurements.squared_residuals(state)
    sigma_px = estimate_sigma_px(measurements, squared_residuals)
    if stage.reject_sigmas is not None:
        limits = (stage.reject_sigmas * sigma_px).square().to(squared_residuals)
        agreeing = measurements.by_frame(squared_residuals) <= limits[:, None, None]
        measurements = measurements.keeping(agreeing.flatten(2))
    del squared_residuals
    objective = Objective(measurements, _losses(stage, measurements, state, sigma_px))
    outcome = solver(run.config.solver)(
        objective,
        state,
        cameras_free=stage.cameras == "free",
        termination=Termination(stage.max_iterations, max(stage.cost_tolerance, _RESOLUTION[measurements.pixels.dtype])),
        stage=name,
        listener=run.listener,
    )
    state = minimum = outcome.state
    if stage.rescale:
        state = minimum.scaled(scale_factors(measurements, minimum.points, rulers(measurements, run.config)))
    seconds = time.perf_counter() - began
    run.took(name, seconds)
    ended = zip(outcome.stops, outcome.iterations, strict=True)
    records = tuple(StageRecord(name, stop, seconds, iterations) for stop, iterations in ended)
    return StageResult(stage, state, minimum, objective.losses, measurements.visible, sigma_px, records)


def _losses(stage: Stage, measurements: Measurements, state: State, sigma_px: Tensor) -> dict[str, Loss]:
    """The losses of a stage. Track losses come last: their sigma may be estimated with the others at hand."""
    losses: dict[str, Loss] = {}

    def acceleration_m() -> Tensor:
        system = NormalEquations(Objective(measurements, losses), state, cameras_free=False)
        return estimate_acceleration_m(measurements, state.points, system.point_variance())

    def is_track(named: tuple[str, LossSettings]) -> bool:
        return issubclass(named[1].loss, TrackLoss)

    context = LossContext(measurements.point_index, measurements.stick_sigma_m, sigma_px, acceleration_m)
    for name, settings in sorted(stage.losses.items(), key=is_track):
        losses[name] = settings.build(context)
    return losses
