"""Robust linear triangulation from all cameras that see a point."""

from __future__ import annotations

import itertools

import torch
from torch import Tensor

from torchstickcal.geometry.symmetric import IDENTITY, solve

_MIN_DEPTH = 1e-3
_MAX_PAIRS = 36
_DOUBTFUL = 3.0
"""Residual of a view, in scales of the kernel, from which the point is triangulated again from pairs of views."""


def triangulate_robustly(
    rotations: Tensor, translations: Tensor, rays: Tensor, weights: Tensor, *, scale: Tensor | float
) -> Tensor:
    """Points that most views agree on, whatever the others say.

    Where a view contradicts the triangulation from all views, every pair of views proposes a point. The proposal on which the
    views agree most is the start from which the point is triangulated again.

    Arguments and result as of :func:`triangulate`; the scale may be one per point, (N,).
    """
    points = triangulate(rotations, translations, rays, weights, scale=scale)
    of_points = torch.as_tensor(scale, dtype=rays.dtype, device=rays.device).expand(rays.shape[2])
    contradicted = (_squared_residuals(rotations, translations, rays, points) > (_DOUBTFUL * of_points).square()) & (
        weights > 0
    )
    doubtful = (contradicted.any(0) & ((weights > 0).sum(0) > 2)).nonzero().flatten()
    if not len(doubtful):
        return points
    rays, weights, of_points = rays[..., doubtful], weights[:, doubtful], of_points[doubtful]

    def agreement(candidates: Tensor) -> Tensor:
        squared = _squared_residuals(rotations, translations, rays, candidates)
        return (weights / (1 + squared / of_points.square())).nan_to_num().sum(0)

    best = points[:, doubtful]
    score = agreement(best)
    for pair in _pairs(len(rotations)):
        both = weights[pair].amin(0) > 0
        chosen = torch.zeros_like(weights)
        chosen[pair] = both.to(weights)
        candidates = triangulate(rotations[pair], translations[pair], rays[pair], chosen[pair], scale=torch.inf, iterations=2)
        own = agreement(candidates)
        better = both & (own > score)
        best, score = torch.where(better, candidates, best), torch.where(better, own, score)
    points[:, doubtful] = triangulate(rotations, translations, rays, weights, scale=of_points, start=best)
    return points


def _pairs(cameras: int) -> list[list[int]]:
    """Pairs of cameras, evenly chosen where there are many."""
    pairs = [list(pair) for pair in itertools.combinations(range(cameras), 2)]
    return pairs[:: -(-len(pairs) // _MAX_PAIRS)]


def _squared_residuals(rotations: Tensor, translations: Tensor, rays: Tensor, points: Tensor) -> Tensor:
    """Squared distances (C, N) in normalised image coordinates; infinite behind a camera."""
    x, y, z = (rotations @ points + translations[..., None]).unbind(1)
    front = z > _MIN_DEPTH
    inverse = 1 / z.where(front, 1.0)
    squared = (x * inverse - rays[:, 0]).square() + (y * inverse - rays[:, 1]).square()
    return squared.where(front, torch.inf)


def triangulate(
    rotations: Tensor,
    translations: Tensor,
    rays: Tensor,
    weights: Tensor,
    *,
    scale: Tensor | float,
    iterations: int = 6,
    start: Tensor | None = None,
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
    if start is not None:
        current = weights / (1 + _squared_residuals(rotations, translations, rays, start) / scale / scale).square()
    points = rays.new_zeros(3, rays.shape[2])
    for _ in range(iterations):
        hessian = torch.where(unseen, identity, (products * current[:, None]).sum(0))
        points = solve(hessian, (moments * current[:, None]).sum(0))
        depth = (rotations[:, 2] @ points + translations[:, 2:]).clamp_min(_MIN_DEPTH)
        algebraic = (rows * points).sum(2) - targets
        squared = algebraic.square().sum(0) / depth.square()
        current = weights / (depth * (1 + squared / scale / scale)).square()
    return points.where(~unseen, torch.nan)
