"""Partition of the points for their elimination: by slices of frames, or by tracks if a loss couples consecutive frames."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from torchstickcal.model.measurements import Measurements
from torchstickcal.model.unknowns import Columns
from torchstickcal.solvers.elimination.points import PointElimination
from torchstickcal.solvers.elimination.tracks import TrackElimination, Tracks, rows_per_block

_MAX_TRACK_POINTS, _MAX_HELD_TRACK_POINTS = 3000, 50_000
"""Number of points of the tracks that are eliminated together, and the same for held cameras. Their right-hand sides should fit
into the cache; for held cameras there is only one."""

Cluster = tuple[int, ...]
"""Points of one frame that losses couple with each other."""


class WithinFrame:
    """Blocks of the points' Hessian between two different points of the same frame."""

    def __init__(self) -> None:
        self._blocks: dict[tuple[int, int], Tensor] = {}

    def add(self, rows: Tensor, columns: Tensor, blocks: Tensor) -> None:
        """Add blocks (B, 3, 3, F, G) for G pairs of points: ``rows`` (G,) and ``columns`` (G,)."""
        for row, column, block in zip(rows.tolist(), columns.tolist(), blocks.unbind(-1), strict=True):
            if row > column:
                row, column, block = column, row, block.transpose(1, 2)
            earlier = self._blocks.get((row, column))
            self._blocks[row, column] = block if earlier is None else earlier + block

    def between(self, row: int, column: int) -> Tensor | None:
        """The blocks (B, 3, 3, F) between two points, ``row < column``; None if no loss couples them."""
        return self._blocks.get((row, column))


@dataclass(frozen=True)
class BetweenFrames:
    """Blocks of the points' Hessian between two frames of the same point, as factors of the identity."""

    next_frame: Tensor
    """(B, F - 1, P), between frames f and f + 1"""
    second_frame: Tensor
    """(B, F - 2, P), between frames f and f + 2"""


@dataclass(frozen=True)
class Couplings:
    """The blocks of the points' Hessian off the diagonal."""

    within: WithinFrame
    between: BetweenFrames | None
    """None if no loss couples frames"""


class Part(Protocol):
    """A set of columns that no loss couples with other columns."""

    @property
    def columns(self) -> Columns:
        """The columns of the part."""
        ...

    @property
    def chunks(self) -> list[Columns]:
        """The same columns in the same order, in chunks that are linearised at a time."""
        ...

    def eliminate(self, hessian: Tensor) -> PointElimination | TrackElimination:
        """Factor the part's Hessian with the diagonal blocks (B, 6, n)."""
        ...


