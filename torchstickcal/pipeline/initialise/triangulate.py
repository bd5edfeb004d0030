"""Robust linear triangulation from all cameras that see a point."""

from __future__ import annotations

import torch
from torch import Tensor

from torchstickcal.geometry.symmetric import IDENTITY, solve

_MIN_DEPTH = 1e-3


def triangulate(
    rotations: Tensor, translations: Tensor, rays: Tensor, weights: Tensor, *, scale: float, iterations: int = 6
) -> Tensor:
    """N-view DLT (direct linear transform) of N points, in its inhomogeneous form.

    Each view gives two linear equations in the point. From the second iteration on, the equations are divided by the depth, so
    that their residuals are distances in the image, and the views are weighted by the Geman-McClure kernel.

    Args:
        rotations: (C, 3, 3), world to camera.
        translations: (C, 3), world to camera.
        rays: undistorted, normalised image coordinates, (C, 2, N).
        weights: (C, N), zero if a camera does not see the point.
        scale: scale of the kernel, in normalised image coordinates. Views with a much larger residual have little weight.
        iterations: number of iterations.

    Returns:
        Points (3, N), NaN for points with fewer than two views.
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
        current = weights / (depth * (1 + squared / scale / scale)).square()
    return points.where(~unseen, torch.nan)
