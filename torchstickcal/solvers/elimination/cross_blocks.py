"""The coupling H_xc of points with cameras, ``N B(X)`` with ``B(X) = [I, -[X]x]``: three columns of N, three derived.

Blocks N are symmetric and stored as their six distinct entries xx xy xz yy yz zz; rows are laid out (camera, tangent, axis of
the point, column), so that a camera's tangent is a row of the matrix that is multiplied with itself.
"""

from __future__ import annotations

import torch
from torch import Tensor


def cross_rows(blocks: Tensor, points: Tensor) -> Tensor:
    """``(N B(X))^T`` as (B, C', 6, 3, n), for blocks (B, C', 6, n) and points (B, 3, n)."""
    rows = blocks.new_empty(*blocks.shape[:2], 6, 3, blocks.shape[-1])
    rows[:, :, :3, 0] = blocks[:, :, :3]
    rows[:, :, 0, 1], rows[:, :, 1:3, 1] = blocks[:, :, 1], blocks[:, :, 3:5]
    rows[:, :, 0, 2], rows[:, :, 1:3, 2] = blocks[:, :, 2], blocks[:, :, 4:]
    add_rotations(rows, points)
    return rows


def add_rotations(rows: Tensor, points: Tensor) -> None:
    """Fill in the rotations' rows (B, C', 3:6, 3, n) of the translations' rows: columns of A, to those of ``-A [X]x``."""
    x, y, z = points[:, None, None].unbind(-2)
    a, b, c = rows[:, :, :3].unbind(2)
    torch.mul(c, y, out=rows[:, :, 3]).addcmul_(b, z, value=-1)
    torch.mul(a, z, out=rows[:, :, 4]).addcmul_(c, x, value=-1)
    torch.mul(b, x, out=rows[:, :, 5]).addcmul_(a, y, value=-1)


def twist_rows(gradients: Tensor) -> Tensor:
    """What the exact Hessian adds to the rotations' rows, ``[g]x^T`` as (B, C', 3, 3, n), for gradients (B, C', 3, n).

    A step of a camera turns the point it sees about the world's origin: ``g . (omega x X)`` has the mixed derivative ``[g]x``.
    """
    x, y, z = gradients.unbind(2)
    zero = torch.zeros_like(x)
    return torch.stack([zero, z, -y, -z, zero, x, y, -x, zero], dim=2).unflatten(2, (3, 3))


def symmetric_times(blocks: Tensor, vectors: Tensor) -> Tensor:
    """``sum_c N_c v_c`` (B, 3, n) for blocks (B, C', 6, n) and vectors (B, C', 3, n)."""
    xx, xy, xz, yy, yz, zz = blocks.unbind(2)
    x, y, z = vectors.unbind(2)
    return torch.stack(
        [
            (xx * x).addcmul_(xy, y).addcmul_(xz, z).sum(1),
            (xy * x).addcmul_(yy, y).addcmul_(yz, z).sum(1),
            (xz * x).addcmul_(yz, y).addcmul_(zz, z).sum(1),
        ],
        dim=1,
    )
