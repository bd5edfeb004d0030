"""Linear triangulation over all cameras that see a point, re-weighted against outliers."""

from __future__ import annotations

import torch
from torch import Tensor

from torchstickcal.geometry.symmetric import IDENTITY, solve

_MIN_DEPTH = 1e-3


def triangulate(
    rotations: Tensor, translations: Tensor, rays: Tensor, weights: Tensor, *, scale: float, iterations: int = 6
) -> Tensor:
    """N-view DLT of N points, in its inhomogeneous form.

    Each view gives two equations that are linear in the point. From the second iteration on they are divided by the depth,
    so that they measure distances in the image, and weighted down by Geman and McClure's kernel beyond ``scale``.

    Args:
        rotations: (C, 3, 3) and translations: (C, 3), world to camera.
        rays: undistorted, normalised coordinates (C, 2, N).
        weights: (C, N), zero where a camera does not see the point.
        scale: residual, in normalised coordinates, beyond which a view is taken for an outlier.
        iterations: number of re-weightings.

    Returns:
        (3, N); NaN at points with fewer than two views.
    """
    u, v = rays.unbind(1)
    by_axis, offset = rotations.mT[..., None], translations[..., None]
    rows = torch.stack([u[:, None] * by_axis[:, :, 2] - by_axis[:, :, 0], v[:, None] * by_axis[:, :, 2] - by_axis[:, :, 1]])
    targets = torch.stack([offset[:, 0] - u * offset[:, 2], offset[:, 1] - v * offset[:, 2]])
    xx, xy, xz = (rows[:, :, :1] * rows).sum(0).unbind(1)
    yy, yz = (rows[:, :, 1] * rows[:, :, 1]).sum(0), (rows[:, :, 1] * rows[:, :, 2]).sum(0)
    zz = (rows[:, :, 2] * rows[:, :, 2]).sum(0)
    products = torch.stack([xx, xy, xz, yy, yz, zz], dim=1)
    moments = (rows * targets[:, :, None]).sum(0)
    unseen = (weights > 0).sum(0) < 2
    identity = products.new_tensor(IDENTITY)[:, None]
    current = weights
    points = rays.new_zeros(3, rays.shape[2])
    for _ in range(iterations):
        hessian = torch.where(unseen, identity, (products * current[:, None]).sum(0))
        points = solve(hessian, (moments * current[:, None]).sum(0))
        depth = (rotations[:, 2] @ points + translations[:, 2:]).clamp_min(_MIN_DEPTH)
        algebraic = (rows * points).sum(2) - targets
        squared = algebraic.square().sum(0) / depth.square()
        current = weights / (depth * (1 + squared / scale**2)).square()
    return points.where(~unseen, torch.nan)
