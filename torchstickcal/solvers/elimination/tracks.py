"""Elimination of tracks: points that losses couple over time. It is exact, and its cost is linear in the number of frames.

A second difference couples three consecutive frames. With two or more frames per block the Hessian of a track is therefore
block tridiagonal. Points that losses couple within a frame, such as the ends of a stick, form one track. All tracks one after
another are one chain of blocks, in which the end of a track is not coupled with the beginning of the next. It is factored by
cyclic reduction: all odd blocks are eliminated at once. A block tridiagonal matrix with half as many blocks remains, and is
reduced in the same way, until no coupling is left.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchstickcal.geometry.symmetric import IDENTITY, expand
from torchstickcal.solvers.elimination.cross_blocks import cross_rows, rotation_curvature_rows

_ROWS_PER_BLOCK = 12
"""About as many rows as a block should have: small matrices take a multiple of their arithmetic, large ones have more of it."""


def rows_per_block(points: int) -> int:
    """Rows of a block of tracks with so many points. Tracks whose blocks have equally many can be eliminated together."""
    return 3 * points * _frames_per_block(points)


def _frames_per_block(points: int) -> int:
    return max(2, _ROWS_PER_BLOCK // (3 * points))


class _Level(NamedTuple):
    """One level of the cyclic reduction, in which the odd blocks are eliminated."""

    inverse: Tensor
    """inverses L^-1 of the Cholesky factors of the odd blocks"""
    left: Tensor
    """L^-1 times the block between an odd block and the even block before it"""
    right: Tensor
    """L^-1 times the block between an odd block and the even block after it; the last one of a session has none"""


class BlockTridiagonal:
    """Cholesky factor L of a symmetric, positive definite, block tridiagonal matrix. Blocks are in the order of elimination.

    Args:
        diagonal: the N diagonal blocks of all sessions, (N, m, m).
        below: the blocks below the diagonal, block (i + 1, i) at index i, (N, m, m); the last one of a session is zero.
        levels: number of reductions after which no coupling is left: of chains of n coupled blocks, the logarithm of n to the
            base of 2, rounded up.
        sessions: how many there are, of ``N / sessions`` blocks each, a multiple of ``2 ** levels``. What is not finite in one
            of them leaves the others alone.
    """

    def __init__(self, diagonal: Tensor, below: Tensor, levels: int, sessions: int = 1) -> None:
        self._sessions = sessions
        size, self._levels = diagonal.shape[-1], list[_Level]()
        identity = torch.eye(size, dtype=diagonal.dtype, device=diagonal.device)
        failures: list[Tensor] = []

        def inverse_factor(blocks: Tensor) -> Tensor:
            factor, failed = torch.linalg.cholesky_ex(blocks)
            failures.append(failed)
            return torch.linalg.solve_triangular(factor, identity.expand_as(blocks), upper=False)

        for _ in range(levels):
            inverse = inverse_factor(diagonal[1::2])
            sides = torch.bmm(inverse, torch.cat([below[0::2], below[1::2].mT], dim=-1))
            left, right = sides.split(size, dim=-1)
            to_right, of_right = torch.bmm(right.mT, sides).split(size, dim=-1)
            diagonal = torch.baddbmm(diagonal[0::2], left.mT, left, alpha=-1)
            self._by_session(diagonal)[:, 1:] -= self._by_session(of_right)[:, :-1]
            below = -to_right
            self._levels.append(_Level(inverse, left, right))
        self._last = inverse_factor(diagonal)
        if bool(torch.cat(failures).any()):
            inverses = [*(level.inverse for level in self._levels), self._last]
            for inverse, failed in zip(inverses, failures, strict=True):
                inverse[failed > 0] = torch.nan

    def counts(self, blocks: int) -> list[int]:
        """How many of so many blocks are eliminated at each level."""
        return [*(blocks >> level for level in range(1, len(self._levels) + 1)), blocks >> len(self._levels)]

    def forward_solve(self, rhs: Tensor) -> list[Tensor]:
        """``L^-1 b`` for right-hand sides b, (N, m, k): one tensor per level, in the order of elimination."""
        solved: list[Tensor] = []
        for level in self._levels:
            odd = torch.bmm(level.inverse, rhs[1::2])
            rhs = torch.baddbmm(rhs[0::2], level.left.mT, odd, alpha=-1)
            self._by_session(rhs)[:, 1:] -= self._by_session(torch.bmm(level.right.mT, odd))[:, :-1]
            solved.append(odd)
        return [*solved, torch.bmm(self._last, rhs)]

    def backward_solve(self, solved: list[Tensor]) -> Tensor:
        """``L^-T y`` (N, m, k), for y as returned by :meth:`forward_solve`."""
        x = torch.bmm(self._last.mT, solved[-1])
        for level, y in zip(reversed(self._levels), reversed(solved[:-1]), strict=True):
            odd = torch.baddbmm(y, level.left, x, alpha=-1)
            self._by_session(odd)[:, :-1] -= self._by_session(torch.bmm(level.right, x.roll(-1, 0)))[:, :-1]
            x = torch.stack([x, torch.bmm(level.inverse.mT, odd)], dim=1).flatten(0, 1)
        return x

    def _by_session(self, blocks: Tensor) -> Tensor:
        return blocks.unflatten(0, (self._sessions, -1))


class Tracks(NamedTuple):
    """T tracks of q points each, in F frames."""

    hessian: Tensor
    """diagonal blocks, (B, 6, T, F, q), entries xx xy xz yy yz zz; they include all losses"""
    within: Tensor | None
    """blocks between different points of a track in one frame, (B, T, F, 3 q, 3 q), zero on the diagonal; None if q is 1"""
    next_frame: Tensor
    """blocks between frames f and f + 1, (B, F - 1, T, q), as factors of the identity"""
    second_frame: Tensor
    """the same between frames f and f + 2, (B, F - 2, T, q)"""


class _Layout:
    """Where T tracks of q points, in F frames, are in a chain of blocks: G blocks per track, of ``size`` frames each.

    The last block of a track may have fewer frames.
    """

    def __init__(self, tracks: int, frames: int, points: int) -> None:
        self.shape = tracks, frames, points
        self.size = _frames_per_block(points)
        self.blocks_per_track = -(-frames // self.size)
        self.blocks, self.columns = tracks * self.blocks_per_track, tracks * frames * points

    def by_point(self, chain: Tensor) -> Tensor:
        """The numbers (B, T G, size 3 q, k) of the blocks as (B, k, 3, T, F, q); a view."""
        tracks, frames, points = self.shape
        by_frame = chain.unflatten(2, (self.size, points, 3)).unflatten(1, (tracks, -1)).flatten(2, 3)
        return by_frame[:, :, :frames].permute(0, 5, 4, 1, 2, 3)

    def write(self, tracks: Tracks, diagonal: Tensor, below: Tensor) -> None:
        """Write the blocks of tracks on the diagonal and below it, (B, T G, size 3 q, size 3 q); both are zero before."""
        missing = self.size * self.blocks_per_track - self.shape[1]
        of_block, of_below = (m.unflatten(3, (self.size, -1)).unflatten(2, (self.size, -1)) for m in (diagonal, below))
        points = of_block.unflatten(5, (-1, 3)).unflatten(3, (-1, 3)).diagonal(dim1=2, dim2=5).diagonal(dim1=2, dim2=4)
        entries = tracks.hessian
        if missing:
            identity = entries.new_tensor(IDENTITY)[:, None, None, None].expand(*entries.shape[:3], missing, entries.shape[-1])
            entries = torch.cat([entries, identity], dim=3)
        points.copy_(expand(entries.flatten(2)).unflatten(-1, (self.blocks, self.size, -1)).permute(0, 3, 1, 2, 4, 5))
        if tracks.within is not None:
            within = pad(tracks.within, (0, 0, 0, 0, 0, missing)).flatten(1, 2).unflatten(1, (-1, self.size))
            of_block.diagonal(dim1=2, dim2=4).add_(within.movedim(2, -1))
        next_frame, second_frame = (self._by_block(factors) for factors in (tracks.next_frame, tracks.second_frame))
        between = of_block.diagonal(dim1=3, dim2=5)
        for step, factors in ((1, next_frame), (2, second_frame)):
            for offset in (step, -step):
                between.diagonal(offset, dim1=2, dim2=3).copy_(factors[:, :, : self.size - step].mT)
        between = of_below.diagonal(dim1=3, dim2=5)
        between[:, :, 0, -1] = next_frame[:, :, -1]
        between[:, :, 0, -2], between[:, :, 1, -1] = second_frame[:, :, -2], second_frame[:, :, -1]

    def _by_block(self, factors: Tensor) -> Tensor:
        """Factors (B, F or fewer, T, q) as (B, T G, size, 3 q), zero where there are none."""
        padded = pad(factors, (0, 0, 0, 0, 0, self.size * self.blocks_per_track - factors.shape[1]))
        return padded.transpose(1, 2).flatten(1, 2).unflatten(1, (-1, self.size)).repeat_interleave(3, -1)


class TrackElimination:
    """Cholesky factor L of the points' Hessian for some tracks.

    Args:
        groups: tracks with equally many rows per block, one group for each number of points. Columns are in the order of the
            groups, and in each in the order track, frame, point.
    """

    def __init__(self, groups: Sequence[Tracks]) -> None:
        like = groups[0].hessian
        self._sessions, self._rows = len(like), rows_per_block(like.shape[-1])
        self._layouts = [_Layout(*tracks.hessian.shape[2:]) for tracks in groups]
        levels = max((layout.blocks_per_track - 1).bit_length() for layout in self._layouts)
        self._used = sum(layout.blocks for layout in self._layouts)
        self._blocks = -(-self._used // 2**levels) * 2**levels
        """blocks in the chain of a session; those that are no part of a track are identities"""
        diagonal, below = (like.new_zeros(self._sessions, self._blocks, self._rows, self._rows) for _ in range(2))
        diagonal.diagonal(dim1=2, dim2=3)[:, self._used :] = 1.0
        for layout, tracks, *own in zip(self._layouts, groups, self._of_each(diagonal), self._of_each(below), strict=True):
            layout.write(tracks, *own)
        self._factor = BlockTridiagonal(diagonal.flatten(0, 1), below.flatten(0, 1), levels, self._sessions)

    def forward_solve(self, rhs: Tensor) -> Tensor:
        """``L^-1 b`` for right-hand sides b, (B, 3, n): (B, 3 n'), in the order of elimination, with n' >= n."""
        return self._forward_solve(rhs[:, None])[:, 0]

    def backward_solve(self, solved: Tensor) -> Tensor:
        """``L^-T y`` (B, 3, n) for y as :meth:`forward_solve` returns it."""
        levels = solved.split([self._rows * count for count in self._factor.counts(self._blocks)], dim=1)
        return self._by_point(self._factor.backward_solve([level.reshape(-1, self._rows, 1) for level in levels]))

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
        return torch.cat([level.unflatten(0, (self._sessions, -1)).flatten(1, 2) for level in levels], dim=1).mT

    def _by_block(self, rhs: Tensor) -> Tensor:
        """Right-hand sides (B, k, 3, n) as those of the chain's blocks, (B N, m, k)."""
        chain = rhs.new_zeros(self._sessions, self._blocks, self._rows, rhs.shape[1])
        by_layout = rhs.split([layout.columns for layout in self._layouts], dim=-1)
        for layout, blocks, own in zip(self._layouts, self._of_each(chain), by_layout, strict=True):
            layout.by_point(blocks).copy_(own.unflatten(-1, layout.shape))
        return chain.flatten(0, 1)

    def _by_point(self, solution: Tensor) -> Tensor:
        """The solution (B N, m, 1) of the chain's blocks as (B, 3, n)."""
        chain = solution.unflatten(0, (self._sessions, -1))
        found = zip(self._layouts, self._of_each(chain), strict=True)
        return torch.cat([layout.by_point(blocks)[:, 0].flatten(2) for layout, blocks in found], dim=-1)

    def _of_each(self, chain: Tensor) -> list[Tensor]:
        """Blocks (B, N, ...) of the chain, those of each layout."""
        *own, _ = chain.split([*(layout.blocks for layout in self._layouts), self._blocks - self._used], dim=1)
        return own
