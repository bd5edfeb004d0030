"""Elimination of points that are coupled over time: block-banded in the frames, exact and linear in their number.

A second difference couples three consecutive frames, so with two frames to a block a track's Hessian is block
tridiagonal. It is factored by cyclic reduction: every second block is eliminated at once, all tracks side by side, and
what is left is block tridiagonal again with half as many blocks. Stick ends form one track of 6 numbers a frame.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from torchstickcal.solvers.cross_blocks import cross_rows
from torchstickcal.symmetric import expand

_PART_POINTS = 3000
"""Points worked on at a time, so that their right-hand sides stay in the cache."""


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
    """Inverses of the Cholesky factors of blocks (..., m, m)."""
    identity = torch.eye(blocks.shape[-1], dtype=blocks.dtype, device=blocks.device).expand_as(blocks)
    return torch.linalg.solve_triangular(torch.linalg.cholesky(blocks), identity, upper=False)


class _Part(NamedTuple):
    """Tracks that are eliminated together: their points (T, 1), or pairs of points (T, 2) with their coupling (6, F, T)."""

    members: Tensor
    between: Tensor | None


class TrackElimination:
    """Cholesky factor of the structure's Hessian with coupling over time.

    Args:
        hessian: diagonal blocks (6, F, P) of the points, entries xx xy xz yy yz zz, the losses' shares included.
        pairs: (S, 2) points that form one track, ends of one stick.
        coupling: (6, F, S), the blocks -M between a pair's points in a frame, or None.
        next_frame: (F - 1, P), the multiple of the identity that couples frames f and f + 1.
        second_frame: (F - 2, P), the same for frames f and f + 2.
    """

    def __init__(
        self, hessian: Tensor, pairs: Tensor, coupling: Tensor | None, next_frame: Tensor, second_frame: Tensor
    ) -> None:
        self._hessian, self._next_frame, self._second_frame = hessian, next_frame, second_frame
        _, self._frames, self._points = hessian.shape
        paired = torch.zeros(self._points, dtype=torch.bool, device=hessian.device)
        paired[pairs.flatten()] = coupling is not None
        together = max(1, _PART_POINTS // self._frames)
        self._parts = [_Part(members, None) for members in (~paired).nonzero().split(together)]
        if coupling is not None:
            sticks = zip(pairs.split(together), coupling.split(together, dim=-1), strict=True)
            self._parts += [_Part(members, between) for members, between in sticks]
        self._factors: list[BlockTridiagonal] = []

    def reductions(self, cross: Tensor, points: Tensor, gradient: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
        """``(L^-1 H_xc)^T`` and ``L^-1 g`` of :class:`PointElimination`, the unknowns in the order of elimination."""
        self._factors = []
        for part in self._parts:
            self._factors.append(self._factor(part))
            columns = self._columns(part.members)
            rows = cross_rows(cross[:, :, columns], points[:, columns]).permute(2, 0, 1, 3).flatten(1, 2)
            rhs = self._blocks(torch.cat([rows, gradient[:, None, columns]], dim=1), part.members)
            solved = torch.cat([level.flatten(0, -2) for level in self._factors[-1].half_solve(rhs)]).mT
            yield solved[:-1], solved[-1]

    def solve(self, rhs: Tensor) -> Tensor:
        """``H^-1 b`` of a right-hand side (3, N), with the factors of :meth:`reductions` where it has been called."""
        solution = torch.empty_like(rhs)
        for part, factor in itertools.zip_longest(self._parts, self._factors):
            factor = factor or self._factor(part)
            columns = self._columns(part.members)
            half = factor.half_solve(self._blocks(rhs[:, None, columns], part.members))
            tracks = factor.back_solve(half).flatten(1)[:, : 3 * part.members.shape[1] * self._frames]
            solution[:, columns] = tracks.reshape(-1, 3).mT
        return solution

    def _factor(self, part: _Part) -> BlockTridiagonal:
        members = part.members
        first, *second = (expand(self._hessian[..., ends]).permute(3, 2, 0, 1) for ends in members.unbind(1))
        diagonal = first
        if part.between is not None:
            between = -expand(part.between).permute(3, 2, 0, 1)
            diagonal = torch.cat([torch.cat([first, between], -1), torch.cat([between, second[0]], -1)], -2)
        steps = (step[:, members].permute(1, 0, 2).repeat_interleave(3, -1) for step in (self._next_frame, self._second_frame))
        return BlockTridiagonal(*_two_frames_a_block(diagonal, *steps))

    def _columns(self, members: Tensor) -> Tensor:
        """Columns of the points of tracks (T, q), ordered track, frame, member."""
        frames = torch.arange(self._frames, device=members.device)[:, None] * self._points
        return (members[:, None] + frames).flatten()

    def _blocks(self, rhs: Tensor, members: Tensor) -> Tensor:
        """Right-hand sides (3, k, n) of the tracks' columns as blocks of two frames, (T, G, 6 q, k)."""
        tracks = rhs.flatten(0, 1).mT.contiguous().view(len(members), self._frames, -1, rhs.shape[1])
        padded = torch.nn.functional.pad(tracks, (0, 0, 0, 0, 0, 1)) if self._frames % 2 else tracks
        return padded.unflatten(1, (-1, 2)).flatten(2, 3)


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
