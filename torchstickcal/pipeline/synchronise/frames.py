"""Sessions on a common frame axis, whatever the cameras' clocks, frame rates and dropped frames."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchstickcal.errors import ObservationError
from torchstickcal.observations import Observations


@dataclass(frozen=True, eq=False)
class CommonFrames:
    """A session whose cameras' frames stand beside each other: frame g of all cameras was exposed at about the same time.

    Common frames are those of camera 0's clock, from its time 0 on. G of them are kept, from the first that two cameras have
    to the last.
    """

    observations: Observations
    """the session on the common frames, NaN where a camera has none"""
    index: Tensor
    """(C, F), the place of each camera's own frames among the common ones; -1 where it has none"""
    lags: Tensor
    """(C, G), float64: how much later than the common frame a camera's frame begins, frames; 0 where it has none"""
    offsets_frames: Tensor
    """(C,), float64, how much later than told the cameras' frames are taken to begin, frames"""
    first: int
    """the common frame that is kept first"""
    rate_hz: float | None
    """common frames per second; None where that is not known"""

    @property
    def apart(self) -> bool:
        """Whether keypoints at one common frame were not all exposed together, as far as that was told."""
        return bool((self.lags != 0).any()) or bool(self.observations.readout_s)

    def to_own(self, values: Tensor, fill: float) -> Tensor:
        """Values (C, G, ...) of the common frames at the cameras' own frames, (C, F, ...)."""
        if _in_place(self.index):
            return values
        cameras = torch.arange(len(self.index), device=self.index.device)[:, None]
        missing = (self.index < 0).view(*self.index.shape, *[1] * (values.ndim - 2))
        return values[cameras, self.index.clamp_min(0)].masked_fill(missing, fill)


def on_common_frames(observations: Observations, offsets_frames: Tensor | None = None) -> CommonFrames:
    """A session on common frames, every camera's frame at the nearest one.

    Args:
        observations: the session.
        offsets_frames: (C,), how much later than reckoned camera c's frames begin, common frames; None for not at all.

    Raises:
        ObservationError: if no two cameras have a frame in common, or the stick is never seen by two cameras there.
    """
    rate, begins = _begins(observations)
    offsets = begins.new_zeros(len(begins)) if offsets_frames is None else offsets_frames.to(begins)
    begins = begins + offsets[:, None]
    exists = begins.isfinite()
    common = (begins.nan_to_num() + 0.5).floor().long()
    starts = torch.where(exists, common, torch.iinfo(torch.long).max).amin(1).sort().values
    ends = torch.where(exists, common, torch.iinfo(torch.long).min).amax(1).sort().values
    first, last = int(starts[1]), int(ends[-2])
    if last < first:
        raise ObservationError(
            "no two cameras have a frame in common",
            where="timestamps" if observations.timestamps is not None else "offsets_frames",
            got=f"cameras' first frames {starts.tolist()}, last frames {ends.tolist()}",
            expected="times that overlap",
            remedy="Timestamps count from a moment that the cameras share, at least roughly.",
        )
    lags = begins.nan_to_num() - common
    index = torch.where(exists & (common >= first) & (common <= last), common - first, -1)
    index = _nearest(index, lags, last - first + 1)
    if _in_place(index):
        return CommonFrames(observations, index, lags, offsets, first, rate)
    placed = _Placed(index, last - first + 1)
    confidence = observations.confidence
    moved = replace(
        observations,
        keypoints=placed(observations.keypoints, torch.nan),
        confidence=None if confidence is None else placed(confidence, 0.0),
        timestamps=None,
        fps=rate,
    )
    return CommonFrames(moved, index, placed(lags, 0.0), offsets, first, rate)


def _begins(observations: Observations) -> tuple[float | None, Tensor]:
    """Common frames per second, and when every frame (C, F) begins, in common frames; NaN where a camera has no frame."""
    times = observations.timestamps
    if times is None:
        frames = torch.arange(observations.num_frames, dtype=torch.float64, device=observations.keypoints.device)
        return observations.fps, frames.expand(observations.num_cameras, -1)
    rate = observations.fps or float(max(1 / camera[camera.isfinite()].diff().median() for camera in times.double()))
    return rate, times.double() * rate


def _in_place(index: Tensor) -> bool:
    """Whether every camera's own frames are the common ones."""
    return torch.equal(index, torch.arange(index.shape[1], device=index.device).expand_as(index))


def _nearest(index: Tensor, lags: Tensor, frames: int) -> Tensor:
    """Places (C, F) with -1 for those of several frames at one common frame that are further from it."""
    cost = torch.where(index >= 0, lags.abs(), torch.inf)
    best = lags.new_full((len(index), frames), torch.inf).scatter_reduce(1, index.clamp_min(0), cost, "amin")
    return torch.where(cost <= best.gather(1, index.clamp_min(0)), index, -1)


@dataclass(frozen=True)
class _Placed:
    """Moves values (C, F, ...) of the cameras' own frames to the common ones (C, G, ...)."""

    index: Tensor
    frames: int

    def __call__(self, values: Tensor, fill: float) -> Tensor:
        placed = values.new_full((len(values), self.frames, *values.shape[2:]), fill)
        cameras, own = (self.index >= 0).nonzero(as_tuple=True)
        placed[cameras, self.index[cameras, own]] = values[cameras, own]
        return placed
