"""Robust linear triangulation from all cameras that see a point."""

from __future__ import annotations

import itertools

import torch
from torch import Tensor

from torchstickcal.geometry.symmetric import IDENTITY, solve

_MIN_DEPTH = 1e-3
_MAX_PAIRS = 36
_POINTS_AT_ONCE = 8_000
"""Points that pairs of views propose at once: few points take as long as many, and many need memory."""
_SAME_PLACE = 1e-6
"""Change of a point, as a share of its depth, below which no further iteration is needed."""
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
        return (weights / (1 + squared / of_points.square())).nan_to_num().sum(-2)

    best = points[:, doubtful]
    score = agreement(best)
    pairs = torch.tensor(_pairs(len(rotations)), device=rays.device)
    for some in pairs.split(max(1, _POINTS_AT_ONCE // len(doubtful))):
        both = weights[some].amin(1) > 0
        given = rotations[some], translations[some], rays[some], both.to(weights)[:, None].expand(-1, 2, -1)
        candidates = triangulate(*given, scale=torch.inf, iterations=2)
        own, index = agreement(candidates.unsqueeze(-3)).where(both, -torch.inf).max(0)
        better = own > score
        chosen = candidates.gather(0, index.expand(1, 3, -1))[0]
        best, score = torch.where(better, chosen, best), torch.where(better, own, score)
    points[:, doubtful] = triangulate(rotations, translations, rays, weights, scale=of_points, start=best)
    return points


def _pairs(cameras: int) -> list[list[int]]:
    """Pairs of cameras, evenly chosen where there are many."""
    pairs = [list(pair) for pair in itertools.combinations(range(cameras), 2)]
    return pairs[:: -(-len(pairs) // _MAX_PAIRS)]


def _squared_residuals(rotations: Tensor, translations: Tensor, rays: Tensor, points: Tensor) -> Tensor:
    """Squared distances (..., C, N) in normalised image coordinates; infinite behind a camera."""
    x, y, z = (rotations @ points + translations[..., None]).unbind(-2)
    front = z > _MIN_DEPTH
    inverse = 1 / z.where(front, 1.0)
    squared = (x * inverse - rays[..., 0, :]).square() + (y * inverse - rays[..., 1, :]).square()
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
        rotations: (..., C, 3, 3), world to camera; leading dimensions are those of all arguments.
        translations: (..., C, 3), world to camera.
        rays: undistorted, normalised image coordinates, (..., C, 2, N).
        weights: (..., C, N), zero if a camera does not see the point.
        scale: scale of the kernel, in normalised image coordinates. Views with a much larger residual have little weight.
        iterations: number of iterations, at most.
        start: points (..., 3, N) by which the views are weighted in the first iteration; None for the weights as given.

    Returns:
        Points (..., 3, N), NaN for points with fewer than two views.
    """
    u, v = rays.unbind(-2)
    first, second, third = rotations[..., None].unbind(-3)
    by_first, by_second, by_third = translations[..., None].unbind(-2)
    rows = torch.stack([u.unsqueeze(-2) * third - first, v.unsqueeze(-2) * third - second])
    targets = torch.stack([by_first - u * by_third, by_second - v * by_third])
    products = torch.cat([(rows[..., axis : axis + 1, :] * rows[..., axis:, :]).sum(0) for axis in range(3)], dim=-2)
    moments = (rows * targets.unsqueeze(-2)).sum(0)
    unseen = ((weights > 0).sum(-2) < 2).unsqueeze(-2)
    identity = products.new_tensor(IDENTITY)[:, None]
    current = weights
    if start is not None:
        current = (
            weights / (1 + _squared_residuals(rotations, translations, rays, start.unsqueeze(-3)) / scale / scale).square()
        )
    towards, bend = rotations[..., 2, :], 1 / scale / scale
    points = depth = rays.new_empty(0)
    for iteration in range(iterations):
        if iteration:
            depth = torch.add(towards @ points, by_third).clamp_min(_MIN_DEPTH)
            algebraic = (rows * points.unsqueeze(-3)).sum(-2).sub_(targets)
            squared = algebraic.square().sum(0)
            current = weights / torch.addcdiv(depth, squared * bend, depth).square()
        share, before = current.unsqueeze(-2), points
        points = solve(torch.where(unseen, identity, (products * share).sum(-3)), (moments * share).sum(-3))
        if 0 < iteration < iterations - 1 and _are_near(points, before, depth):
            break
    return points.where(~unseen, torch.nan)


def _are_near(points: Tensor, before: Tensor, depth: Tensor) -> bool:
    """Whether no point (..., 3, N) has moved by more than a share of its least depth, of (..., C, N)."""
    return bool(((points - before).abs() <= _SAME_PLACE * depth.amin(-2, keepdim=True)).all())
