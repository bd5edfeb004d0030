"""Where things are in a drawn scene: which direction is up, and the pyramids of the cameras."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchstickcal.geometry import se3
from torchstickcal.result import Calibration

_FRUSTUM_DEPTH = 0.09
"""Depth of the drawn camera pyramids, as a fraction of the largest distance between two cameras."""


def plot_rotation(calibration: Calibration) -> Tensor:
    """Rotation (3, 3) to axes right, forward and up: those of the world if its z is up, else by the mean of the cameras."""
    if calibration.world.up == "z":
        return torch.eye(3, dtype=torch.float64)
    up = torch.nn.functional.normalize(-calibration.rotations.double().cpu()[:, 1].mean(0), dim=0)
    forward = calibration.rotations.double().cpu()[0, 2]
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, up), dim=0)
    return torch.stack([right, torch.linalg.cross(up, right), up])


def frusta(calibration: Calibration) -> Tensor:
    """Pyramid of each camera, (C, 5, 3): camera centre and the four image corners, in the world."""
    matrix = calibration.intrinsics.double()
    size = 2 * matrix[:, :2, 2] if calibration.image_size is None else calibration.image_size.double()
    centres = calibration.camera_centres.double()
    depth = _FRUSTUM_DEPTH * float(torch.cdist(centres, centres).max())
    unit = matrix.new_tensor([[0, 0], [1, 0], [1, 1], [0, 1]])
    corners = torch.cat([unit * size[:, None], torch.ones_like(unit[:, :1]).expand(len(size), 4, 1)], dim=-1)
    rays = depth * corners @ torch.linalg.inv(matrix).mT
    in_camera = torch.cat([torch.zeros_like(rays[:, :1]), rays], dim=1)
    rotations, translations = calibration.rotations.double(), calibration.translations.double()
    return in_camera @ rotations + se3.camera_centres(rotations, translations)[:, None]


def without_extremes(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """The points between the 2nd and 98th percentile of each coordinate. Wrongly triangulated points can be far away."""
    known = points[np.isfinite(points).all(1)]
    if not len(known):
        return known
    low, high = np.percentile(known, [2, 98], axis=0)
    return known[((known >= low) & (known <= high)).all(1)]
