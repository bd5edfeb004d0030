"""Cameras whose clocks differ: their offsets from the motion itself, and sessions on a common frame axis."""

from __future__ import annotations

from torchstickcal.synchronise.exposure import Exposures
from torchstickcal.synchronise.frames import CommonFrames, on_common_frames
from torchstickcal.synchronise.search import ClockEstimate, out_of_step, search_offsets

__all__ = ["ClockEstimate", "CommonFrames", "Exposures", "on_common_frames", "out_of_step", "search_offsets"]
