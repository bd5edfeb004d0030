"""Points on which two views agree by chance, found by their motion.

Two rays to wrong keypoints nearly meet from time to time, and no third view says that they should not. Where many keypoints are
wrong, there are many such points, and they are far from where the point was a frame before and after.
"""

from __future__ import annotations

import itertools
from dataclasses import replace

import torch
from torch import Tensor

from torchstickcal.model.measurements import Measurements
from torchstickcal.model.state import State

_MANY_CONTRADICTED = 0.05
"""Share of a session's keypoints that contradict their points, below which no two views are taken to agree by chance."""
_REACH = 2
"""Frames before and after from which the place of a point is predicted."""
_FAR = 5.0
"""Distance from the predicted place, in units of the median distance, from which on a point is not where its motion leads."""


def agreeing_by_chance(measurements: Measurements, state: State, agreeing: Tensor) -> Tensor:
    """The points (B, N) of two agreeing views that are not where the same point was before and after.

    A point is predicted by each point that was found up to two frames before or after, and by each two of them as if it moved
    uniformly; the closest prediction counts. Its distance is that in the images of the two views, the larger one. Where nothing
    was found in those frames, nothing is said, and neither is it where few keypoints contradict their points.

    Args:
        measurements: the sessions.
        state: their cameras and points.
        agreeing: the keypoints (B, C, N) that agree with their points.
    """
    seen, views = measurements.visible, agreeing.sum(1)
    doubtful = agreeing.sum((1, 2)) < (1 - _MANY_CONTRADICTED) * seen.sum((1, 2))
    suspects = (views == 2) & doubtful[:, None]
    if not bool(suspects.any()):
        return suspects
    found = views >= 2
    nearest = torch.full_like(state.points[:, 0], torch.inf)
    for points, known in _predictions(measurements, state.points, found):
        squared = measurements.squared_residuals(replace(state, points=points)).to(nearest)
        nearest = torch.minimum(nearest, squared.where(agreeing, 0.0).amax(1).where(known, torch.inf))
    by_frame = measurements.by_frame(nearest.where(found & nearest.isfinite(), torch.nan))
    typical = torch.fmax(by_frame.nanmedian(1).values, by_frame.flatten(1).nanmedian(1, keepdim=True).values)
    far = measurements.by_frame(nearest) > _FAR**2 * typical[:, None]
    return suspects & nearest.isfinite() & far.flatten(1)


def _predictions(measurements: Measurements, points: Tensor, found: Tensor) -> list[tuple[Tensor, Tensor]]:
    """Where the points (B, 3, N) are by those found in the frames before and after, and which of them are known, (B, N)."""
    width, columns = measurements.points_per_frame, points.shape[-1]

    def after(frames: int) -> tuple[Tensor, Tensor]:
        step, known = frames * width, torch.zeros_like(found)
        own = slice(max(0, -step), min(columns, columns - step))
        known[:, own] = found[:, own.start + step : own.stop + step]
        return points.roll(-step, -1), known

    steps = [frames for frames in range(-_REACH, _REACH + 1) if frames]
    near = {frames: after(frames) for frames in steps}
    moving = [
        (near[a][0] + (near[b][0] - near[a][0]) * (a / (a - b)), near[a][1] & near[b][1])
        for a, b in itertools.combinations(steps, 2)
    ]
    return [*near.values(), *moving]
