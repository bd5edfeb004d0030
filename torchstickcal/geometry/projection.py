"""From points to pixels by kornia's geometry: what the losses are built from, and what autograd differentiates.

:class:`torchstickcal.Intrinsics` has the same projection with derivatives in closed form, for Gauss-Newton. kornia is imported
when a function is first called, since a calibration without autograd does not need it.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchstickcal.geometry.cameras import Intrinsics, away_from_zero

_WIDEST = 20.0
"""Distance from the axis, in normalised coordinates, up to which the powers of OpenCV's standard lens model fit into
float32. No lens sees as far."""


def to_cameras(points: Tensor, rotations: Tensor, translations: Tensor) -> Tensor:
    """Points (..., F, P, 3) of the world in every camera's frame, (..., C, F, P, 3), metres.

    Args:
        points: metres.
        rotations: (..., C, 3, 3), world to camera.
        translations: (..., C, 3), world to camera, metres.
    """
    by_coordinate = rotations @ points.flatten(-3, -2).mT.unsqueeze(-3) + translations.unsqueeze(-1)
    return by_coordinate.mT.unflatten(-2, points.shape[-3:-1])


def project(points_cam: Tensor, cameras: Intrinsics) -> Tensor:
    """Pixels (..., C, n, 2), distorted by the lenses, of points (..., C, n, 3) in the cameras' frames, metres.

    Pixels and their gradients are finite for every point, also beside and behind a camera and in its centre.
    """
    from kornia.geometry.calibration import distort_points
    from kornia.geometry.camera import distort_points_kannala_brandt
    from kornia.geometry.conversions import denormalize_points_with_intrinsics

    normalised = points_cam[..., :2] / away_from_zero(points_cam[..., 2:])
    matrix, distortion = cameras.matrix, cameras.distortion
    if distortion is None:
        pixels = denormalize_points_with_intrinsics(normalised, matrix)
    elif cameras.fisheye:
        pinhole = torch.cat([matrix[..., [0, 1], [0, 1]], matrix[..., :2, 2]], dim=-1)
        pixels = distort_points_kannala_brandt(normalised, torch.cat([pinhole, distortion], dim=-1).unsqueeze(-2))
    else:
        pixels = distort_points(_limited(normalised), matrix, distortion, new_K=torch.eye(3).to(normalised))
    return _with_skew(pixels, matrix)


def _limited(normalised: Tensor) -> Tensor:
    """Normalised coordinates (..., 2), in float32 drawn in towards the axis where they are farther from it than lenses see."""
    if normalised.dtype != torch.float32:
        return normalised
    excess = normalised.square().sum(-1, keepdim=True) / _WIDEST**2
    return normalised * excess.clamp_min(1.0).rsqrt()


def _with_skew(pixels: Tensor, matrix: Tensor) -> Tensor:
    """What kornia's camera matrices leave out: the skew shifts a pixel along x by its height above the centre."""
    skew = matrix[..., 0, 1, None]
    if not (skew.requires_grad or bool(skew.any())):
        return pixels
    x, y = pixels.unbind(-1)
    return torch.stack([x + skew * (y - matrix[..., 1, 2, None]) / matrix[..., 1, 1, None], y], dim=-1)
