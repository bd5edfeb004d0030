"""How the structure is cut up for elimination: slices of frames, or tracks where a loss ties frames to one another."""

from __future__ import annotations

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


@dataclass(frozen=True)
class Couplings:
    """What ties points to one another, off the diagonal blocks of the structure's Hessian."""

    pairs: Tensor | None
    """(B, 6, F, S), minus the blocks between a stick's ends"""
    next_frame: Tensor | None
    second_frame: Tensor | None
    """multiples of the identity between a point's frames, (B, F - 1, P) and (B, F - 2, P)"""


class Part(Protocol):
    """Points that no loss ties to points outside."""

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


def parts(measurements: Measurements, couplings: Couplings) -> list[Part]:
    """Parts that make up all columns."""
    m = measurements
    if couplings.next_frame is None:
        return [_Frames(m, columns, couplings.pairs) for columns in m.chunks()]
    together = max(1, _TRACK_POINTS // (m.frames * m.sessions))
    paired = torch.zeros(m.points_per_frame, dtype=torch.bool, device=m.pairs.device)
    paired[m.pairs.flatten()] = couplings.pairs is not None
    found: list[Part] = [_Tracks(m, members, couplings, None) for members in (~paired).nonzero().split(together)]
    if couplings.pairs is not None:
        sticks = zip(m.pairs.split(together), couplings.pairs.split(together, dim=-1), strict=True)
        found += [_Tracks(m, members, couplings, between) for members, between in sticks]
    return found


class _Frames:
    """All points of some frames."""

    def __init__(self, measurements: Measurements, columns: slice, pairs: Tensor | None) -> None:
        self.columns = columns
        self.chunks: list[Columns] = [columns]
        points = measurements.points_per_frame
        frames = slice(columns.start // points, columns.stop // points)
        self._coupling = None if pairs is None else pairs[:, :, frames].flatten(2)
        first = points * torch.arange(frames.stop - frames.start, device=measurements.pairs.device)[:, None]
        self._starts, self._ends = ((first + side).flatten() for side in measurements.pairs.unbind(1))

    def eliminate(self, hessian: Tensor) -> PointElimination:
        return PointElimination(hessian, self._starts, self._ends, self._coupling)


class _Tracks:
    """Some points (T, 1), or pairs of points (T, 2), over all frames; columns ordered track, frame, member."""

    def __init__(self, measurements: Measurements, members: Tensor, couplings: Couplings, between: Tensor | None) -> None:
        m = measurements
        self.columns = (
            members[:, None] + m.points_per_frame * torch.arange(m.frames, device=members.device)[:, None]
        ).flatten()
        self.chunks: list[Columns] = list(self.columns.split(max(1, m.chunk_keypoints // (m.sessions * m.num_cameras))))
        self._members, self._frames = members, m.frames
        self._couplings, self._between = couplings, between

    def eliminate(self, hessian: Tensor) -> TrackElimination:
        assert self._couplings.next_frame is not None
        assert self._couplings.second_frame is not None
        by_track = hessian.unflatten(-1, (len(self._members), self._frames, -1))
        next_frame, second_frame = (
            step[..., self._members].to(hessian.dtype) for step in (self._couplings.next_frame, self._couplings.second_frame)
        )
        return TrackElimination(by_track, self._between, next_frame, second_frame)
