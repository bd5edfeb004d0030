"""Running one stage: its losses with their noise, its solver, and the closed-form scale."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from torchstickcal.config import Config, Stage
from torchstickcal.errors import ConfigError, ObservationError
from torchstickcal.losses import Loss, ReprojectionLoss, SmoothnessLoss, StickLengthLoss, robust_kernel
from torchstickcal.model.measurements import Measurements, State
from torchstickcal.model.noise import estimate_acceleration_m, estimate_sigma_px
from torchstickcal.model.objective import Objective
from torchstickcal.observations import Observations
from torchstickcal.solvers import Listener, StageRecord, Termination, solver
from torchstickcal.solvers.elimination.normal_equations import NormalEquations

_OUTLIER_CUT = 3.5
_MAD_TO_SIGMA = 1.4826
_RESOLUTION = {torch.float64: 0.0, torch.float32: 1e-6}
"""Relative decrease of the cost that can be told from rounding."""


@dataclass(frozen=True)
class Ruler:
    """A known length: the mean distance over the session between the means of two groups of points.

    A rigid one has the same length in every frame, so that frames in which it has another are wrong.
    """

    start: tuple[int, ...]
    end: tuple[int, ...]
    lengths_m: Tensor
    """(B,), one for each session"""
    rigid: bool

    def measured_m(self, measurements: Measurements, points: Tensor) -> Tensor:
        """Its length in every frame (B, F), NaN where not all its points are known, of points (B, 3, N)."""
        by_frame, active = measurements.by_frame(points), measurements.by_frame(measurements.active)
        start, end = list(self.start), list(self.end)
        vectors = by_frame[..., end].mean(-1) - by_frame[..., start].mean(-1)
        known = active[..., start + end].all(-1)
        return vectors.square().sum(1).where(known, 1.0).sqrt().where(known, torch.nan)


def rulers(sessions: Sequence[Observations], config: Config) -> list[Ruler]:
    """Where the scale comes from: the configuration's segment, else the sticks, of sessions with the same points and sticks.

    Raises:
        ConfigError: if there is neither.
        ObservationError: if the segment names a point the session does not have.
    """
    observations = sessions[0]
    if config.scale is not None:
        start, end = (tuple(map(observations.point_index, names)) for names in (config.scale.start, config.scale.end))
        return [Ruler(start, end, _lengths([config.scale.length_m] * len(sessions), observations), rigid=False)]
    if observations.sticks and config.points != "joints":
        return [
            Ruler(
                (stick.start,),
                (stick.end,),
                _lengths([session.sticks[number].length_m for session in sessions], observations),
                rigid=True,
            )
            for number, stick in enumerate(observations.sticks)
        ]
    raise ConfigError(
        "nothing sets the scale",
        where="scale",
        got=f"{len(observations.sticks)} sticks, points = {config.points!r}",
        expected="a stick among the points that take part, or a [scale] table with a known length",
    )


def _lengths(lengths_m: list[float], observations: Observations) -> Tensor:
    return torch.tensor(lengths_m, dtype=torch.float64, device=observations.keypoints.device)


def scale_factors(measurements: Measurements, points: Tensor, known: Sequence[Ruler]) -> Tensor:
    """The paper's stage 2: known over mean reconstructed length, (B,); a rigid ruler's outlying frames are left out.

    Raises:
        ObservationError: if there is no frame of some session in which a ruler's points are all known.
    """
    measured, expected = points.new_zeros(measurements.sessions), points.new_zeros(measurements.sessions)
    for ruler in known:
        lengths = ruler.measured_m(measurements, points)
        if ruler.rigid:
            median = lengths.nanmedian(1, keepdim=True).values
            deviation = (lengths - median).abs()
            limit = _OUTLIER_CUT * _MAD_TO_SIGMA * deviation.nanmedian(1, keepdim=True).values + 1e-12 * median
            lengths = lengths.where(deviation <= limit, torch.nan)
        measured += lengths.nansum(1)
        expected += ruler.lengths_m * lengths.isfinite().sum(1)
    if not bool((measured > 0).all()):
        raise ObservationError(
            "the length that sets the scale is never seen whole",
            where="scale",
            got="no frame",
            expected="a frame in which all its points are seen by two cameras",
        )
    return expected / measured


class StageResult(NamedTuple):
    """Where a stage ended: the state, which keypoints took part, their noise before it, and its records."""

    state: State
    minimum: State
    """the state before the scene was brought to scale, where the stage does so"""
    losses: dict[str, Loss]
    inliers: Tensor
    """(B, C, N)"""
    sigma_px: Tensor
    """(B, P)"""
    cameras_free: bool
    """whether the stage adjusted the cameras"""
    records: tuple[StageRecord, ...]
    """one for each session"""

    def replaced(self, where: Tensor, other: StageResult) -> StageResult:
        """The result with some sessions (B,), True where, taken from another of the same stage."""
        return StageResult(
            self.state.replaced(where, other.state),
            self.minimum.replaced(where, other.minimum),
            {name: loss.replaced(where, other.losses[name]) for name, loss in self.losses.items()},
            torch.where(where[:, None, None], other.inliers, self.inliers),
            torch.where(where[:, None], other.sigma_px, self.sigma_px),
            self.cameras_free,
            tuple(new if taken else old for old, new, taken in zip(self.records, other.records, where.tolist(), strict=True)),
        )


def run_stage(
    name: str,
    stage: Stage,
    measurements: Measurements,
    state: State,
    known: Sequence[Ruler],
    solver_name: str,
    listener: Listener,
) -> StageResult:
    """Run one stage from a state, for all sessions."""
    began = time.perf_counter()
    squared_residuals = measurements.squared_residuals(state)
    sigma_px = estimate_sigma_px(measurements, squared_residuals)
    if stage.reject_sigmas is not None:
        limits = (stage.reject_sigmas * sigma_px).square().to(squared_residuals)
        agreeing = measurements.by_frame(squared_residuals) <= limits[:, None, None]
        measurements = measurements.keeping(agreeing.flatten(2))
    del squared_residuals
    objective = Objective(measurements, _losses(stage, measurements, state, sigma_px))
    outcome = solver(solver_name)(
        objective,
        state,
        cameras_free=stage.cameras == "free",
        termination=Termination(stage.max_iterations, max(stage.cost_tolerance, _RESOLUTION[measurements.pixels.dtype])),
        stage=name,
        listener=listener,
    )
    state = minimum = outcome.state
    if stage.rescale:
        state = minimum.scaled(scale_factors(measurements, minimum.points, known))
    seconds = time.perf_counter() - began
    ended = zip(outcome.stops, outcome.iterations, strict=True)
    records = tuple(StageRecord(name, stop, seconds, iterations) for stop, iterations in ended)
    return StageResult(state, minimum, objective.losses, measurements.visible, sigma_px, stage.cameras == "free", records)


def _losses(stage: Stage, measurements: Measurements, state: State, sigma_px: Tensor) -> dict[str, Loss]:
    settings = stage.reprojection
    reprojection = ReprojectionLoss(
        sigma_px[:, None, None] if settings.sigma_px == "estimated" else settings.sigma_px,
        settings.weight,
        robust_kernel(settings.kernel, settings.kernel_scale),
    )
    losses: dict[str, Loss] = {"reprojection": reprojection}
    if stage.stick_length is not None:
        losses["stick_length"] = StickLengthLoss(stage.stick_length.sigma_m, stage.stick_length.weight)
    if stage.smoothness is not None:
        sigma_m = stage.smoothness.sigma_m
        if sigma_m == "estimated":
            system = NormalEquations(Objective(measurements, losses), state, cameras_free=False)
            sigma_m = estimate_acceleration_m(measurements, state.points, system.point_variance())[:, None]
        losses["smoothness"] = SmoothnessLoss(sigma_m, stage.smoothness.weight)
    return losses
