"""Elimination of points that are coupled over time: block-banded in the frames, exact and linear in their number.

A second difference couples three consecutive frames, so with two frames to a block a track's Hessian is block
tridiagonal. It is factored by cyclic reduction: every second block is eliminated at once, all tracks side by side, and
what is left is block tridiagonal again with half as many blocks. Stick ends form one track of 6 numbers a frame.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from torchstickcal.solvers.cross_blocks import cross_rows
from torchstickcal.symmetric import expand


class _Level(NamedTuple):
    """One elimination: the factors of the odd blocks and their coupling to the even blocks left and right."""

    lower: Tensor
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
            lower = torch.linalg.cholesky(diagonal[..., 1::2, :, :])
            left = torch.linalg.solve_triangular(lower, below[..., 0::2, :, :], upper=False)
            right = torch.linalg.solve_triangular(
                lower[..., : below.shape[-3] // 2, :, :], below[..., 1::2, :, :].mT, upper=False
            )
            diagonal = diagonal[..., 0::2, :, :].clone()
            diagonal[..., : left.shape[-3], :, :] -= left.mT @ left
            diagonal[..., 1 : 1 + right.shape[-3], :, :] -= right.mT @ right
            below = -right.mT @ left[..., : right.shape[-3], :, :]
            self._levels.append(_Level(lower, left, right))
        self._last = torch.linalg.cholesky(diagonal)

    def half_solve(self, rhs: Tensor) -> list[Tensor]:
        """``L^-1 b`` of right-hand sides (..., G, m, k), the blocks in their order of elimination, level by level."""
        solved: list[Tensor] = []
        for level in self._levels:
            odd = torch.linalg.solve_triangular(level.lower, rhs[..., 1::2, :, :], upper=False)
            rhs = rhs[..., 0::2, :, :].clone()
            count = level.right.shape[-3]
            rhs[..., : odd.shape[-3], :, :] -= level.left.mT @ odd
            rhs[..., 1 : 1 + count, :, :] -= level.right.mT @ odd[..., :count, :, :]
            solved.append(odd)
        return [*solved, torch.linalg.solve_triangular(self._last, rhs, upper=False)]

    def back_solve(self, solved: list[Tensor]) -> Tensor:
        """``L^-T y`` (..., G, m, k) of what :meth:`half_solve` returned."""
        x = torch.linalg.solve_triangular(self._last.mT, solved[-1], upper=True)
        for level, y in zip(reversed(self._levels), reversed(solved[:-1]), strict=True):
            count = level.right.shape[-3]
            y = y - level.left @ x[..., : y.shape[-3], :, :]
            y[..., :count, :, :] -= level.right @ x[..., 1 : 1 + count, :, :]
            odd = torch.linalg.solve_triangular(level.lower.mT, y, upper=True)
            merged = x.new_empty(*x.shape[:-3], x.shape[-3] + odd.shape[-3], *x.shape[-2:])
            merged[..., 0::2, :, :], merged[..., 1::2, :, :] = x, odd
            x = merged
        return x


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
        _, self._frames, points = hessian.shape
        paired = torch.zeros(points, dtype=torch.bool, device=hessian.device)
        paired[pairs.flatten()] = coupling is not None
        singles = (~paired).nonzero()
        self._groups = [singles] if coupling is None else [singles, pairs]
        self._factors: list[BlockTridiagonal] = []
        blocks = expand(hessian.flatten(1)).unflatten(-1, hessian.shape[1:])
        for members in self._groups:
            diagonal = self._diagonal(blocks, members, coupling)
            steps = [self._by_track(step.expand(3, -1, -1), members)[..., 0] for step in (next_frame, second_frame)]
            self._factors.append(BlockTridiagonal(*_two_frames_a_block(diagonal, *steps)))

    def reductions(self, cross: Tensor, points: Tensor, gradient: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
        """``(L^-1 H_xc)^T`` and ``L^-1 g`` of :class:`PointElimination`, the unknowns in the order of elimination."""
        rhs = torch.cat([cross_rows(cross, points).flatten(0, 1), gradient[None]])
        for half in self._half(rhs):
            for level in half:
                rows = level.flatten(0, -2).mT
                yield rows[:-1], rows[-1]

    def solve(self, rhs: Tensor) -> Tensor:
        """``H^-1 b`` of a right-hand side (3, N)."""
        solution = rhs.new_empty(rhs.shape).unflatten(-1, (self._frames, -1))
        for members, factor, half in zip(self._groups, self._factors, self._half(rhs[None]), strict=True):
            tracks = factor.back_solve(half).flatten(1, 2)[..., 0]
            width = 3 * members.shape[1]
            tracks = tracks.view(tracks.shape[0], -1, width)[:, : self._frames].unflatten(-1, (-1, 3))
            solution[:, :, members] = tracks.permute(3, 1, 0, 2)
        return solution.flatten(1)

    def _half(self, rhs: Tensor) -> list[list[Tensor]]:
        by_frame = rhs.unflatten(-1, (self._frames, -1))
        halves: list[list[Tensor]] = []
        for members, factor in zip(self._groups, self._factors, strict=True):
            tracks = by_frame[..., members].permute(3, 2, 4, 1, 0).flatten(2, 3)
            odd = torch.nn.functional.pad(tracks, (0, 0, 0, 0, 0, self._frames % 2))
            halves.append(factor.half_solve(odd.unflatten(1, (-1, 2)).flatten(2, 3)))
        return halves

    @staticmethod
    def _by_track(values: Tensor, members: Tensor) -> Tensor:
        """Values (3, F, P) at the members (T, q) of the tracks, as (T, F, 3 q, 1)."""
        return values[:, :, members].permute(2, 1, 3, 0).flatten(2)[..., None]

    @staticmethod
    def _diagonal(blocks: Tensor, members: Tensor, coupling: Tensor | None) -> Tensor:
        """Blocks (T, F, m, m) of the tracks, of point blocks (3, 3, F, P)."""
        first = blocks[..., members[:, 0]].permute(3, 2, 0, 1)
        if members.shape[1] == 1:
            return first
        assert coupling is not None
        second = blocks[..., members[:, 1]].permute(3, 2, 0, 1)
        between = -expand(coupling.flatten(1)).unflatten(-1, coupling.shape[1:]).permute(3, 2, 0, 1)
        return torch.cat([torch.cat([first, between], -1), torch.cat([between, second], -1)], -2)


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
