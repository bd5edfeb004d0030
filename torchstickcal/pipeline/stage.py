"""Running one stage: its losses with their noise, its solver, and the closed-form scale."""

from __future__ import annotations

import time
from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from torchstickcal.allocator import give_back_freed_memory
from torchstickcal.config import Stage
from torchstickcal.errors import CalibrationError
from torchstickcal.losses import Loss
from torchstickcal.model.by_motion import found_by_motion
from torchstickcal.model.measurements import Measurements, count_of
from torchstickcal.model.noise import NEAR_SIGMAS, near_keypoints
from torchstickcal.model.objective import Objective
from torchstickcal.model.state import State
from torchstickcal.pipeline.noise import Chosen, NoiseGates, NoiseLevels
from torchstickcal.pipeline.run import Run
from torchstickcal.pipeline.scale import outvoted_factors, rulers, scale_factors
from torchstickcal.solvers import StageRecord, Stop, Termination, solver
from torchstickcal.solvers.windows import can_be_divided, gauss_newton_by_windows

_RESOLUTION = {torch.float64: 0.0, torch.float32: 1e-7}
"""Relative decrease of the cost that can be distinguished from rounding."""
_LEAST_AGREEING_SHARE = 0.15
"""Share of a camera's keypoints that must agree with the other cameras. Sound cameras have more than 0.8, cameras that see
another scene 0.3 to 0.4; by chance some always agree."""


class StageResult(NamedTuple):
    """Where a stage ended, for B sessions."""

    stage: Stage
    state: State
    minimum: State
    """the state before the scene was brought to scale, where the stage does so"""
    losses: dict[str, Loss]
    inliers: Tensor
    """(B, C, N), True where a keypoint took part"""
    noise: NoiseLevels
    """that the losses use, as estimated where the stage began"""
    gates: NoiseGates
    """what was decided about it"""
    agrees: Tensor
    """(B,), whether the losses use the noise as it is found at the minimum"""
    records: tuple[StageRecord, ...]
    """one for each session"""

    @property
    def sigma_px(self) -> Tensor:
        """(B, P), estimated noise of each point's keypoints, pixels."""
        return self.noise.sigma_px

    @property
    def correlation_frames(self) -> Tensor:
        """(B, P), as many keypoints of each point counted as one, because their errors are alike."""
        return self.noise.correlation_frames

    def of(self, session: int) -> StageResult:
        """The result of one of the sessions."""
        one = slice(session, session + 1)
        return self._replace(
            state=self.state[one],
            minimum=self.minimum[one],
            losses={name: loss.of(one) for name, loss in self.losses.items()},
            inliers=self.inliers[one],
            noise=self.noise.of(one),
            gates=self.gates.of(one),
            agrees=self.agrees[one],
            records=(self.records[session].of_one(len(self.records)),),
        )

    def replaced(self, where: Tensor, other: StageResult) -> StageResult:
        """The result with some sessions (B,), True where, taken from another of the same stage."""
        return StageResult(
            self.stage,
            self.state.replaced(where, other.state),
            self.minimum.replaced(where, other.minimum),
            {name: loss.replaced(where, other.losses[name]) for name, loss in self.losses.items()},
            torch.where(where[:, None, None], other.inliers, self.inliers),
            self.noise.replaced(where, other.noise),
            self.gates.replaced(where, other.gates),
            torch.where(where, other.agrees, self.agrees),
            tuple(new if taken else old for old, new, taken in zip(self.records, other.records, where.tolist(), strict=True)),
        )


