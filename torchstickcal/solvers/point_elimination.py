"""Elimination of points that are coupled within one frame at most: single points (3 x 3) and sticks (6 x 6).

All blocks of N points are factored at once, entry by entry: a symmetric 3 x 3 matrix is six rows of length N in the order
xx xy xz yy yz zz. With H = L L^T the factor serves as L^-1 b (half solve) and as H^-1 b (solve).
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

_RELATIVE_PIVOT_FLOOR = 1e-13


class StickCoupling(NamedTuple):
    """Blocks -M between the two ends of M sticks, each in its frame."""

    starts: Tensor
    """(M,), columns of the starts"""
    ends: Tensor
    """(M,), columns of the ends"""
    blocks: Tensor
    """(6, M), the symmetric matrices M"""


class PointElimination:
    """Cholesky factor of the structure's Hessian.

    Args:
        hessian: diagonal blocks (6, N), positive definite, the sticks' share included.
        sticks: the coupling of stick ends, or None.
    """

    def __init__(self, hessian: Tensor, sticks: StickCoupling | None) -> None:
        self._sticks = sticks
        if sticks is None:
            self._lower = _cholesky(hessian)
            return
        self._coupling = _forward(_cholesky(hessian[:, sticks.starts]), symmetric(sticks.blocks))
        reduced = hessian.clone()
        reduced[:, sticks.ends] -= _gram(self._coupling)
        self._lower = _cholesky(reduced)
        self._carry = _forward(self._lower[:, sticks.ends], self._coupling.transpose(0, 1))

    def half_solve(self, rhs: Tensor) -> Tensor:
        """``L^-1 b`` of right-hand sides (k, 3, N), flattened to (k, 3 N)."""
        solved = _forward(self._lower, rhs)
        if self._sticks is not None:
            at_starts = solved[:, :, self._sticks.starts]
            solved[:, :, self._sticks.ends] += (self._carry[None] * at_starts[:, :, None]).sum(1)
        return solved.flatten(1)

    def back_solve(self, half: Tensor) -> Tensor:
        """``L^-T b`` of a right-hand side (3, N), differentiable by it."""
        if self._sticks is not None:
            starts, ends, _ = self._sticks
            at_ends = _backward(self._lower[:, ends], half[:, ends])
            half = half.index_add(1, starts, (self._coupling * at_ends[:, None]).sum(0))
        return _backward(self._lower, half)

    def solve(self, rhs: Tensor) -> Tensor:
        """``H^-1 b`` of a right-hand side (3, N)."""
        return self.back_solve(self.half_solve(rhs[None]).view_as(rhs))


def symmetric(entries: Tensor) -> Tensor:
    """Symmetric matrices (3, 3, N) of their six distinct entries (6, N)."""
    xx, xy, xz, yy, yz, zz = entries
    return torch.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz]).unflatten(0, (3, 3))


def outer(vectors: Tensor) -> Tensor:
    """The six entries (6, ...) of v v^T for vectors (3, ...)."""
    x, y, z = vectors
    return torch.stack([x * x, x * y, x * z, y * y, y * z, z * z])


def _gram(matrices: Tensor) -> Tensor:
    """The six entries of A A^T, summed over the second axis, for matrices stored as (row, column, M)."""
    a, b, c = matrices
    return torch.stack([(p * q).sum(0) for p, q in ((a, a), (a, b), (a, c), (b, b), (b, c), (c, c))])


def _cholesky(entries: Tensor) -> Tensor:
    """Factors (6, N) as 1/l00 l10 l20 1/l11 l21 1/l22; pivots are kept above rounding."""
    h = entries
    r0 = h[0].rsqrt()
    l10, l20 = h[1] * r0, h[2] * r0
    r1 = torch.maximum(h[3] - l10 * l10, h[3] * _RELATIVE_PIVOT_FLOOR).rsqrt()
    l21 = (h[4] - l20 * l10) * r1
    r2 = torch.maximum(h[5] - l20 * l20 - l21 * l21, h[5] * _RELATIVE_PIVOT_FLOOR).rsqrt()
    return torch.stack([r0, l10, l20, r1, l21, r2])


def _forward(lower: Tensor, rhs: Tensor) -> Tensor:
    """``L^-1 b`` for right-hand sides (..., 3, N)."""
    r0, l10, l20, r1, l21, r2 = lower
    solved = torch.empty_like(rhs)
    x, y, z = solved.unbind(-2)
    torch.mul(rhs[..., 0, :], r0, out=x)
    torch.addcmul(rhs[..., 1, :], l10, x, value=-1, out=y).mul_(r1)
    torch.addcmul(rhs[..., 2, :], l20, x, value=-1, out=z).addcmul_(l21, y, value=-1).mul_(r2)
    return solved


def _backward(lower: Tensor, rhs: Tensor) -> Tensor:
    """``L^-T b`` for a right-hand side (3, N)."""
    r0, l10, l20, r1, l21, r2 = lower
    z = rhs[2] * r2
    y = (rhs[1] - l21 * z) * r1
    x = (rhs[0] - l10 * y - l20 * z) * r0
    return torch.stack([x, y, z])
