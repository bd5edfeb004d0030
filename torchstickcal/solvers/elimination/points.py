"""Elimination of single points (3 x 3) and of pairs of points of one frame, as the ends of a stick (6 x 6).

All blocks of a part of the columns are factored at once. With H = L L^T the factor serves as L^-1 b (half solve) and as H^-1 b.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchstickcal.geometry.symmetric import backward, cholesky, forward, gram
from torchstickcal.solvers.elimination.cross_blocks import add_rotations, twist_rows


class PointElimination:
    """Cholesky factor of the structure's Hessian at n columns.

    Args:
        hessian: diagonal blocks (B, 6, n), positive definite, the pairs' shares included.
        starts: (m,), columns of the first points of pairs.
        ends: (m,), columns of their second points.
        coupling: (B, 3, 3, m), the blocks between the first (rows) and the second; None where there is none.
    """

    def __init__(self, hessian: Tensor, starts: Tensor, ends: Tensor, coupling: Tensor | None) -> None:
        self._starts, self._ends, self._coupled = starts, ends, coupling is not None
        if coupling is None:
            self._lower = cholesky(hessian)
            return
        at_starts = cholesky(hessian[..., starts])
        self._coupling = forward(at_starts.unsqueeze(-3), -coupling.transpose(-3, -2))
        reduced = hessian.clone()
        reduced[..., ends] -= gram(self._coupling)
        self._lower = cholesky(reduced)
        self._carry = forward(self._lower[..., ends].unsqueeze(-3), self._coupling.transpose(-3, -2))

    def half_solve(self, rhs: Tensor) -> Tensor:
        """``L^-1 b`` of a right-hand side (B, 3, n)."""
        half = forward(self._lower, rhs)
        if self._coupled:
            half[..., self._ends] += (self._carry * half[..., self._starts].unsqueeze(-2)).sum(-3)
        return half

    def back_solve(self, half: Tensor) -> Tensor:
        """``L^-T b`` of a right-hand side (B, 3, n), differentiable by it."""
        if self._coupled:
            at_ends = backward(self._lower[..., self._ends], half[..., self._ends])
            half = half.index_add(-1, self._starts, (self._coupling * at_ends.unsqueeze(-2)).sum(-3))
        return backward(self._lower, half)

    def solve(self, rhs: Tensor) -> Tensor:
        """``H^-1 b`` of a right-hand side (B, 3, n)."""
        return self.back_solve(self.half_solve(rhs))

    def reductions(
        self, cross: Tensor, points: Tensor, gradient: Tensor, twist: Tensor | None = None, coupling: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """``(L^-1 H_xc)^T`` (B, 6 C' + K, 3 n) and ``L^-1 g`` (B, 3 n).

        Args:
            cross: the blocks N_c of C' cameras, (B, C', 6, n).
            points: X, (B, 3, n).
            gradient: g, (B, 3, n).
            twist: the gradients of each camera's part of the cost, (B, C', 3, n), where H_xc is to be exact.
            coupling: with the cameras' K further unknowns, (B, K, 3, n).
        """
        further = 0 if coupling is None else coupling.shape[1]
        cameras = 6 * cross.shape[1]
        rows = cross.new_empty(len(cross), cameras + further, 3, cross.shape[-1])
        by_camera = rows[:, :cameras].unflatten(1, (-1, 6))
        _fill_camera_rows(by_camera, self._lower, cross, points)
        if twist is not None:
            by_camera[:, :, 3:] += forward(self._lower[:, None, None], twist_rows(twist))
        if coupling is not None:
            rows[:, cameras:] = forward(self._lower[:, None], coupling)
        if self._coupled:
            rows[..., self._ends] += (self._carry[:, None] * rows[..., self._starts].unsqueeze(-2)).sum(-3)
        return rows.flatten(2), self.half_solve(gradient).flatten(1)


def _fill_camera_rows(rows: Tensor, lower: Tensor, blocks: Tensor, points: Tensor) -> None:
    """``(L^-1 N B(X))^T`` into (B, C', 6, 3, n): the forward substitution of N's columns, then the rotations."""
    r0, l10, l20, r1, l21, r2 = lower[:, None, None].unbind(-2)
    x, y, z = rows[:, :, :3].unbind(3)
    torch.mul(blocks[:, :, :3], r0, out=x)
    y[:, :, 0], y[:, :, 1:] = blocks[:, :, 1], blocks[:, :, 3:5]
    y.addcmul_(x, l10, value=-1).mul_(r1)
    z[:, :, 0], z[:, :, 1:] = blocks[:, :, 2], blocks[:, :, 4:]
    z.addcmul_(x, l20, value=-1).addcmul_(y, l21, value=-1).mul_(r2)
    add_rotations(rows, points)
