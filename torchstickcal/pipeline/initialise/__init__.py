"""A first estimate of the rig, from nothing: pairs, spanning tree, triangulation (the paper's initialisation)."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import torch
from torch import Tensor

from torchstickcal.config import InitialiseSettings
from torchstickcal.model.measurements import Measurements
from torchstickcal.model.state import State
from torchstickcal.pipeline.initialise.graph import propagate, spanning_tree
from torchstickcal.pipeline.initialise.pairs import relate
from torchstickcal.pipeline.initialise.triangulate import triangulate
from torchstickcal.pipeline.initialise.views import Views

__all__ = ["initialise", "triangulated"]

_SUPPORT_RADIUS = 10.0


def initialise(measurements: Measurements, settings: InitialiseSettings, labels: Sequence[str]) -> State:
    """Cameras and points up to scale, in the frame of the first camera.

    Args:
        measurements: one session.
        settings: thresholds.
        labels: the cameras' names, for messages.

    Raises:
        RigError: if the cameras do not hang together.
    """
    views = Views(measurements)
    find = partial(relate, views, max_points=settings.max_points, threshold_px=settings.threshold_px)
    edges = spanning_tree(views.common(), find, labels, settings.min_common_points)
    scale = _scale(measurements, settings)
    poses = propagate(edges, views, scale)
    rotations, translations = (torch.from_numpy(pose)[None].to(measurements.pixels.device) for pose in poses)
    return State.of(rotations, translations, triangulated(measurements, rotations, translations, settings))


def triangulated(measurements: Measurements, rotations: Tensor, translations: Tensor, settings: InitialiseSettings) -> Tensor:
    """The points (1, 3, N) of one session at poses (1, C, 3, 3), (1, C, 3); zero where fewer than two cameras see them."""
    scale = _scale(measurements, settings)
    points = rotations.new_zeros(1, 3, measurements.num_columns)
    for columns in measurements.chunks():
        pixels = measurements.pixels[0][..., columns].double().movedim(1, -1)
        rays = measurements.cameras[0].undistort(pixels).movedim(-1, 1)
        weights = measurements.confidence[0][:, columns].double() * rays.isfinite().all(1)
        found = triangulate(rotations[0], translations[0], rays.nan_to_num(), weights, scale=scale)
        points[0, :, columns] = found.nan_to_num()
    return points


def _scale(measurements: Measurements, settings: InitialiseSettings) -> float:
    """Residual, in normalised coordinates, up to which a keypoint supports a pose."""
    return _SUPPORT_RADIUS * settings.threshold_px / float(measurements.cameras.focal_px.mean())
