"""Adjustment of cameras with different exposure times: move the keypoints to common times, adjust, and repeat."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from torchstickcal.model.measurements import Measurements
from torchstickcal.model.state import State
from torchstickcal.pipeline.stage import StageResult
from torchstickcal.pipeline.synchronise.exposure import Exposures, Support
from torchstickcal.solvers import StageRecord

CLOCK_STAGE = "clocks"
"""Name of the repeated stage in the records."""

_MAX_ROUNDS = 10
_MOVED_SHARE, _MOVED_SIGMAS = 0.9, 0.001
"""The iteration has converged when this share of the inliers moves by less than this many standard deviations."""


def synchronise_keypoints(
    detected: Measurements,
    exposures: Exposures,
    measurements: Measurements,
    result: StageResult,
    run: Callable[[Measurements, State], StageResult],
) -> tuple[Measurements, StageResult, list[list[StageRecord]]]:
    """Move the keypoints to the common frames and run a stage with them, until the keypoints no longer move.

    A session whose stage does not converge twice in a row is left as it is.

    Args:
        detected: the keypoints as detected.
        exposures: the exposure times of the keypoints.
        measurements: the keypoints of the last run of the stage.
        result: the result of that run.
        run: a function that runs the stage with other measurements, from a state.

    Returns:
        The keypoints on the common frames, the result of the stage with them, and the records of the repeated stage for each
        session.
    """
    support = _support(measurements, result)
    unfinished = torch.ones(detected.sessions, dtype=torch.bool, device=detected.pixels.device)
    records: list[list[StageRecord]] = [[] for _ in range(detected.sessions)]
    at_limit = torch.zeros_like(unfinished)
    for number in range(_MAX_ROUNDS):
        moved = exposures.at_common_times(detected, result.state, support)
        if number > 0:
            unfinished &= _have_moved(moved, measurements, result)
        measurements = moved
        if not bool(unfinished.any()):
            break
        repeated = run(moved, result.state)
        for session, record, continued in zip(records, repeated.records, unfinished.tolist(), strict=True):
            session.extend([record] if continued else [])
        result = result.replaced(unfinished, repeated)
        stopped = torch.tensor([not record.stop.converged for record in repeated.records], device=unfinished.device)
        unfinished, at_limit = unfinished & ~(stopped & at_limit), stopped
        support = support.replaced(unfinished, _support(moved, result))
    return measurements, result, records


def _support(measurements: Measurements, result: StageResult) -> Support:
    return Support.of(measurements.keeping(result.inliers), result.state, result.sigma_px)


def _have_moved(now: Measurements, before: Measurements, result: StageResult) -> Tensor:
    """Whether the keypoints of a session have moved noticeably, (B,)."""
    distance = (now.pixels_at(result.state) - before.pixels_at(result.state)).square().sum(-2).sqrt()
    unmoved = before.by_frame(distance) < _MOVED_SIGMAS * result.sigma_px[:, None, None]
    return (unmoved.flatten(2) & result.inliers).sum((1, 2)) < _MOVED_SHARE * result.inliers.sum((1, 2))