def run_stage(
    name: str,
    stage: Stage,
    measurements: Measurements,
    state: State,
    run: Run,
    least: float = 0.0,
    times: Tensor | None = None,
) -> StageResult:
    """Run one stage from a state, for all sessions.

    Args:
        name: of the stage.
        stage: its settings.
        measurements: the sessions.
        state: where it starts.
        run: what all steps share.
        least: relative decrease of the cost from which on Gauss-Newton is near enough to the minimum, because Newton's method
            follows; 0 where it does not.
        times: (B, P), as many keypoints of each point as count as one where the stage estimates that; NaN where it is to be
            estimated, None for all.

    Raises:
        CalibrationError: if it does not converge in a session, and the run must.
    """
    began, given = time.perf_counter(), measurements
    if stage.cameras == "free" and not stage.rescale:
        state = state.scaled(outvoted_factors(measurements, state.points, rulers(measurements, run.config)))
    squared_residuals = measurements.squared_residuals(state)
    near = Chosen(near_keypoints(measurements, squared_residuals), NEAR_SIGMAS)
    sigma_px = near.sigma_px(measurements, squared_residuals)
    if stage.reject_sigmas is not None:
        limits = (stage.reject_sigmas * sigma_px).square().to(squared_residuals)
        agreeing = (measurements.by_frame(squared_residuals) <= limits[:, None, None]).flatten(2) & measurements.visible
        found, agreeing = found_by_motion(measurements, state, agreeing, limits)
        measurements = measurements.keeping(agreeing)
        if found is not state:
            state, squared_residuals = found, measurements.squared_residuals(found)
    noise = run.noise_of(stage)
    chosen = near if stage.cameras == "free" else noise.chosen(measurements, lambda: near)
    sigma_px = chosen.sigma_px(measurements, squared_residuals)
    del squared_residuals
    losses, levels, gates = noise.decided(measurements, state, sigma_px, chosen, times)
    if measurements.is_long:
        give_back_freed_memory()
    objective = Objective(measurements, losses)
    least = least if run.config.solver == "gauss_newton" else 0.0
    tolerance = max(stage.cost_tolerance, least, _RESOLUTION[measurements.pixels.dtype])
    termination = Termination(stage.max_iterations, tolerance, newton_follows=least > 0, leaves_last_step=run.to_rounding)
    solve = partial(solver(run.config.solver), cameras_free=stage.cameras == "free")
    plain = run.config.solver == "gauss_newton" and not run.to_rounding
    if plain and stage.cameras == "held" and can_be_divided(objective):
        solve = gauss_newton_by_windows
    outcome = solve(objective, state, termination=termination, stage=name, listener=run.listener)
    state = minimum = outcome.state
    stops = _judged(outcome.stops, Stop.UNDETERMINED, ~_determined(given, measurements))
    if stage.rescale:
        factors, reconstructed = scale_factors(measurements, minimum.points, rulers(measurements, run.config))
        state = minimum.scaled(factors)
        stops = _judged(stops, Stop.UNSCALED, ~reconstructed)
    seconds = time.perf_counter() - began
    run.took(name, seconds)
    ended = zip(stops, outcome.iterations, strict=True)
    records = tuple(StageRecord(name, stop, seconds, iterations) for stop, iterations in ended)
    if run.must_converge and (failed := [stop for stop in stops if not stop.converged]):
        raise CalibrationError("a stage did not converge", where=name, got=str(failed[0]), expected="convergence")
    inliers, agrees = measurements.visible, torch.zeros(len(records), dtype=torch.bool, device=state.points.device)
    return StageResult(stage, state, minimum, losses, inliers, levels, gates, agrees, records)


def agreeing_cameras(given: Measurements, kept: Measurements) -> Tensor:
    """The cameras (B, C) of whose keypoints more agree with the other cameras than chance explains.

    Args:
        given: all keypoints.
        kept: those that agree with each other.
    """
    return count_of(kept.visible) > _LEAST_AGREEING_SHARE * count_of(given.visible)


def _determined(given: Measurements, kept: Measurements) -> Tensor:
    """Whether the keypoints that agree determine a session's cameras and points, (B,); arguments as above."""
    measured = 2 * count_of(kept.visible).sum(1) + kept.stick_active.sum((1, 2))
    unknown = 3 * kept.active.sum(1) + 6 * (kept.num_cameras - 1) + kept.unknowns.count
    return (measured > unknown) & agreeing_cameras(given, kept).all(1)


def _judged(stops: Sequence[Stop], verdict: Stop, applies: Tensor) -> tuple[Stop, ...]:
    """Why each session stopped, with a verdict in place of convergence where it applies, (B,)."""
    return tuple(verdict if stop.converged and bad else stop for stop, bad in zip(stops, applies.tolist(), strict=True))
