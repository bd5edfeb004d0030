"""Symmetric 3 x 3 matrices, many at once, coordinates before their number.

A matrix is stored as its six distinct entries xx xy xz yy yz zz, a (..., 6, N) tensor for N of them, and every operation runs
over all N entry by entry.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

DIAGONAL = [0, 3, 5]
"""The entries on the diagonal."""

IDENTITY = (1.0, 0.0, 0.0, 1.0, 0.0, 1.0)
"""The entries of the identity."""

_ENTRIES = [0, 1, 2, 1, 3, 4, 2, 4, 5]
_RELATIVE_PIVOT_FLOOR = {torch.float64: 1e-13, torch.float32: 1e-6}


def expand(entries: Tensor) -> Tensor:
    """Symmetric matrices (..., 3, 3, N) of their six distinct entries (..., 6, N)."""
    return entries[..., _ENTRIES, :].unflatten(-2, (3, 3))


def six_entries(matrices: Tensor) -> Tensor:
    """The six distinct entries (..., 6, N) of symmetric matrices (..., 3, 3, N)."""
    return torch.stack([matrices[..., i, j, :] for i in range(3) for j in range(i, 3)], dim=-2)


def outer(vectors: Tensor) -> Tensor:
    """The six entries (..., 6, N) of v v^T for vectors (..., 3, N)."""
    x, y, z = vectors.unbind(-2)
    return torch.stack([x * x, x * y, x * z, y * y, y * z, z * z], dim=-2)


def symmetric_product(a: Tensor, b: Tensor) -> Tensor:
    """The six entries (..., 6, N) of a b^T + b a^T for vectors (..., 3, N)."""
    rows = zip(a.split(1, dim=-2), b.split(1, dim=-2), range(3), strict=True)
    return torch.cat([(own_a * b[..., i:, :]).addcmul(own_b, a[..., i:, :]) for own_a, own_b, i in rows], dim=-2)


def gram(matrices: Tensor) -> Tensor:
    """The six entries (..., 6, N) of A^T A, for matrices stored as (..., column, row, N)."""
    a, b, c = matrices.unbind(-3)
    return torch.stack([(p * q).sum(-2) for p, q in ((a, a), (a, b), (a, c), (b, b), (b, c), (c, c))], dim=-2)


def raised(entries: Tensor, damping: Tensor | float) -> Tensor:
    """The matrices (..., 6, N) with their diagonals multiplied by 1 + damping, a number or (...)."""
    factor = 1 + torch.as_tensor(damping, dtype=entries.dtype, device=entries.device)
    raised = entries.clone()
    raised[..., DIAGONAL, :] *= factor[..., None, None]
    return raised


def are_definite(entries: Tensor) -> Tensor:
    """Whether all of some matrices (..., 6, N) are positive definite, (...)."""
    xx, xy, xz, yy, yz, zz = entries.unbind(-2)
    minor = xx * yy - xy * xy
    determinant = zz * minor - xx * yz * yz - yy * xz * xz + 2 * xy * xz * yz
    return ((xx > 0) & (minor > 0) & (determinant > 0)).all(-1)


def cholesky(entries: Tensor) -> Tensor:
    """Factors (..., 6, N) as 1/l00 l10 l20 1/l11 l21 1/l22; pivots are kept above rounding."""
    return torch.stack(_factors(entries), dim=-2)


def forward(lower: Tensor, rhs: Tensor) -> Tensor:
    """``L^-1 b`` for right-hand sides (..., 3, N)."""
    return torch.stack(_forward(lower.unbind(-2), rhs.unbind(-2)), dim=-2)


def backward(lower: Tensor, rhs: Tensor) -> Tensor:
    """``L^-T b`` for right-hand sides (..., 3, N)."""
    return torch.stack(_backward(lower.unbind(-2), rhs.unbind(-2)), dim=-2)


def solve(entries: Tensor, rhs: Tensor) -> Tensor:
    """``A^-1 b`` for positive definite matrices (..., 6, N) and right-hand sides (..., 3, N)."""
    factors = _factors(entries)
    return torch.stack(_backward(factors, _forward(factors, rhs.unbind(-2))), dim=-2)


def _factors(entries: Tensor) -> tuple[Tensor, ...]:
    """Each of those of :func:`cholesky`, (..., N)."""
    floor = _RELATIVE_PIVOT_FLOOR[entries.dtype]
    xx, xy, xz, yy, yz, zz = entries.unbind(-2)
    r0 = xx.rsqrt()
    l10, l20 = xy * r0, xz * r0
    r1 = torch.maximum(torch.addcmul(yy, l10, l10, value=-1), yy * floor).rsqrt()
    l21 = torch.addcmul(yz, l20, l10, value=-1) * r1
    pivot = torch.addcmul(zz, l20, l20, value=-1).addcmul_(l21, l21, value=-1)
    r2 = torch.maximum(pivot, zz * floor).rsqrt()
    return r0, l10, l20, r1, l21, r2


def _forward(factors: Sequence[Tensor], rhs: Sequence[Tensor]) -> tuple[Tensor, ...]:
    r0, l10, l20, r1, l21, r2 = factors
    b0, b1, b2 = rhs
    x = b0 * r0
    y = torch.addcmul(b1, l10, x, value=-1) * r1
    z = torch.addcmul(b2, l20, x, value=-1).addcmul_(l21, y, value=-1) * r2
    return x, y, z


def _backward(factors: Sequence[Tensor], rhs: Sequence[Tensor]) -> tuple[Tensor, ...]:
    r0, l10, l20, r1, l21, r2 = factors
    b0, b1, b2 = rhs
    z = b2 * r2
    y = torch.addcmul(b1, l21, z, value=-1) * r1
    x = torch.addcmul(b0, l10, y, value=-1).addcmul_(l20, z, value=-1) * r0
    return x, y, z


def inverse_diagonal(entries: Tensor) -> Tensor:
    """Diagonals (..., 3, N) of the inverses of positive definite matrices (..., 6, N)."""
    r0, l10, l20, r1, l21, r2 = cholesky(entries).unbind(-2)
    m10, m21 = -l10 * r0 * r1, -l21 * r1 * r2
    m20 = -(l20 * r0 + l21 * m10) * r2
    return torch.stack([r0 * r0 + m10 * m10 + m20 * m20, r1 * r1 + m21 * m21, r2 * r2], dim=-2)
