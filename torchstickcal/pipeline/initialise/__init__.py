"""Initialisation of the rig from keypoints alone, as in the paper: relative poses of pairs, spanning tree, triangulation.

A detector may place joints differently in different views, always in the same way. In a wrong scene such keypoints can fit
together; but a stick is not equally long in all frames of it. Where it is not, the ends of the sticks alone are the start, if
the sticks keep their lengths then.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from torchstickcal.config import InitialiseSettings
from torchstickcal.errors import RigError
from torchstickcal.geometry.triangulation import triangulate_robustly
from torchstickcal.geometry.vectors import lengths
from torchstickcal.model.measurements import Measurements
from torchstickcal.model.ranks import nanquantile
from torchstickcal.model.state import State
from torchstickcal.pipeline.initialise.graph import propagate, spanning_tree
from torchstickcal.pipeline.initialise.pairs import relate
from torchstickcal.pipeline.initialise.views import Views, undistorted_keypoints
from torchstickcal.workers import map_with_idle_workers

__all__ = ["initialise", "small_squared_residuals", "triangulated"]

_SUPPORT_SCALE = 10.0
"""Scale of the robust kernels in units of the inlier threshold of RANSAC."""
_RIGID, _RIGID_OF_TWO = 0.02, 0.01
"""Change of a stick's length, as a share of it, below which the start is near enough; with two cameras, no third view shows
that it is not. Sound starts have 0.002 to 0.015, and more only among many outliers."""
_MOST_SORTED = 100_003
_CLEARLY_LESS, _AS_GOOD = 0.5, 4.0
"""Change of the lengths and squared residual from the ends alone, relative to those from all keypoints, up to which the ends
are the start."""


def initialise(measurements: Measurements, settings: InitialiseSettings, labels: Sequence[str]) -> State:
    """Cameras and points up to scale, in the frame of the first camera.

    Args:
        measurements: one session.
        settings: thresholds.
        labels: names of the cameras, for error messages.

    Raises:
        RigError: if the cameras do not have enough common points.
    """
    state = _from_keypoints(measurements, settings, labels)
    change = _change_of_lengths(measurements, state)
    of_ends = _of_ends(measurements)
    if of_ends is None or change < (_RIGID if measurements.num_cameras > 2 else _RIGID_OF_TWO):
        return state
    try:
        start = _from_keypoints(of_ends, settings, labels)
    except RigError:
        return state
    other = replace(start, points=triangulated(measurements, start.rotations, start.translations, settings))
    rigid = _change_of_lengths(measurements, other) < _CLEARLY_LESS * change
    return other if rigid and _misfit(measurements, other) < _AS_GOOD * _misfit(measurements, state) else state


def _from_keypoints(measurements: Measurements, settings: InitialiseSettings, labels: Sequence[str]) -> State:
    """Cameras and points by all the keypoints; arguments and errors as of :func:`initialise`."""
    views = Views(measurements)
    relate_pair = partial(relate, views, max_points=settings.max_points, threshold_px=settings.threshold_px)
    edges = spanning_tree(views.common(), relate_pair, labels, settings.min_common_points)
    poses = propagate(edges, views, _kernel_scale(measurements, settings))
    rotations, translations = (torch.from_numpy(pose)[None].to(measurements.pixels.device) for pose in poses)
    return State.of(rotations, translations, triangulated(measurements, rotations, translations, settings, views))


def _of_ends(measurements: Measurements) -> Measurements | None:
    """The keypoints of the ends of the sticks; None where there are no sticks, or no other points."""
    ends = torch.zeros(measurements.points_per_frame, dtype=torch.bool, device=measurements.pixels.device)
    ends[measurements.sticks.flatten()] = True
    return measurements.keeping(ends.repeat(measurements.frames)) if bool(ends.any()) and not bool(ends.all()) else None


def _change_of_lengths(measurements: Measurements, state: State) -> float:
    """How much the length of a stick changes from frame to frame, as a share of it: the median. 0 without sticks."""
    ends = measurements.by_frame(state.points)[0][:, :, measurements.sticks]
    found = lengths(ends[..., 1] - ends[..., 0]).where(measurements.stick_active[0], torch.nan)
    change = (found / found.nanmedian(0).values - 1).abs().nanmedian()
    return float(change.nan_to_num(0.0))


def _misfit(measurements: Measurements, state: State) -> float:
    return float(small_squared_residuals(measurements, replace(state, unknowns=measurements.unknowns.given)))


def small_squared_residuals(measurements: Measurements, state: State) -> Tensor:
    """The lower quartile of each session's squared residuals, (B,), square pixels: few outliers are among them."""
    squared = measurements.squared_residuals(state).double().where(measurements.visible, torch.nan).flatten(1)
    step = -(-squared.shape[1] // _MOST_SORTED)
    return nanquantile(squared[:, ::step], 0.25)


def triangulated(
    measurements: Measurements,
    rotations: Tensor,
    translations: Tensor,
    settings: InitialiseSettings,
    views: Views | None = None,
) -> Tensor:
    """Triangulated points (1, 3, N) of one session, zero if fewer than two cameras see a point.

    Args:
        measurements: one session.
        rotations: (1, C, 3, 3), world to camera.
        translations: (1, C, 3), world to camera.
        settings: thresholds.
        views: of the session, which may know its keypoints without distortion; None without any.
    """
    scale, undistorted = _kernel_scale(measurements, settings), None if views is None else views.undistorted
    points = rotations.new_zeros(1, 3, measurements.num_columns)

    def triangulate(columns: slice) -> None:
        rays = undistorted_keypoints(measurements, columns) if undistorted is None else undistorted[..., columns]
        weights = measurements.confidence[0][:, columns].double() * rays.isfinite().all(1)
        chunk = triangulate_robustly(rotations[0], translations[0], rays.nan_to_num(), weights, scale=scale)
        points[0, :, columns] = chunk.nan_to_num()

    map_with_idle_workers(triangulate, measurements.chunks())
    return points


def _kernel_scale(measurements: Measurements, settings: InitialiseSettings) -> float:
    """Scale of the robust kernels, in normalised image coordinates."""
    return _SUPPORT_SCALE * settings.threshold_px / float(measurements.cameras.focal_px.mean())