def parts(
    measurements: Measurements, clusters: Sequence[Cluster], couplings: Couplings, cameras_free: bool = True
) -> list[Part]:
    """A partition of all columns.

    Args:
        measurements: the sessions.
        clusters: the points that losses couple within a frame.
        couplings: the blocks off the diagonal.
        cameras_free: whether the cameras are unknowns too.
    """
    m, most = measurements, _MAX_TRACK_POINTS if cameras_free else _MAX_HELD_TRACK_POINTS
    if couplings.between is not None:
        all_frames = slice(0, m.frames)
        single = [(point,) for point in range(m.points_per_frame) if not any(point in cluster for cluster in clusters)]
        batches = _batches([*single, *clusters], max(1, most // (m.frames * m.sessions)))
        return [_Clusters(m, batch, all_frames, couplings) for batch in batches]
    large = [cluster for cluster in clusters if len(cluster) > 2]
    pairs = [cluster for cluster in clusters if len(cluster) == 2]
    partition: list[Part] = []
    for frames in m.frame_slices():
        if sum(map(len, large)) < m.points_per_frame:
            partition.append(_PointsAndPairs(m, frames, pairs, large, couplings.within))
        partition += [_Clusters(m, batch, frames, couplings) for batch in _batches(large, len(large))]
    return partition


def _batches(clusters: Sequence[Cluster], max_length: int) -> list[list[Cluster]]:
    """Batches of at most ``max_length`` clusters that can be eliminated together, small ones first."""
    batches: list[list[Cluster]] = []
    for rows in sorted({rows_per_block(len(cluster)) for cluster in clusters}):
        alike = sorted((cluster for cluster in clusters if rows_per_block(len(cluster)) == rows), key=len)
        batches += [alike[first : first + max_length] for first in range(0, len(alike), max_length)]
    return batches


class _PointsAndPairs:
    """Single points and pairs of points in some frames: all points that are not in a large cluster."""

    def __init__(
        self,
        measurements: Measurements,
        frames: slice,
        pairs: Sequence[Cluster],
        large: Sequence[Cluster],
        within: WithinFrame,
    ) -> None:
        m, device = measurements, measurements.pixels.device
        excluded = {point for cluster in large for point in cluster}
        points = [point for point in range(m.points_per_frame) if point not in excluded]
        frame = torch.arange(frames.start, frames.stop, device=device)[:, None]
        self.columns: Columns = slice(frames.start * m.points_per_frame, frames.stop * m.points_per_frame)
        if excluded:
            self.columns = (m.points_per_frame * frame + torch.tensor(points, dtype=torch.long, device=device)).flatten()
        self.chunks: list[Columns] = [self.columns]
        members = torch.tensor([[points.index(point) for point in pair] for pair in pairs], dtype=torch.long, device=device)
        frame_start = len(points) * (frame - frames.start)
        self._first, self._second = ((frame_start + member).flatten() for member in members.view(-1, 2).unbind(1))
        blocks = [block[..., frames] for a, b in pairs if (block := within.between(a, b)) is not None]
        self._pair_blocks = torch.stack(blocks, dim=-1).flatten(-2) if blocks else None

    def eliminate(self, hessian: Tensor) -> PointElimination:
        return PointElimination(hessian, self._first, self._second, self._pair_blocks)


class _Clusters:
    """Clusters of points, in some frames. The columns are in the order size, cluster, frame, member."""

    def __init__(self, measurements: Measurements, clusters: Sequence[Cluster], frames: slice, couplings: Couplings) -> None:
        m, device = measurements, measurements.pixels.device
        self._frames, self._couplings = frames, couplings
        self._by_size = [list(equal) for _, equal in itertools.groupby(clusters, key=len)]
        self._points = [torch.tensor(equal, device=device) for equal in self._by_size]
        frame_start = m.points_per_frame * torch.arange(frames.start, frames.stop, device=device)[:, None]
        self.columns: Columns = torch.cat([(points[:, None] + frame_start).flatten() for points in self._points])
        self.chunks: list[Columns] = list(self.columns.split(max(1, m.chunk_keypoints // (m.sessions * m.num_cameras))))

    def eliminate(self, hessian: Tensor) -> TrackElimination:
        frames = self._frames.stop - self._frames.start
        own = hessian.split([frames * points.numel() for points in self._points], dim=-1)
        return TrackElimination([self._tracks(number, by_size, frames) for number, by_size in enumerate(own)])

    def _tracks(self, number: int, hessian: Tensor, frames: int) -> Tracks:
        """The clusters of one size as tracks; without a loss that couples frames, each frame as a track of its own."""
        between, points = self._couplings.between, self._points[number]
        by_track = hessian.unflatten(-1, (len(points), frames, -1))
        within = self._within_blocks(number, hessian, frames)
        if between is None:
            none = hessian.new_zeros(len(hessian), 0, len(points) * frames, points.shape[1])
            return Tracks(
                by_track.flatten(2, 3).unsqueeze(3), None if within is None else within.flatten(1, 2)[:, :, None], none, none
            )
        return Tracks(by_track, within, *(f[..., points].to(hessian) for f in (between.next_frame, between.second_frame)))

    def _within_blocks(self, number: int, like: Tensor, frames: int) -> Tensor | None:
        """The blocks between the points of each cluster, (B, T, F, 3 q, 3 q), zero on the diagonal; None for single points."""
        clusters = self._by_size[number]
        size = len(clusters[0])
        if size == 1:
            return None
        blocks = like.new_zeros(len(like), len(clusters), frames, 3 * size, 3 * size)
        for row_of_blocks, cluster in enumerate(clusters):
            for i, row in enumerate(cluster):
                for j, column in enumerate(cluster[i + 1 :], i + 1):
                    block = self._couplings.within.between(row, column)
                    if block is not None:
                        by_frame = block[..., self._frames].movedim(-1, 1).to(like.dtype)
                        blocks[:, row_of_blocks, :, 3 * i : 3 * i + 3, 3 * j : 3 * j + 3] = by_frame
                        blocks[:, row_of_blocks, :, 3 * j : 3 * j + 3, 3 * i : 3 * i + 3] = by_frame.mT
        return blocks
