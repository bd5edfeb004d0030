"""Symmetric 3 x 3 matrices, many at once, coordinates first.

A matrix is stored as its six distinct entries xx xy xz yy yz zz, a (6, N) tensor for N of them, and every operation runs over
all N entry by entry.
"""

from __future__ import annotations

import torch
from torch import Tensor

DIAGONAL = [0, 3, 5]
"""The entries on the diagonal."""

IDENTITY = (1.0, 0.0, 0.0, 1.0, 0.0, 1.0)
"""The entries of the identity."""

_RELATIVE_PIVOT_FLOOR = 1e-13


def expand(entries: Tensor) -> Tensor:
    """Symmetric matrices (3, 3, ...) of their six distinct entries (6, ...)."""
    xx, xy, xz, yy, yz, zz = entries
    return torch.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz]).unflatten(0, (3, 3))


def outer(vectors: Tensor) -> Tensor:
    """The six entries (6, ...) of v v^T for vectors (3, ...)."""
    x, y, z = vectors
    return torch.stack([x * x, x * y, x * z, y * y, y * z, z * z])


def gram(matrices: Tensor) -> Tensor:
    """The six entries of A^T A, for matrices stored as (row, column, M)."""
    a, b, c = matrices.unbind(1)
    return torch.stack([(p * q).sum(0) for p, q in ((a, a), (a, b), (a, c), (b, b), (b, c), (c, c))])


def cholesky(entries: Tensor) -> Tensor:
    """Factors (6, N) as 1/l00 l10 l20 1/l11 l21 1/l22; pivots are kept above rounding."""
    xx, xy, xz, yy, yz, zz = entries
    r0 = xx.rsqrt()
    l10, l20 = xy * r0, xz * r0
    r1 = torch.maximum(torch.addcmul(yy, l10, l10, value=-1), yy * _RELATIVE_PIVOT_FLOOR).rsqrt()
    l21 = torch.addcmul(yz, l20, l10, value=-1) * r1
    pivot = torch.addcmul(zz, l20, l20, value=-1).addcmul_(l21, l21, value=-1)
    r2 = torch.maximum(pivot, zz * _RELATIVE_PIVOT_FLOOR).rsqrt()
    return torch.stack([r0, l10, l20, r1, l21, r2])


def forward(lower: Tensor, rhs: Tensor) -> Tensor:
    """``L^-1 b`` for right-hand sides (3, ..., N)."""
    r0, l10, l20, r1, l21, r2 = lower
    x = rhs[0] * r0
    y = torch.addcmul(rhs[1], l10, x, value=-1) * r1
    z = torch.addcmul(rhs[2], l20, x, value=-1).addcmul_(l21, y, value=-1) * r2
    return torch.stack([x, y, z])


def backward(lower: Tensor, rhs: Tensor) -> Tensor:
    """``L^-T b`` for a right-hand side (3, N)."""
    r0, l10, l20, r1, l21, r2 = lower
    z = rhs[2] * r2
    y = (rhs[1] - l21 * z) * r1
    x = (rhs[0] - l10 * y - l20 * z) * r0
    return torch.stack([x, y, z])


def solve(entries: Tensor, rhs: Tensor) -> Tensor:
    """``A^-1 b`` for positive definite matrices (6, N) and right-hand sides (3, N)."""
    lower = cholesky(entries)
    return backward(lower, forward(lower, rhs))
