"""Elimination of tracks: points that losses couple over time. It is exact, and its cost is linear in the number of frames.

A second difference couples three consecutive frames. With two or more frames per block the Hessian of a track is therefore
block tridiagonal. All tracks one after another are one chain of blocks, in which the end of a track is not coupled with the
beginning of the next. It is factored by cyclic reduction: all odd blocks are eliminated at once. A block tridiagonal matrix
with half as many blocks remains, and is reduced in the same way, until no coupling is left. Points that losses couple within a
frame, such as the ends of a stick, form one track.
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
    """L^-1 times the block between an odd block and the even block after it; the last one has none"""


class BlockTridiagonal:
    """Cholesky factor L of a symmetric, positive definite, block tridiagonal matrix. Blocks are in the order of elimination.

    Args:
        diagonal: the N diagonal blocks, (N, m, m); N is a multiple of ``2 ** levels``.
        below: the blocks below the diagonal, block (i + 1, i) at index i, (N, m, m); the last one is zero.
        levels: number of reductions after which no coupling is left: of chains of n coupled blocks, the logarithm of n to the
            base of 2, rounded up.
    """

    def __init__(self, diagonal: Tensor, below: Tensor, levels: int) -> None:
        self._levels: list[_Level] = []
        failures: list[Tensor] = []
        for _ in range(levels):
            inverse, failed = _inverse_factor(diagonal[1::2])
            sides = inverse @ torch.cat([below[0::2], below[1::2].mT], dim=-1)
            left, right = sides.chunk(2, dim=-1)
            products = right.mT @ sides
            diagonal = torch.baddbmm(diagonal[0::2], left.mT, left, alpha=-1)
            diagonal[1:] -= products[:-1, :, below.shape[-1] :]
            below = -products[..., : below.shape[-1]]
            self._levels.append(_Level(inverse, left, right[:-1]))
            failures.append(failed)
        self._last, failed = _inverse_factor(diagonal)
        if bool(torch.cat([*failures, failed]).any()):
            for inverse, failed in zip((*(level.inverse for level in self._levels), self._last), (*failures, failed), strict=True):
                inverse[failed] = torch.nan

    def counts(self, blocks: int) -> list[int]:
        """How many of so many blocks are eliminated at each level."""
        return [*(blocks >> level for level in range(1, len(self._levels) + 1)), blocks >> len(self._levels)]

    def forward_solve(self, rhs: Tensor) -> list[Tensor]:
        """``L^-1 b`` for right-hand sides b, (N, m, k): one tensor per level, in the order of elimination."""
        solved: list[Tensor] = []
        for level in self._levels:
            odd = level.inverse @ rhs[1::2]
            rhs = torch.baddbmm(rhs[0::2], level.left.mT, odd, alpha=-1)
            rhs[1:].baddbmm_(level.right.mT, odd[:-1], alpha=-1)
            solved.append(odd)
        return [*solved, self._last @ rhs]

    def backward_solve(self, solved: list[Tensor]) -> Tensor:
        """``L^-T y`` (N, m, k), for y as returned by :meth:`forward_solve`."""
        x = self._last.mT @ solved[-1]
        for level, y in zip(reversed(self._levels), reversed(solved[:-1]), strict=True):
            odd = torch.baddbmm(y, level.left, x, alpha=-1)
            odd[:-1].baddbmm_(level.right, x[1:], alpha=-1)
            x = torch.stack([x, level.inverse.mT @ odd], dim=1).flatten(0, 1)
        return x


def _inverse_factor(blocks: Tensor) -> tuple[Tensor, Tensor]:
    """Inverses of the Cholesky factors of the blocks (N, m, m), and which of them are not positive definite, (N,)."""
    identity = torch.eye(blocks.shape[-1], dtype=blocks.dtype, device=blocks.device).expand_as(blocks)
    factor, failed = torch.linalg.cholesky_ex(blocks)
    return torch.linalg.solve_triangular(factor, identity, upper=False), failed > 0


class TrackElimination:
    """Cholesky factor L of the points' Hessian for T tracks, with q points per track and frame.

    Args:
        hessian: diagonal blocks, (B, 6, T, F, q), entries xx xy xz yy yz zz. They include all losses.
        within: blocks between different points of a track in one frame, (B, T, F, 3 q, 3 q), zero on the diagonal; None if q is
            1.
        between: the blocks between frames f and f + 1, (B, F - 1, T, q), and between f and f + 2, (B, F - 2, T, q), as factors
            of the identity; None if no loss couples frames.
    """

    def __init__(self, hessian: Tensor, within: Tensor | None, between: tuple[Tensor, Tensor] | None) -> None:
        _, _, self._tracks, self._frames, self._points = hessian.shape
        self._size = 1 if between is None else max(2, min(_ROWS_PER_BLOCK // (3 * self._points), self._frames))
        """frames per block"""
        self._blocks_per_track = -(-self._frames // self._size)
        levels = 0 if between is None else (self._blocks_per_track - 1).bit_length()
        self._blocks = -(-self._tracks * self._blocks_per_track // 2**levels) * 2**levels
        """blocks in the chain of a session; those that are no part of a track are identities"""
        rows = 3 * self._points
        by_point = expand(hessian.flatten(2)).unflatten(-1, hessian.shape[2:]).permute(0, 3, 4, 5, 1, 2)
        by_point = self._in_chain(by_point, torch.eye(3).to(hessian))
        blocks = hessian.new_zeros(len(by_point), self._size, rows, self._size, rows)
        of_points = blocks.unflatten(4, (-1, 3)).unflatten(2, (-1, 3)).diagonal(dim1=1, dim2=4).diagonal(dim1=1, dim2=3)
        of_points.copy_(by_point.permute(0, 3, 4, 1, 2))
        if within is not None:
            blocks.diagonal(dim1=1, dim2=3).add_(self._in_chain(within).movedim(1, -1))
        below = blocks[:0]
        if between is not None:
            below = _coupled(blocks, *(self._in_chain(f.transpose(1, 2)).repeat_interleave(3, -1) for f in between))
        self._factor = BlockTridiagonal(*(b.flatten(3).flatten(1, 2) for b in (blocks, below)), levels)

    def forward_solve(self, rhs: Tensor) -> Tensor:
        """``L^-1 b`` for right-hand sides b, (B, 3, n): (B, 3 n'), in the order of elimination, with n' >= n."""
        return self._forward_solve(rhs[:, None])[:, 0]

    def backward_solve(self, solved: Tensor) -> Tensor:
        """``L^-T y`` (B, 3, n) for y as :meth:`forward_solve` returns it."""
        rows = 3 * self._points * self._size
        levels = solved.split([rows * count for count in self._factor.counts(self._blocks)], dim=1)
        return self._by_point(self._factor.backward_solve([level.reshape(-1, rows, 1) for level in levels]))

    def solve(self, rhs: Tensor) -> Tensor:
        """``H^-1 b`` for right-hand sides b, (B, 3, n)."""
        return self._by_point(self._factor.backward_solve(self._factor.forward_solve(self._by_block(rhs[:, None]))))

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
        levels = self._factor.forward_solve(self._by_block(rows))
        return torch.cat([level.unflatten(0, (len(rows), -1)).flatten(1, 2) for level in levels], dim=1).mT

    def _by_block(self, rhs: Tensor) -> Tensor:
        """Right-hand sides (B, k, 3, n) as those of the chain's blocks, (B N, size 3 q, k)."""
        by_frame = rhs.unflatten(-1, (self._tracks, self._frames, self._points)).permute(0, 3, 4, 5, 2, 1)
        return self._in_chain(by_frame).flatten(1, 3)

    def _by_point(self, solution: Tensor) -> Tensor:
        """The solution (B N, size 3 q, 1) of the chain's blocks as (B, 3, n)."""
        by_block = solution.view(-1, self._blocks, self._size, self._points, 3)[:, : self._tracks * self._blocks_per_track]
        by_frame = by_block.flatten(1, 2).unflatten(1, (self._tracks, -1))[:, :, : self._frames]
        return by_frame.permute(0, 4, 1, 2, 3).flatten(2)

    def _in_chain(self, values: Tensor, fill: Tensor | float = 0.0) -> Tensor:
        """Values (B, T, F or fewer, ...) as those of the chain's blocks, (B N, size, ...); those of no frame are ``fill``."""
        _, tracks, frames, *shape = values.shape
        chain = values.new_empty(len(values), self._blocks, self._size, *shape)
        if tracks * frames < self._blocks * self._size:
            chain[:] = fill
        by_track = chain[:, : tracks * self._blocks_per_track].unflatten(1, (tracks, -1)).flatten(2, 3)
        by_track[:, :, :frames] = values
        return chain.flatten(0, 1)


def _coupled(blocks: Tensor, next_frame: Tensor, second_frame: Tensor) -> Tensor:
    """Write the couplings between frames of one block into the blocks; returns those between a block and the next one.

    Args:
        blocks: (N, size, m, size, m), of ``size`` frames, 2 or more.
        next_frame: couplings between frames f and f + 1, factors of the identity, (N, size, m).
        second_frame: the same between frames f and f + 2.
    """
    size, between = blocks.shape[1], blocks.diagonal(dim1=2, dim2=4)
    for step, factors in ((1, next_frame), (2, second_frame)):
        for offset in (step, -step):
            between.diagonal(offset, dim1=1, dim2=2).copy_(factors[:, : size - step].mT)
    below = torch.zeros_like(blocks)
    between = below.diagonal(dim1=2, dim2=4)
    between[:, 0, -1] = next_frame[:, -1]
    between[:, 0, -2], between[:, 1, -1] = second_frame[:, -2], second_frame[:, -1]
    return below
