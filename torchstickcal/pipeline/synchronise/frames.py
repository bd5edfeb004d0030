"""Sessions on common frames, for cameras with different clocks, different frame rates or dropped frames."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchstickcal.errors import ObservationError
from torchstickcal.model.trajectories import WINDOW_FRAMES
from torchstickcal.observations import Observations
from torchstickcal.shapes import extended

_FURTHEST_FRAME = 1e12
_LONGEST_PAUSE_FRAMES = WINDOW_FRAMES
"""Frames without keypoints beyond which the frames on both sides have nothing to do with each other."""


@dataclass(frozen=True, eq=False)
class CommonFrames:
    """A session in which frame g of all cameras was exposed at about the same time.

    Frame n of the session is at time n on the clock of camera 0, in frames. G of these are the common frames: from the first to
    the last that at least two cameras have, without the middle of long pauses in which no camera has a frame.
    """

    observations: Observations
    """the session on the common frames; NaN where a camera has no frame"""
    index: Tensor
    """(C, F), the common frame (of G) of each camera's own frames; -1 for frames without one"""
    lags: Tensor
    """(C, G), float64, time from a common frame to the start of the camera's frame, in frames; 0 where it has no frame"""
    offsets_frames: Tensor
    """(C,), float64, time offsets that were added to the cameras' timestamps or frame numbers, in frames"""
    numbers: Tensor
    """(G,), int64, the frame of the session that each common frame is"""
    rate_hz: float | None
    """common frames per second; None if unknown"""

    @property
    def apart(self) -> bool:
        """Whether the keypoints of a common frame have different exposure times, by timestamps, offsets and read-out time."""
        return bool((self.lags != 0).any()) or bool(self.observations.readout_s)

    def to_own(self, values: Tensor, fill: float) -> Tensor:
        """Values (C, F, ...) for the cameras' own frames, from values (C, G, ...) for the common frames."""
        if _is_identity(self.index):
            return values
        cameras = torch.arange(len(self.index), device=self.index.device)[:, None]
        missing = extended(self.index < 0, values.ndim)
        return values[cameras, self.index.clamp_min(0)].masked_fill(missing, fill)


def on_common_frames(observations: Observations, offsets_frames: Tensor | None = None) -> CommonFrames:
    """Assign each frame of each camera to the nearest common frame.

    Args:
        observations: the session.
        offsets_frames: time offsets to add to the cameras' timestamps or frame numbers, (C,), in common frames; None for zero.

    Raises:
        ObservationError: if no two cameras have a frame in common, or no two of them see the stick there.
    """
    rate, starts = _frame_starts(observations)
    offsets = starts.new_zeros(len(starts)) if offsets_frames is None else offsets_frames.to(starts)
    starts = starts + offsets[:, None]
    exists = starts.isfinite()
    _check_resolution(starts, observations)
    nearest = (starts.nan_to_num() + 0.5).floor().long()
    firsts = torch.where(exists, nearest, torch.iinfo(torch.long).max).amin(1).sort().values
    lasts = torch.where(exists, nearest, torch.iinfo(torch.long).min).amax(1).sort().values
    first, last = int(firsts[1]), int(lasts[-2])
    if last < first:
        raise ObservationError(
            "no two cameras have a frame in common",
            where="timestamps" if observations.timestamps is not None else "offsets_frames",
            got=f"first frames of the cameras {firsts.tolist()}, last frames {lasts.tolist()}, both sorted",
            expected="at least two cameras whose times overlap",
            remedy="Check that the times of all cameras count from about the same moment.",
        )
    lags = starts.nan_to_num() - nearest
    within = exists & (nearest >= first) & (nearest <= last)
    numbers, places = _without_pauses(nearest.where(within, first))
    index = _without_duplicates(places.where(within, -1), lags, len(numbers))
    if _is_identity(index):
        return CommonFrames(observations, index, lags, offsets, numbers, rate)
    to_common = _ToCommonFrames(index, len(numbers))
    confidence = observations.confidence
    on_common = replace(
        observations,
        keypoints=to_common(observations.keypoints, torch.nan),
        confidence=None if confidence is None else to_common(confidence, 0.0),
        timestamps=None,
        fps=rate,
    )
    return CommonFrames(on_common, index, to_common(lags, 0.0), offsets, numbers, rate)


def _frame_starts(observations: Observations) -> tuple[float | None, Tensor]:
    """Common frames per second, and the start of each frame (C, F) in common frames; NaN where a camera has no frame."""
    times = observations.timestamps
    if times is None:
        frames = torch.arange(observations.num_frames, dtype=torch.float64, device=observations.keypoints.device)
        return observations.fps, frames.expand(observations.num_cameras, -1)
    rate = observations.fps or float(max(1 / camera[camera.isfinite()].diff().median() for camera in times.double()))
    return rate, times.double() * rate


def _check_resolution(starts: Tensor, observations: Observations) -> None:
    """Refuse times so far from zero, in frames, that a float64 cannot tell a frame from the next.

    Raises:
        ObservationError: if there is such a time.
    """
    furthest = float(starts.nan_to_num(posinf=torch.inf).abs().max())
    if furthest > _FURTHEST_FRAME:
        raise ObservationError(
            "times too far from zero to tell one frame from the next",
            where="timestamps" if observations.timestamps is not None else "offsets_frames",
            got=f"{furthest:.3g} frames from zero",
            expected=f"at most {_FURTHEST_FRAME:.0g} frames",
            remedy="Give timestamps in seconds, from about the beginning of the recording, and fps in frames per second.",
        )


def _without_pauses(nearest: Tensor) -> tuple[Tensor, Tensor]:
    """The common frames of frame numbers (C, F): their numbers (G,), and the place of each given one among them, (C, F).

    A pause is shortened to the number of frames over which nothing acts, so that a session costs what its frames cost.
    """
    taken = nearest.unique()
    places = torch.cat([taken.new_zeros(1), taken.diff().clamp_max(_LONGEST_PAUSE_FRAMES + 1).cumsum(0)])
    kept = torch.arange(int(places[-1]) + 1, device=nearest.device)
    before = torch.searchsorted(places, kept, right=True) - 1
    return taken[before] + kept - places[before], places[torch.searchsorted(taken, nearest)]


def _is_identity(index: Tensor) -> bool:
    """Whether each camera's own frames are the common frames."""
    return torch.equal(index, torch.arange(index.shape[1], device=index.device).expand_as(index))


def _without_duplicates(index: Tensor, lags: Tensor, frames: int) -> Tensor:
    """The index (C, F) with one frame per camera and common frame: the others, with larger lags, are set to -1."""
    distance = torch.where(index >= 0, lags.abs(), torch.inf)
    smallest = lags.new_full((len(index), frames), torch.inf).scatter_reduce(1, index.clamp_min(0), distance, "amin")
    return torch.where(distance <= smallest.gather(1, index.clamp_min(0)), index, -1)


@dataclass(frozen=True)
class _ToCommonFrames:
    """Moves values (C, F, ...) from the cameras' own frames to the common frames, (C, G, ...).

    Args:
        index: the common frame of each own frame, (C, F), or -1.
        frames: G.
    """

    index: Tensor
    frames: int

    def __call__(self, values: Tensor, fill: float) -> Tensor:
        common = values.new_full((len(values), self.frames, *values.shape[2:]), fill)
        cameras, own = (self.index >= 0).nonzero(as_tuple=True)
        common[cameras, self.index[cameras, own]] = values[cameras, own]
        return common
