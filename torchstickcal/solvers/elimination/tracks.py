"""Elimination of points that losses couple over time: block-banded in the frames, exact and linear in their number.

A second difference couples three consecutive frames, so with two frames to a block a track's Hessian is block
tridiagonal. It is factored by cyclic reduction: every second block is eliminated at once, all tracks side by side, and
what is left is block tridiagonal again with half as many blocks. Points that losses couple within a frame, as the ends of a
stick, form one track.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchstickcal.geometry.symmetric import expand
from torchstickcal.solvers.elimination.cross_blocks import cross_rows, twist_rows


class _Level(NamedTuple):
    """One elimination: the inverse factors of the odd blocks and their coupling to the even blocks left and right."""

    inverse: Tensor
    left: Tensor
    right: Tensor


class BlockTridiagonal:
    """Cholesky factor of symmetric, positive definite, block tridiagonal matrices, under a permutation of the blocks.

    Args:
        diagonal: (..., G, m, m).
        below: block (g + 1, g) at index g, (..., G - 1, m, m).
    """

    def __init__(self, diagonal: Tensor, below: Tensor) -> None:
        self._levels: list[_Level] = []
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
        self._last = _inverse_factor(diagonal)

    def half_solve(self, rhs: Tensor) -> list[Tensor]:
        """``L^-1 b`` of right-hand sides (..., G, m, k), the blocks in their order of elimination, level by level."""
        solved: list[Tensor] = []
        for level in self._levels:
            odd = level.inverse @ rhs[..., 1::2, :, :]
            rhs = rhs[..., 0::2, :, :].clone()
            count = level.right.shape[-3]
            rhs[..., : odd.shape[-3], :, :] -= level.left.mT @ odd
            rhs[..., 1 : 1 + count, :, :] -= level.right.mT @ odd[..., :count, :, :]
            solved.append(odd)
        return [*solved, self._last @ rhs]

    def back_solve(self, solved: list[Tensor]) -> Tensor:
        """``L^-T y`` (..., G, m, k) of what :meth:`half_solve` returned."""
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
    """Inverses of the Cholesky factors of blocks (..., m, m); NaN for blocks that are not positive definite."""
    identity = torch.eye(blocks.shape[-1], dtype=blocks.dtype, device=blocks.device).expand_as(blocks)
    factor, failed = torch.linalg.cholesky_ex(blocks)
    return torch.linalg.solve_triangular(factor, identity, upper=False).where(failed[..., None, None] == 0, torch.nan)


class TrackElimination:
    """Cholesky factor of the points' Hessian for T tracks of q points each that losses couple, within frames or over time.

    Args:
        hessian: diagonal blocks (B, 6, T, F, q) of the points, entries xx xy xz yy yz zz, the losses' shares included.
        within: (B, T, F, 3 q, 3 q), blocks between different points of a frame, zero on the diagonal; None where q is 1.
        between: multiples of the identity that couple frames f and f + 1, (B, F - 1, T, q), and f and f + 2,
            (B, F - 2, T, q); None where frames are not coupled, and each is eliminated by itself.
    """

    def __init__(self, hessian: Tensor, within: Tensor | None, between: tuple[Tensor, Tensor] | None) -> None:
        diagonal = _block_diagonal(hessian)
        if within is not None:
            diagonal = diagonal + within
        sessions, tracks, frames, _, _ = diagonal.shape
        if between is None:
            tracks, frames = tracks * frames, 1
            nothing = hessian.new_zeros(sessions, 0, tracks, hessian.shape[-1])
            between = nothing, nothing
        self._shape = tracks, frames, hessian.shape[-1]
        by_track = diagonal.reshape(sessions * tracks, frames, *diagonal.shape[-2:])
        steps = (step.transpose(1, 2).flatten(0, 1).repeat_interleave(3, -1) for step in between)
        self._factor = BlockTridiagonal(*_two_frames_a_block(by_track, *steps))

    def reductions(
        self, cross: Tensor, points: Tensor, gradient: Tensor, twist: Tensor | None = None, coupling: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """``(L^-1 H_xc)^T`` and ``L^-1 g`` of :class:`PointElimination`, the unknowns in the order of elimination."""
        rows = cross_rows(cross, points)
        if twist is not None:
            rows[:, :, 3:] += twist_rows(twist)
        rows = rows.flatten(1, 2)
        if coupling is not None:
            rows = torch.cat([rows, coupling], dim=1)
        levels = self._factor.half_solve(self._blocks(torch.cat([rows, gradient[:, None]], dim=1)))
        solved = torch.cat([level.unflatten(0, (len(rows), -1)).flatten(1, -2) for level in levels], dim=1).mT
        return solved[:, :-1], solved[:, -1]

    def solve(self, rhs: Tensor) -> Tensor:
        """``H^-1 b`` of a right-hand side (B, 3, n)."""
        tracks, frames, points = self._shape
        solved = self._factor.back_solve(self._factor.half_solve(self._blocks(rhs[:, None])))
        by_frame = solved.reshape(len(rhs), tracks, -1, points, 3)[:, :, :frames]
        return by_frame.permute(0, 4, 1, 2, 3).flatten(2)

    def _blocks(self, rhs: Tensor) -> Tensor:
        """Right-hand sides (B, k, 3, n) as blocks of two frames, (B T, G, 6 q, k)."""
        tracks, frames, points = self._shape
        by_frame = rhs.unflatten(-1, self._shape).permute(0, 3, 4, 5, 2, 1)
        by_frame = by_frame.reshape(len(rhs) * tracks, frames, 3 * points, rhs.shape[1])
        padded = torch.nn.functional.pad(by_frame, (0, 0, 0, 0, 0, frames % 2))
        return padded.unflatten(1, (-1, 2)).flatten(2, 3)


def _block_diagonal(entries: Tensor) -> Tensor:
    """The blocks (B, T, F, 3 q, 3 q) with the symmetric matrices of entries (B, 6, T, F, q) on the diagonal."""
    blocks = expand(entries.flatten(2)).unflatten(-1, entries.shape[2:])
    own = torch.eye(entries.shape[-1]).to(entries)
    return torch.einsum("bijtfq,qr->btfqirj", blocks, own).flatten(-2).flatten(-3, -2)


def _two_frames_a_block(diagonal: Tensor, next_frame: Tensor, second_frame: Tensor) -> tuple[Tensor, Tensor]:
    """Block tridiagonal form of tracks with diagonal (T, F, m, m) and couplings (T, F - 1, m), (T, F - 2, m)."""
    tracks, frames, m, _ = diagonal.shape
    if frames % 2:
        padding = torch.eye(m, dtype=diagonal.dtype, device=diagonal.device).expand(tracks, 1, m, m)
        diagonal = torch.cat([diagonal, padding], dim=1)
    padded = diagonal.shape[1]
    next_frame = torch.nn.functional.pad(next_frame, (0, 0, 0, padded - 1 - next_frame.shape[1])).diag_embed()
    second_frame = torch.nn.functional.pad(second_frame, (0, 0, 0, padded - 2 - second_frame.shape[1])).diag_embed()
    blocks = diagonal.new_zeros(tracks, padded // 2, 2 * m, 2 * m)
    blocks[..., :m, :m], blocks[..., m:, m:] = diagonal[:, 0::2], diagonal[:, 1::2]
    blocks[..., :m, m:] = blocks[..., m:, :m] = next_frame[:, 0::2]
    below = diagonal.new_zeros(tracks, padded // 2 - 1, 2 * m, 2 * m)
    below[..., :m, :m], below[..., m:, m:] = second_frame[:, 0::2], second_frame[:, 1::2]
    below[..., :m, m:] = next_frame[:, 1::2]
    return blocks, below
