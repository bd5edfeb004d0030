"""Elimination of points that are coupled within one frame at most: single points (3 x 3) and sticks (6 x 6).

All blocks of N = F P points are factored at once. With H = L L^T the factor serves as L^-1 b (half solve) and as H^-1 b.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from torchstickcal.solvers.cross_blocks import add_rotations
from torchstickcal.symmetric import backward, cholesky, expand, forward, gram

_PART_KEYPOINTS = 10900
"""Keypoints worked on at a time: their arrays stay in the cache, and below the size at which torch starts threads."""


class PointElimination:
    """Cholesky factor of the structure's Hessian.

    Args:
        hessian: diagonal blocks (6, F, P), positive definite, the sticks' share included.
        pairs: (S, 2), the points that are ends of one stick.
        coupling: (6, F, S), blocks M with -M between the two ends of a stick in a frame; None where there is none.
    """

    def __init__(self, hessian: Tensor, pairs: Tensor, coupling: Tensor | None) -> None:
        self._frames, self._points = hessian.shape[1:]
        self._pairs = 0 if coupling is None else len(pairs)
        hessian = hessian.flatten(1)
        if coupling is None:
            self._lower = cholesky(hessian)
            return
        first = self._points * torch.arange(self._frames, device=hessian.device)[:, None]
        self._starts, self._ends = ((first + side).flatten() for side in pairs.unbind(1))
        self._coupling = forward(cholesky(hessian[:, self._starts]), expand(coupling.flatten(1)))
        reduced = hessian.clone()
        reduced[:, self._ends] -= gram(self._coupling)
        self._lower = cholesky(reduced)
        self._carry = forward(self._lower[:, self._ends], self._coupling.transpose(0, 1))

    def half_solve(self, rhs: Tensor) -> Tensor:
        """``L^-1 b`` of a right-hand side (3, N)."""
        half = forward(self._lower, rhs)
        if self._pairs:
            half[:, self._ends] += (self._carry * half[:, self._starts]).sum(1)
        return half

    def back_solve(self, half: Tensor) -> Tensor:
        """``L^-T b`` of a right-hand side (3, N), differentiable by it."""
        if self._pairs:
            at_ends = backward(self._lower[:, self._ends], half[:, self._ends])
            half = half.index_add(1, self._starts, (self._coupling * at_ends).sum(1))
        return backward(self._lower, half)

    def solve(self, rhs: Tensor) -> Tensor:
        """``H^-1 b`` of a right-hand side (3, N)."""
        return self.back_solve(self.half_solve(rhs))

    def variances(self) -> Tensor:
        """Diagonal of H^-1 (3, N) where no stick couples the points."""
        half = forward(self._lower, torch.eye(3).to(self._lower)[..., None].expand(3, 3, self._lower.shape[1]))
        return half.square().sum(0)

    def reductions(self, cross: Tensor, points: Tensor, gradient: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
        """``(L^-1 H_xc)^T`` (6 C', 3 n) and ``L^-1 g`` (3 n,), for some frames at a time.

        Args:
            cross: the blocks N_c of C' cameras, (C', 6, N).
            points: X, (3, N).
            gradient: g, (3, N).
        """
        half = self.half_solve(gradient)
        frames_at_once = max(1, _PART_KEYPOINTS // (self._points * max(1, cross.shape[0])))
        for frame in range(0, self._frames, frames_at_once):
            frames = min(frames_at_once, self._frames - frame)
            columns = slice(frame * self._points, (frame + frames) * self._points)
            rows = _camera_rows(self._lower[:, columns], cross[:, :, columns], points[:, columns])
            if self._pairs:
                sticks = slice(frame * self._pairs, (frame + frames) * self._pairs)
                starts, ends = self._starts[: frames * self._pairs], self._ends[: frames * self._pairs]
                at_starts = rows[..., starts]
                rows[..., ends] += (self._carry[:, :, sticks] * at_starts[:, :, None]).sum(3)
            yield rows.flatten(2).flatten(0, 1), half[:, columns].flatten()


def _camera_rows(lower: Tensor, blocks: Tensor, points: Tensor) -> Tensor:
    """``(L^-1 N B(X))^T`` as (C', 6, 3, n): the forward substitution of N's columns, then the rotations."""
    r0, l10, l20, r1, l21, r2 = lower
    rows = blocks.new_empty(blocks.shape[0], 6, 3, blocks.shape[2])
    x, y, z = rows[:, :3].unbind(2)
    torch.mul(blocks[:, :3], r0, out=x)
    y[:, 0], y[:, 1:] = blocks[:, 1], blocks[:, 3:5]
    y.addcmul_(x, l10, value=-1).mul_(r1)
    z[:, 0], z[:, 1:] = blocks[:, 2], blocks[:, 4:]
    z.addcmul_(x, l20, value=-1).addcmul_(y, l21, value=-1).mul_(r2)
    add_rotations(rows, points)
    return rows
