"""Elimination of single points (3 x 3 blocks) and of pairs of points in one frame, such as the ends of a stick (6 x 6 blocks).

The Hessian of n columns is factored at once, ``H = L L^T``.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchstickcal.geometry.symmetric import backward, cholesky, forward, gram
from torchstickcal.solvers.elimination.cross_blocks import add_rotation_rows, rotation_curvature_rows


class PointElimination:
    """Cholesky factor L of the points' Hessian for n columns.

    With a pair's Hessian ``[[A, C], [C^T, D]]``, A = L_A L_A^T and D - C^T A^-1 C = L_D L_D^T, the factor of the pair is
    ``[[L_A, 0], [C^T L_A^-T, L_D]]``.

    Args:
        hessian: diagonal blocks, (B, 6, n), positive definite. They include all losses, also those that couple pairs.
        first: (m,), columns of the first points of the pairs.
        second: (m,), columns of the second points of the pairs.
        pair_blocks: C, the blocks between first (rows) and second points, (B, 3, 3, m); None if no points are coupled.
    """

    def __init__(self, hessian: Tensor, first: Tensor, second: Tensor, pair_blocks: Tensor | None) -> None:
        self._first, self._second, self._has_pairs = first, second, pair_blocks is not None
        if pair_blocks is None:
            self._lower = cholesky(hessian)
            return
        lower_first = cholesky(hessian[..., first])
        self._pair_factor = forward(lower_first.unsqueeze(-3), -pair_blocks.transpose(-3, -2))
        """-L_A^-1 C, stored as (B, column, row, m)"""
        schur = hessian.clone()
        schur[..., second] -= gram(self._pair_factor)
        self._lower = cholesky(schur)
        self._first_to_second = forward(self._lower[..., second].unsqueeze(-3), self._pair_factor.transpose(-3, -2))
        """-L_D^-1 C^T L_A^-T, stored as (B, column, row, m)"""

    def forward_solve(self, rhs: Tensor) -> Tensor:
        """``L^-1 b`` (B, 3 n) for right-hand sides b, (B, 3, n)."""
        solved = forward(self._lower, rhs)
        if self._has_pairs:
            solved[..., self._second] += (self._first_to_second * solved[..., self._first].unsqueeze(-2)).sum(-3)
        return solved.flatten(1)

    def backward_solve(self, solved: Tensor) -> Tensor:
        """``L^-T y`` (B, 3, n) for y as :meth:`forward_solve` returns it, (B, 3 n). Differentiable with respect to y."""
        rhs = solved.unflatten(1, (3, -1))
        if self._has_pairs:
            second = backward(self._lower[..., self._second], rhs[..., self._second])
            rhs = rhs.index_add(-1, self._first, (self._pair_factor * second.unsqueeze(-2)).sum(-3))
        return backward(self._lower, rhs)

    def solve(self, rhs: Tensor) -> Tensor:
        """``H^-1 b`` for right-hand sides b, (B, 3, n)."""
        return self.backward_solve(self.forward_solve(rhs))

    def forward_solve_cross(
        self,
        camera_blocks: Tensor,
        camera_gradients: Tensor | None,
        unknown_blocks: Tensor | None,
        points: Tensor,
    ) -> Tensor:
        """``(L^-1 H_xc)^T`` (B, 6 C' + K, 3 n), with the K lens and clock unknowns last.

        Args:
            camera_blocks: N_c of C' cameras, (B, C', 6, n).
            camera_gradients: the gradient of each camera's part of the cost, (B, C', 3, n), for the exact Hessian; None for the
                Gauss-Newton Hessian.
            unknown_blocks: H_xk, the blocks between the points and the lens and clock unknowns, (B, K, 3, n); None without such
                unknowns.
            points: X, (B, 3, n).
        """
        unknowns = 0 if unknown_blocks is None else unknown_blocks.shape[1]
        tangents = 6 * camera_blocks.shape[1]
        rows = camera_blocks.new_empty(len(camera_blocks), tangents + unknowns, 3, camera_blocks.shape[-1])
        by_camera = rows[:, :tangents].unflatten(1, (-1, 6))
        _fill_camera_rows(by_camera, self._lower, camera_blocks, points)
        if camera_gradients is not None:
            by_camera[:, :, 3:] += forward(self._lower[:, None, None], rotation_curvature_rows(camera_gradients))
        if unknown_blocks is not None:
            rows[:, tangents:] = forward(self._lower[:, None], unknown_blocks)
        if self._has_pairs:
            rows[..., self._second] += (self._first_to_second[:, None] * rows[..., self._first].unsqueeze(-2)).sum(-3)
        return rows.flatten(2)


def _fill_camera_rows(rows: Tensor, lower: Tensor, blocks: Tensor, points: Tensor) -> None:
    """Write ``(L^-1 N_c B(X))^T`` into rows (B, C', 6, 3, n): forward substitution of N_c's columns, then the rotation rows."""
    r0, l10, l20, r1, l21, r2 = lower[:, None, None].unbind(-2)
    x, y, z = rows[:, :, :3].unbind(3)
    torch.mul(blocks[:, :, :3], r0, out=x)
    y[:, :, 0], y[:, :, 1:] = blocks[:, :, 1], blocks[:, :, 3:5]
    y.addcmul_(x, l10, value=-1).mul_(r1)
    z[:, :, 0], z[:, :, 1:] = blocks[:, :, 2], blocks[:, :, 4:]
    z.addcmul_(x, l20, value=-1).addcmul_(y, l21, value=-1).mul_(r2)
    add_rotation_rows(rows, points)
