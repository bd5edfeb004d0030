"""A first estimate of the rig, from nothing: pairs, spanning tree, triangulation (the paper's initialisation)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from torchstickcal.config import InitialiseSettings
from torchstickcal.initialise.graph import propagate, spanning_tree
from torchstickcal.initialise.pairs import relative_poses
from torchstickcal.initialise.triangulate import triangulate
from torchstickcal.problem import Measurements, State

__all__ = ["initialise"]


_SUPPORT_RADIUS = 10.0


def initialise(measurements: Measurements, settings: InitialiseSettings, labels: Sequence[str]) -> State:
    """Cameras and points up to scale, in the frame of the first camera.

    Args:
        measurements: the session.
        settings: thresholds.
        labels: the cameras' names, for messages.

    Raises:
        RigError: if the cameras do not hang together.
    """
    rays = measurements.cameras.undistort(measurements.pixels.movedim(1, -1)).movedim(-1, 1)
    visible = measurements.visible & rays.isfinite().all(1)
    rays = rays.nan_to_num()
    focal_px = measurements.cameras.focal_px
    rays_np, visible_np = rays.cpu().numpy(), visible.cpu().numpy()
    pairs = relative_poses(
        rays_np,
        visible_np,
        focal_px.cpu().numpy(),
        min_common=settings.min_common_points,
        max_points=settings.max_points,
        threshold_px=settings.threshold_px,
    )
    edges = spanning_tree(pairs, labels, settings.min_common_points)
    scale = _SUPPORT_RADIUS * settings.threshold_px / float(focal_px.mean())
    poses = propagate(edges, rays_np, visible_np, scale)
    rotations, translations = (torch.from_numpy(np.ascontiguousarray(p)).to(rays) for p in poses)
    points = triangulate(rotations, translations, rays, measurements.confidence * visible, scale=scale)
    return State(rotations, translations, points.nan_to_num())
