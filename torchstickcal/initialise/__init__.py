"""A first estimate of the rig, from nothing: pairs, spanning tree, triangulation (the paper's initialisation)."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import torch

from torchstickcal.config import InitialiseSettings
from torchstickcal.initialise.graph import propagate, spanning_tree
from torchstickcal.initialise.pairs import relate
from torchstickcal.initialise.triangulate import triangulate
from torchstickcal.initialise.views import Views
from torchstickcal.problem import Measurements, State

__all__ = ["initialise"]


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
    scale = _SUPPORT_RADIUS * settings.threshold_px / float(measurements.cameras.focal_px.mean())
    poses = propagate(edges, views, scale)
    rotations, translations = (torch.from_numpy(pose).to(measurements.pixels.device) for pose in poses)
    points = rotations.new_zeros(3, measurements.num_columns)
    for columns in measurements.chunks():
        pixels = measurements.pixels[0][..., columns].double().movedim(1, -1)
        rays = measurements.cameras[0].undistort(pixels).movedim(-1, 1)
        weights = measurements.confidence[0][:, columns].double() * rays.isfinite().all(1)
        points[:, columns] = triangulate(rotations, translations, rays.nan_to_num(), weights, scale=scale).nan_to_num()
    return State(rotations[None], translations[None], points[None])
