"""Keypoints that were not exposed together: brought to one clock by the motion found, and adjusted again, until both agree."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from torchstickcal.model.measurements import Measurements, State
from torchstickcal.pipeline.stage import StageResult
from torchstickcal.pipeline.synchronise.exposure import Exposures, Support

CLOCK_STAGE = "clocks"
"""What the stage is called that is run again."""

_MAX_ROUNDS = 10
_MOVED_SHARE, _MOVED_SIGMAS = 0.9, 0.001
"""The clocks have converged when this share of the keypoints has moved by less than so many standard deviations."""


def on_one_clock(
    seen: Measurements,
    exposures: Exposures,
    measurements: Measurements,
    result: StageResult,
    run: Callable[[Measurements, State], StageResult],
) -> tuple[Measurements, StageResult]:
    """Sessions on the common clock, each brought there and adjusted as often as it takes, and a stage's result there.

    Args:
        seen: the keypoints as seen.
        exposures: when they were exposed, as far as told.
        measurements: the keypoints where the stage has last ended.
        result: where it has ended there.
        run: the stage, on other measurements from a state.
    """
    support = _support(measurements, result)
    going = torch.ones(seen.sessions, dtype=torch.bool, device=seen.pixels.device)
    for number in range(_MAX_ROUNDS):
        placed = exposures.placed(seen, result.state, support)
        if number > 0:
            going = _moved(placed, measurements, result)
        measurements = placed
        if not bool(going.any()):
            break
        result = result.replaced(going, run(placed, result.state))
        support = support.replaced(going, _support(placed, result))
    return measurements, result


def _support(measurements: Measurements, result: StageResult) -> Support:
    return Support.of(measurements.keeping(result.inliers), result.state, result.sigma_px)


def _moved(placed: Measurements, before: Measurements, result: StageResult) -> Tensor:
    """Whether the keypoints (B,) are elsewhere than where they were placed before."""
    moved = (placed.pixels_at(result.state) - before.pixels_at(result.state)).square().sum(-2).sqrt()
    still = before.by_frame(moved) < _MOVED_SIGMAS * result.sigma_px[:, None, None]
    return (still.flatten(2) & result.inliers).sum((1, 2)) < _MOVED_SHARE * result.inliers.sum((1, 2))
