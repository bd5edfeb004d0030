"""Keypoints of different exposure times, moved to common times by the motion found, and adjusted again until both agree."""

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
"""Name of the stage when it is run again."""

_MAX_ROUNDS = 10
_MOVED_SHARE, _MOVED_SIGMAS = 0.9, 0.001
"""The clocks have converged when this share of the keypoints has moved by less than so many standard deviations."""


def synchronise_keypoints(
    seen: Measurements,
    exposures: Exposures,
    measurements: Measurements,
    result: StageResult,
    run: Callable[[Measurements, State], StageResult],
) -> tuple[Measurements, StageResult, list[list[StageRecord]]]:
    """Move the keypoints to the common frames and run a stage with them, as often as it takes.

    Args:
        seen: the keypoints as detected.
        exposures: when they were exposed.
        measurements: the keypoints with which the stage was run last.
        result: where it ended.
        run: runs the stage with other measurements, from a state.

    Returns:
        The keypoints on the common frames, where the stage ended with them, and its records for each session.
    """
    support = _support(measurements, result)
    going = torch.ones(seen.sessions, dtype=torch.bool, device=seen.pixels.device)
    records: list[list[StageRecord]] = [[] for _ in range(seen.sessions)]
    for number in range(_MAX_ROUNDS):
        moved = exposures.on_common_frames(seen, result.state, support)
        if number > 0:
            going = _have_moved(moved, measurements, result)
        measurements = moved
        if not bool(going.any()):
            break
        again = run(moved, result.state)
        for own, record, still_going in zip(records, again.records, going.tolist(), strict=True):
            own.extend([record] if still_going else [])
        result = result.replaced(going, again)
        support = support.replaced(going, _support(moved, result))
    return measurements, result, records


def _support(measurements: Measurements, result: StageResult) -> Support:
    return Support.of(measurements.keeping(result.inliers), result.state, result.sigma_px)


def _have_moved(now: Measurements, before: Measurements, result: StageResult) -> Tensor:
    """Whether the keypoints of a session (B,) are elsewhere than before."""
    moved = (now.pixels_at(result.state) - before.pixels_at(result.state)).square().sum(-2).sqrt()
    still = before.by_frame(moved) < _MOVED_SIGMAS * result.sigma_px[:, None, None]
    return (still.flatten(2) & result.inliers).sum((1, 2)) < _MOVED_SHARE * result.inliers.sum((1, 2))
