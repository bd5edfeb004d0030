"""Blocks H_xc of the Hessian between points and cameras: ``H_xc = N_c B(X)`` with ``B(X) = [I, -[X]x]``.

N_c is the 3 x 3 Hessian block of camera c with respect to the point X. The three translation columns of H_xc are N_c itself,
and the three rotation columns follow from them.

N_c is stored as its six distinct entries xx xy xz yy yz zz. The result is stored transposed, as rows (camera, tangent, axis of
the point, column), because the Schur complement multiplies these rows with each other.
"""

from __future__ import annotations

import torch
from torch import Tensor


def cross_rows(blocks: Tensor, points: Tensor) -> Tensor:
    """``H_xc^T = (N_c B(X))^T`` as (B, C', 6, 3, n), for blocks N_c (B, C', 6, n) and points (B, 3, n)."""
    rows = blocks.new_empty(*blocks.shape[:2], 6, 3, blocks.shape[-1])
    rows[:, :, :3, 0] = blocks[:, :, :3]
    rows[:, :, 0, 1], rows[:, :, 1:3, 1] = blocks[:, :, 1], blocks[:, :, 3:5]
    rows[:, :, 0, 2], rows[:, :, 1:3, 2] = blocks[:, :, 2], blocks[:, :, 4:]
    add_rotation_rows(rows, points)
    return rows


def add_rotation_rows(rows: Tensor, points: Tensor) -> None:
    """Fill the rotation rows (B, C', 3:6, 3, n) from the translation rows A^T: they are the columns of ``-A [X]x``."""
    x, y, z = points[:, None, None].unbind(-2)
    a, b, c = rows[:, :, :3].unbind(2)
    torch.mul(c, y, out=rows[:, :, 3]).addcmul_(b, z, value=-1)
    torch.mul(a, z, out=rows[:, :, 4]).addcmul_(c, x, value=-1)
    torch.mul(b, x, out=rows[:, :, 5]).addcmul_(a, y, value=-1)


def rotation_curvature_rows(gradients: Tensor) -> Tensor:
    """Addition of the exact Hessian to the rotation rows: ``[g]x^T`` as (B, C', 3, 3, n), for gradients g (B, C', 3, n).

    A rotation step omega of a camera moves the point X by ``omega x X``. So ``g . (omega x X)`` has the mixed second derivative
    ``[g]x``.
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
