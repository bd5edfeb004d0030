"""From points to pixels by kornia's geometry: what the losses are built from, and what autograd differentiates.

:class:`torchstickcal.Intrinsics` has the same projection with derivatives in closed form, for Gauss-Newton. kornia is imported
when a function is first called, since a calibration without autograd does not need it.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchstickcal.geometry.cameras import Intrinsics


def to_cameras(points: Tensor, rotations: Tensor, translations: Tensor) -> Tensor:
    """Points (..., F, P, 3) of the world in every camera's frame, (..., C, F, P, 3), metres.

    Args:
        points: metres.
        rotations: (..., C, 3, 3), world to camera.
        translations: (..., C, 3), world to camera, metres.
    """
    flat = points.flatten(-3, -2).unsqueeze(-3)
    found = flat @ rotations.mT + translations.unsqueeze(-2)
    return found.unflatten(-2, points.shape[-3:-1])


def project(points_cam: Tensor, cameras: Intrinsics) -> Tensor:
    """Pixels (..., C, n, 2), distorted by the lenses, of points (..., C, n, 3) in the cameras' frames."""
    from kornia.geometry.calibration import distort_points
    from kornia.geometry.camera import distort_points_kannala_brandt, project_points_z1

    normalised = project_points_z1(points_cam)
    distortion = cameras.distortion
    if distortion is not None and cameras.fisheye:
        unit = distortion.new_tensor([1.0, 1.0, 0.0, 0.0]).expand(*distortion.shape[:-1], 4)
        normalised = distort_points_kannala_brandt(normalised, torch.cat([unit, distortion], dim=-1).unsqueeze(-2))
    elif distortion is not None:
        normalised = distort_points(normalised, torch.eye(3).to(normalised), distortion)
    return normalised @ cameras.matrix[..., :2, :2].mT + cameras.matrix[..., :2, 2].unsqueeze(-2)
