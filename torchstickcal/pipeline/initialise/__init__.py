"""Initialisation of the rig from keypoints alone, as in the paper: relative poses of pairs, spanning tree, triangulation."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import torch
from torch import Tensor

from torchstickcal.config import InitialiseSettings
from torchstickcal.geometry.triangulation import triangulate_robustly
from torchstickcal.model.measurements import Measurements
from torchstickcal.model.state import State
from torchstickcal.pipeline.initialise.graph import propagate, spanning_tree
from torchstickcal.pipeline.initialise.pairs import relate
from torchstickcal.pipeline.initialise.views import Views, undistorted_keypoints

__all__ = ["initialise", "triangulated"]

_SUPPORT_SCALE = 10.0
"""Scale of the robust kernels in units of the inlier threshold of RANSAC."""


def initialise(measurements: Measurements, settings: InitialiseSettings, labels: Sequence[str]) -> State:
    """Cameras and points up to scale, in the frame of the first camera.

    Args:
        measurements: one session.
        settings: thresholds.
        labels: names of the cameras, for error messages.

    Raises:
        RigError: if the cameras do not have enough common points.
    """
    views = Views(measurements)
    relate_pair = partial(relate, views, max_points=settings.max_points, threshold_px=settings.threshold_px)
    edges = spanning_tree(views.common(), relate_pair, labels, settings.min_common_points)
    poses = propagate(edges, views, _kernel_scale(measurements, settings))
    rotations, translations = (torch.from_numpy(pose)[None].to(measurements.pixels.device) for pose in poses)
    return State.of(rotations, translations, triangulated(measurements, rotations, translations, settings, views))


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
    for columns in measurements.chunks():
        rays = undistorted_keypoints(measurements, columns) if undistorted is None else undistorted[..., columns]
        weights = measurements.confidence[0][:, columns].double() * rays.isfinite().all(1)
        chunk = triangulate_robustly(rotations[0], translations[0], rays.nan_to_num(), weights, scale=scale)
        points[0, :, columns] = chunk.nan_to_num()
    return points


def _kernel_scale(measurements: Measurements, settings: InitialiseSettings) -> float:
    """Scale of the robust kernels, in normalised image coordinates."""
    return _SUPPORT_SCALE * settings.threshold_px / float(measurements.cameras.focal_px.mean())
