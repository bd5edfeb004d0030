"""Elimination of tracks: points that losses couple over time. It is exact, and its cost is linear in the number of frames.

A second difference couples three consecutive frames. With two or more frames per block the Hessian of a track is therefore
block tridiagonal. It is factored by cyclic reduction: all odd blocks of all tracks are eliminated at once. A block tridiagonal
matrix with half as many blocks remains, and is reduced in the same way. Points that losses couple within a frame, such as the
ends of a stick, form one track.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchstickcal.geometry.symmetric import expand
from torchstickcal.solvers.elimination.cross_blocks import cross_rows, rotation_curvature_rows

_ROWS_PER_BLOCK = 12
"""About as many rows as a block should have: small matrices take a multiple of their arithmetic, large ones have more of it."""


class _Level(NamedTuple):
    """One level of the cyclic reduction, in which the odd blocks are eliminated."""

    inverse: Tensor
    """inverses L^-1 of the Cholesky factors of the odd blocks"""
    left: Tensor
    """L^-1 times the block between an odd block and the even block before it"""
    right: Tensor
    """L^-1 times the block between an odd block and the even block after it"""


class BlockTridiagonal:
    """Cholesky factor L of symmetric, positive definite, block tridiagonal matrices. Blocks are in the order of elimination.

    Args:
        diagonal: the G diagonal blocks, (..., G, m, m).
        below: the blocks below the diagonal, block (g + 1, g) at index g, (..., G - 1, m, m).
    """

    def __init__(self, diagonal: Tensor, below: Tensor) -> None:
        self._levels: list[_Level] = []
        self.counts: list[int] = []
        """the number of blocks eliminated at each level"""
        while diagonal.shape[-3] > 1:
            inverse = _inverse_factor(diagonal[..., 1::2, :, :])
            to_right = below[..., 1::2, :, :].mT
            left = inverse @ below[..., 0::2, :, :]
            right = inverse[..., : to_right.shape[-3], :, :] @ to_right
            diagonal = diagonal[..., 0::2, :, :].clone()
            diagonal[..., : left.shape[-3], :, :] -= left.mT @ left
            diagonal[..., 1 : 1 + right.shape[-3], :, :] -= right.mT @ right
            below = -right.mT @ left[..., : right.shape[-3], :, :]
            self._levels.append(_Level(inverse, left, right))
            self.counts.append(inverse.shape[-3])
        self.counts.append(1)
        self._last = _inverse_factor(diagonal)

    def forward_solve(self, rhs: Tensor) -> list[Tensor]:
        """``L^-1 b`` for right-hand sides b, (..., G, m, k): one tensor per level, in the order of elimination."""
        solved: list[Tensor] = []
        for level in self._levels:
            odd = level.inverse @ rhs[..., 1::2, :, :]
            rhs = rhs[..., 0::2, :, :].clone()
            count = level.right.shape[-3]
            rhs[..., : odd.shape[-3], :, :] -= level.left.mT @ odd
            rhs[..., 1 : 1 + count, :, :] -= level.right.mT @ odd[..., :count, :, :]
            solved.append(odd)
        return [*solved, self._last @ rhs]

    def backward_solve(self, solved: list[Tensor]) -> Tensor:
        """``L^-T y`` (..., G, m, k), for y as returned by :meth:`forward_solve`."""
        x = self._last.mT @ solved[-1]
        for level, y in zip(reversed(self._levels), reversed(solved[:-1]), strict=True):
            count = level.right.shape[-3]
            y = y - level.left @ x[..., : y.shape[-3], :, :]
            y[..., :count, :, :] -= level.right @ x[..., 1 : 1 + count, :, :]
            merged = x.new_empty(*x.shape[:-3], x.shape[-3] + y.shape[-3], *x.shape[-2:])
            merged[..., 0::2, :, :], merged[..., 1::2, :, :] = x, level.inverse.mT @ y
            x = merged
        return x


def _inverse_factor(blocks: Tensor) -> Tensor:
    """Inverses of the Cholesky factors of the blocks (..., m, m); NaN for blocks that are not positive definite."""
    identity = torch.eye(blocks.shape[-1], dtype=blocks.dtype, device=blocks.device).expand_as(blocks)
    factor, failed = torch.linalg.cholesky_ex(blocks)
    if bool(failed.any()):
        factor = factor.where(failed[..., None, None] == 0, torch.nan)
    return torch.linalg.solve_triangular(factor, identity, upper=False)


class TrackElimination:
    """Cholesky factor L of the points' Hessian for T tracks, with q points per track and frame.

    Args:
        hessian: diagonal blocks, (B, 6, T, F, q), entries xx xy xz yy yz zz. They include all losses.
        within: blocks between different points of a track in one frame, (B, T, F, 3 q, 3 q), zero on the diagonal; None if q is
            1.
        between: the blocks between frames f and f + 1, (B, F - 1, T, q), and between f and f + 2, (B, F - 2, T, q), as factors
            of the identity; None if no loss couples frames. Each frame is then eliminated independently.
    """

    def __init__(self, hessian: Tensor, within: Tensor | None, between: tuple[Tensor, Tensor] | None) -> None:
        diagonal = _block_diagonal(hessian)
        if within is not None:
            diagonal = diagonal + within
        sessions, tracks, frames, _, _ = diagonal.shape
        if between is None:
            tracks, frames = tracks * frames, 1
            empty = hessian.new_zeros(sessions, 0, tracks, hessian.shape[-1])
            between = empty, empty
        self._shape = tracks, frames, hessian.shape[-1]
        by_track = diagonal.reshape(sessions * tracks, frames, *diagonal.shape[-2:])
        next_frame, second_frame = (factors.transpose(1, 2).flatten(0, 1).repeat_interleave(3, -1) for factors in between)
        self._size = max(2, min(_ROWS_PER_BLOCK // (3 * hessian.shape[-1]), frames))
        """frames per block"""
        self._factor = BlockTridiagonal(*_block_tridiagonal(by_track, next_frame, second_frame, self._size))

    def forward_solve(self, rhs: Tensor) -> Tensor:
        """``L^-1 b`` for right-hand sides b, (B, 3, n): (B, 3 n'), in the order of elimination, with n' >= n."""
        return self._forward_solve(rhs[:, None])[:, 0]

    def backward_solve(self, solved: Tensor) -> Tensor:
        """``L^-T y`` (B, 3, n) for y as :meth:`forward_solve` returns it."""
        tracks, frames, points = self._shape
        rows = self._size * 3 * points
        sizes = [tracks * count * rows for count in self._factor.counts]
        levels = [
            level.reshape(len(solved) * tracks, count, rows, 1)
            for level, count in zip(solved.split(sizes, dim=1), self._factor.counts, strict=True)
        ]
        by_frame = self._factor.backward_solve(levels).reshape(len(solved), tracks, -1, points, 3)[:, :, :frames]
        return by_frame.permute(0, 4, 1, 2, 3).flatten(2)

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
        """As :meth:`PointElimination.forward_solve_cross`, but with the columns in the order of elimination."""
        rows = cross_rows(camera_blocks, points)
        if camera_gradients is not None:
            rows[:, :, 3:] += rotation_curvature_rows(camera_gradients)
        rows = rows.flatten(1, 2)
        if unknown_blocks is not None:
            rows = torch.cat([rows, unknown_blocks], dim=1)
        return self._forward_solve(rows)

    def _forward_solve(self, rows: Tensor) -> Tensor:
        """``L^-1 b`` for k right-hand sides (B, k, 3, n), (B, k, 3 n')."""
        levels = self._factor.forward_solve(self._blocks(rows))
        return torch.cat([level.unflatten(0, (len(rows), -1)).flatten(1, -2) for level in levels], dim=1).mT

    def _blocks(self, rhs: Tensor) -> Tensor:
        """Right-hand sides (B, k, 3, n) as blocks of frames, (B T, G, size 3 q, k)."""
        tracks, frames, points = self._shape
        by_frame = rhs.unflatten(-1, self._shape).permute(0, 3, 4, 5, 2, 1)
        by_frame = by_frame.reshape(len(rhs) * tracks, frames, 3 * points, rhs.shape[1])
        padded = torch.nn.functional.pad(by_frame, (0, 0, 0, 0, 0, -frames % self._size))
        return padded.unflatten(1, (-1, self._size)).flatten(2, 3)


def _block_diagonal(entries: Tensor) -> Tensor:
    """Block diagonal matrices (B, T, F, 3 q, 3 q) of the symmetric 3 x 3 matrices with entries (B, 6, T, F, q)."""
    blocks = expand(entries.flatten(2)).unflatten(-1, entries.shape[2:])
    same_point = torch.eye(entries.shape[-1]).to(entries)
    return torch.einsum("bijtfq,qr->btfqirj", blocks, same_point).flatten(-2).flatten(-3, -2)


def _block_tridiagonal(diagonal: Tensor, next_frame: Tensor, second_frame: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """Block tridiagonal form, with ``size`` frames in each of G blocks, of T tracks: diagonal (T, G, size m, size m) and below.

    Args:
        diagonal: blocks of the frames, (T, F, m, m); missing frames of the last block are filled up with identities.
        next_frame: couplings between frames f and f + 1, factors of the identity, (T, F - 1, m).
        second_frame: the same between frames f and f + 2, (T, F - 2, m).
        size: 2 or more.
    """
    tracks, frames, m, _ = diagonal.shape
    missing = -frames % size
    if missing:
        padding = torch.eye(m, dtype=diagonal.dtype, device=diagonal.device).expand(tracks, missing, m, m)
        diagonal = torch.cat([diagonal, padding], dim=1)
    count = diagonal.shape[1] // size
    next_frame, second_frame = (
        torch.nn.functional.pad(factors, (0, 0, 0, size * count - factors.shape[1])).view(tracks, count, size, m)
        for factors in (next_frame, second_frame)
    )
    blocks = diagonal.new_zeros(tracks, count, size, m, size, m)
    blocks.diagonal(dim1=2, dim2=4).copy_(diagonal.view(tracks, count, size, m, m).permute(0, 1, 3, 4, 2))
    between = blocks.diagonal(dim1=3, dim2=5)
    for step, factors in ((1, next_frame), (2, second_frame)):
        for offset in (step, -step):
            between.diagonal(offset, dim1=2, dim2=3).copy_(factors[:, :, : size - step].mT)
    below = diagonal.new_zeros(tracks, count - 1, size, m, size, m)
    between = below.diagonal(dim1=3, dim2=5)
    between[:, :, 0, -1] = next_frame[:, :-1, -1]
    between[:, :, 0, -2], between[:, :, 1, -1] = second_frame[:, :-1, -2], second_frame[:, :-1, -1]
    return blocks.flatten(4).flatten(2, 3), below.flatten(4).flatten(2, 3)
