"""A first estimate of the rig, from nothing: pairs, spanning tree, triangulation (the paper's initialisation)."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
import torch

from torchstickcal.config import InitialiseSettings
from torchstickcal.initialise.graph import propagate, spanning_tree
from torchstickcal.initialise.pairs import relate
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
    find = partial(
        relate,
        rays_np,
        visible_np,
        focal_px.cpu().numpy(),
        max_points=settings.max_points,
        threshold_px=settings.threshold_px,
    )
    common = visible_np.astype(np.int64) @ visible_np.T.astype(np.int64)
    edges = spanning_tree(common, find, labels, settings.min_common_points)
    scale = _SUPPORT_RADIUS * settings.threshold_px / float(focal_px.mean())
    poses = propagate(edges, rays_np, visible_np, scale)
    rotations, translations = (torch.from_numpy(np.ascontiguousarray(p)).to(rays) for p in poses)
    points = triangulate(rotations, translations, rays, measurements.confidence * visible, scale=scale)
    return State(rotations, translations, points.nan_to_num())
