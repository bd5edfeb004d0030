"""Synchronisation of cameras: time offsets from the motion in the images, and sessions on common frames."""

from __future__ import annotations

from torchstickcal.pipeline.synchronise.common_clock import CLOCK_STAGE, synchronise_keypoints
from torchstickcal.pipeline.synchronise.exposure import Exposures, Support
from torchstickcal.pipeline.synchronise.frames import CommonFrames, on_common_frames
from torchstickcal.pipeline.synchronise.search import ClockEstimate, clocks_unlike_given, search_offsets

__all__ = [
    "CLOCK_STAGE",
    "ClockEstimate",
    "CommonFrames",
    "Exposures",
    "Support",
    "clocks_unlike_given",
    "on_common_frames",
    "search_offsets",
    "synchronise_keypoints",
]
