"""How the points are divided for elimination: by slices of frames, or by tracks where a loss couples consecutive frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from torchstickcal.model.measurements import Measurements
from torchstickcal.model.unknowns import Columns
from torchstickcal.solvers.elimination.points import PointElimination
from torchstickcal.solvers.elimination.tracks import TrackElimination

_TRACK_POINTS = 3000
"""Points of tracks eliminated together, so that their right-hand sides stay in the cache."""

Cluster = tuple[int, ...]
"""Points of one frame that losses couple with one another."""


class WithinFrame:
    """Blocks of the points' Hessian between two different points of a frame."""

    def __init__(self) -> None:
        self._blocks: dict[tuple[int, int], Tensor] = {}

    def add(self, rows: Tensor, columns: Tensor, blocks: Tensor) -> None:
        """Add blocks (B, 3, 3, F, G) between points (G,), the rows', and points (G,), the columns'."""
        for row, column, block in zip(rows.tolist(), columns.tolist(), blocks.unbind(-1), strict=True):
            if row > column:
                row, column, block = column, row, block.transpose(1, 2)
            known = self._blocks.get((row, column))
            self._blocks[row, column] = block if known is None else known + block

    def between(self, row: int, column: int) -> Tensor | None:
        """The blocks (B, 3, 3, F) between two points, the row's index being the smaller; None where nothing couples them."""
        return self._blocks.get((row, column))


@dataclass(frozen=True)
class BetweenFrames:
    """Blocks of the points' Hessian between frames of one point: multiples of the identity."""

    next_frame: Tensor
    """(B, F - 1, P), between frames f and f + 1"""
    second_frame: Tensor
    """(B, F - 2, P), between frames f and f + 2"""


@dataclass(frozen=True)
class Couplings:
    """What is off the diagonal blocks of the points' Hessian."""

    within: WithinFrame
    between: BetweenFrames | None
    """None where no loss couples consecutive frames"""


class Part(Protocol):
    """Points that no loss couples with points outside."""

    @property
    def columns(self) -> Columns:
        """Their columns."""
        ...

    @property
    def chunks(self) -> list[Columns]:
        """The same columns, in order, in pieces to be worked on at a time."""
        ...

    def eliminate(self, hessian: Tensor) -> PointElimination | TrackElimination:
        """The factor of their Hessian with diagonal blocks (B, 6, n)."""
        ...


def parts(measurements: Measurements, clusters: Sequence[Cluster], couplings: Couplings) -> list[Part]:
    """Parts that together are all columns.

    Args:
        measurements: the sessions.
        clusters: the points that losses couple within a frame.
        couplings: the blocks that couple them.
    """
    m = measurements
    if couplings.between is not None:
        whole = slice(0, m.frames)
        single = [(point,) for point in range(m.points_per_frame) if not any(point in cluster for cluster in clusters)]
        together = max(1, _TRACK_POINTS // (m.frames * m.sessions))
        return [_Clusters(m, members, whole, couplings) for members in _alike([*single, *clusters], together)]
    large = [cluster for cluster in clusters if len(cluster) > 2]
    pairs = [cluster for cluster in clusters if len(cluster) == 2]
    found: list[Part] = []
    for frames in m.frame_slices():
        if sum(map(len, large)) < m.points_per_frame:
            found.append(_Frames(m, frames, pairs, large, couplings.within))
        found += [_Clusters(m, members, frames, couplings) for members in _alike(large, len(large))]
    return found


def _alike(clusters: Sequence[Cluster], together: int) -> list[list[Cluster]]:
    """Clusters of equal size, at most so many together."""
    found: list[list[Cluster]] = []
    for size in sorted({len(cluster) for cluster in clusters}):
        alike = [cluster for cluster in clusters if len(cluster) == size]
        found += [alike[first : first + together] for first in range(0, len(alike), together)]
    return found


class _Frames:
    """The points of some frames but for those in large clusters: single points and pairs."""

    def __init__(
        self,
        measurements: Measurements,
        frames: slice,
        pairs: Sequence[Cluster],
        large: Sequence[Cluster],
        within: WithinFrame,
    ) -> None:
        m, device = measurements, measurements.pixels.device
        left_out = {point for cluster in large for point in cluster}
        points = [point for point in range(m.points_per_frame) if point not in left_out]
        first = torch.arange(frames.start, frames.stop, device=device)[:, None]
        self.columns: Columns = slice(frames.start * m.points_per_frame, frames.stop * m.points_per_frame)
        if left_out:
            self.columns = (m.points_per_frame * first + torch.tensor(points, dtype=torch.long, device=device)).flatten()
        self.chunks: list[Columns] = [self.columns]
        ends = torch.tensor([[points.index(end) for end in pair] for pair in pairs], dtype=torch.long, device=device)
        place = len(points) * (first - frames.start)
        self._starts, self._ends = ((place + side).flatten() for side in ends.view(-1, 2).unbind(1))
        blocks = [block[..., frames] for a, b in pairs if (block := within.between(a, b)) is not None]
        self._coupling = torch.stack(blocks, dim=-1).flatten(-2) if blocks else None

    def eliminate(self, hessian: Tensor) -> PointElimination:
        return PointElimination(hessian, self._starts, self._ends, self._coupling)


class _Clusters:
    """Clusters of equal size over some frames; columns in the order cluster, frame, member."""

    def __init__(self, measurements: Measurements, members: Sequence[Cluster], frames: slice, couplings: Couplings) -> None:
        m, device = measurements, measurements.pixels.device
        self._members, self._frames, self._couplings = members, frames, couplings
        self._points = torch.tensor(members, device=device)
        place = m.points_per_frame * torch.arange(frames.start, frames.stop, device=device)[:, None]
        self.columns: Columns = (self._points[:, None] + place).flatten()
        self.chunks: list[Columns] = list(self.columns.split(max(1, m.chunk_keypoints // (m.sessions * m.num_cameras))))

    def eliminate(self, hessian: Tensor) -> TrackElimination:
        between, frames = self._couplings.between, self._frames.stop - self._frames.start
        by_track = hessian.unflatten(-1, (len(self._members), frames, -1))
        steps = None
        if between is not None:
            next_frame, second_frame = (s[..., self._points].to(hessian) for s in (between.next_frame, between.second_frame))
            steps = next_frame, second_frame
        return TrackElimination(by_track, self._within(hessian, frames), steps)

    def _within(self, like: Tensor, frames: int) -> Tensor | None:
        """The blocks between the points of each cluster, (B, T, F, 3 q, 3 q), zero on the diagonal; None for single points."""
        size = len(self._members[0])
        if size == 1:
            return None
        blocks = like.new_zeros(len(like), len(self._members), frames, 3 * size, 3 * size)
        for number, cluster in enumerate(self._members):
            for i, row in enumerate(cluster):
                for j, column in enumerate(cluster[i + 1 :], i + 1):
                    block = self._couplings.within.between(row, column)
                    if block is not None:
                        at = block[..., self._frames].movedim(-1, 1).to(like.dtype)
                        blocks[:, number, :, 3 * i : 3 * i + 3, 3 * j : 3 * j + 3] = at
                        blocks[:, number, :, 3 * j : 3 * j + 3, 3 * i : 3 * i + 3] = at.mT
        return blocks
