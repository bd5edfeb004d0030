"""Points on which views agree by chance, or no two agree, found anew by their motion.

Two rays to wrong keypoints nearly meet from time to time, and no third view says that they should not. Where many keypoints are
wrong, there are many such points. They are far from where the point was a frame before and after, and there the right ones are.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import replace

import torch
from torch import Tensor

from torchstickcal.geometry.triangulation import triangulate
from torchstickcal.model.measurements import Measurements, views_of
from torchstickcal.model.state import State

_MANY_CONTRADICTED = 0.01
"""Share of a session's keypoints that contradict their points, from which on views are taken to agree by chance."""
_REACH = 2
"""Frames before and after from which the place of a point is predicted."""
_FAR = 5.0
"""Distance from the predicted place, in units of the median distance, from which on a point is not where its motion leads."""


def found_by_motion(measurements: Measurements, state: State, agreeing: Tensor, limits: Tensor) -> tuple[State, Tensor]:
    """The points where their motion leads, and the keypoints that agree with them.

    A point is predicted by each point that was found up to two frames before or after, and by each two of them as if it moved
    uniformly. A point on which two views agree far from every prediction, or no two views do, is triangulated anew from the
    prediction on which most keypoints agree. Where no two views agree with that either, no keypoint of the point is left.
    Nothing changes where few keypoints contradict their points, or where a point was not found in the frames near.

    Args:
        measurements: the sessions.
        state: their cameras and points.
        agreeing: the keypoints (B, C, N) that agree with their points.
        limits: squared residuals up to which they do, (B, P), square pixels.

    Returns:
        The state, and the keypoints that agree, (B, C, N); those given where nothing changes.
    """
    seen, views = measurements.visible, views_of(agreeing)
    doubtful = views.sum(1) < (1 - _MANY_CONTRADICTED) * views_of(seen).sum(1)
    unfound = (views < 2) & measurements.active & doubtful[:, None]
    suspect = (views == 2) & doubtful[:, None]
    if not bool((unfound | suspect).any()):
        return state, agreeing
    nearest = torch.full_like(state.points[:, 0], torch.inf)
    for points, known in _predictions(measurements, state.points, views >= 2):
        squared = measurements.squared_residuals(replace(state, points=points)).to(nearest)
        nearest = torch.minimum(nearest, squared.where(agreeing, 0.0).amax(1).where(known, torch.inf))
    far = _FAR**2 * _typical(measurements, nearest.where(views >= 2, torch.inf))
    astray = suspect & nearest.isfinite() & (nearest > far)
    lost = unfound | astray
    best, score = state.points, torch.zeros_like(nearest)
    for points, known in _predictions(measurements, state.points, (views >= 2) & ~astray):
        squared = measurements.squared_residuals(replace(state, points=points)).to(nearest)
        agreement = (1 / (1 + squared / far[:, None])).sum(1).where(known & lost, 0.0)
        best, score = best.where((agreement <= score)[:, None], points), torch.maximum(agreement, score)
    led = replace(state, points=best)
    near = (measurements.squared_residuals(led) <= far[:, None]) & seen
    regained = lost & (score > 0) & (near.sum(1) >= 2)
    moved = replace(state, points=_triangulated(measurements.keeping(near), led, regained, far.sqrt()))
    squared = measurements.by_frame(measurements.squared_residuals(moved))
    near &= (squared <= limits[:, None, None]).flatten(2)
    regained &= near.sum(1) >= 2
    points = moved.points.where(regained[:, None], state.points)
    return replace(state, points=points), near.where(regained[:, None], agreeing & ~astray[:, None])


def _typical(measurements: Measurements, squared: Tensor) -> Tensor:
    """The median of each point's squared distances (B, N), and no less than that of all points of the session."""
    by_frame = measurements.by_frame(squared.where(squared.isfinite(), torch.nan))
    overall = by_frame.flatten(1).nanmedian(1).values[:, None]
    each = torch.fmax(by_frame.nanmedian(1).values, overall)
    return each.nan_to_num(nan=torch.inf).repeat(1, measurements.frames)


def _predictions(measurements: Measurements, points: Tensor, found: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
    """Where the points (B, 3, N) are by those found in the frames before and after, and which of them are known, (B, N)."""
    width, columns = measurements.points_per_frame, points.shape[-1]

    def after(frames: int) -> tuple[Tensor, Tensor]:
        step, known = frames * width, torch.zeros_like(found)
        own = slice(max(0, -step), max(0, min(columns, columns - step)))
        known[:, own] = found[:, own.start + step : own.stop + step]
        return points.roll(-step, -1), known

    steps = [frames for frames in range(-_REACH, _REACH + 1) if abs(frames) in range(1, measurements.frames)]
    for frames in steps:
        yield after(frames)
    for one, other in itertools.combinations(steps, 2):
        (before, known_before), (behind, known_behind) = after(one), after(other)
        yield before + (behind - before) * (one / (one - other)), known_before & known_behind


def _triangulated(measurements: Measurements, state: State, where: Tensor, scale_px: Tensor) -> Tensor:
    """The points (B, 3, N), some of them, True in (B, N), triangulated anew from where they are.

    Args:
        measurements: the sessions.
        state: their cameras, and where the points begin.
        where: which points.
        scale_px: (B, N), distance from which on a keypoint has little weight, pixels.
    """
    points, pixels, cameras = state.points.clone(), measurements.pixels_at(state), measurements.cameras_at(state)
    for session in where.any(1).nonzero().flatten().tolist():
        columns, own = where[session].nonzero().flatten(), cameras[session].to(torch.float64)
        rays = own.undistort(pixels[session][..., columns].double().movedim(1, -1)).movedim(-1, 1)
        weights = measurements.confidence[session][:, columns].double() * rays.isfinite().all(1)
        found = triangulate(
            state.rotations[session],
            state.translations[session],
            rays.nan_to_num(),
            weights,
            scale=scale_px[session, columns] / own.focal_px.mean(),
            start=points[session][:, columns],
        )
        points[session, :, columns] = found.where(found.isfinite(), points[session][:, columns])
    return points
