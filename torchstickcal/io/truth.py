"""The truth of a session: the values that a calibration should find."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True, eq=False)
class Truth:
    """True values of a session: known exactly in a simulation, from another calibration in a recording.

    None for a value that is not known.
    """

    rotations: Tensor
    """(C, 3, 3), world to camera"""
    translations: Tensor
    """(C, 3), world to camera, metres"""
    points: Tensor | None = None
    """(F, P, 3), metres, at the times of the frames of the first camera"""
    intrinsics: Tensor | None = None
    """(C, 3, 3), camera matrices, pixels; the session may give wrong ones"""
    distortion: Tensor | None = None
    """(C, D), distortion coefficients in OpenCV's order; the session may give wrong ones"""
    time_offsets_s: Tensor | None = None
    """(C,), time by which each frame of a camera begins after the same frame of the first camera, seconds"""
    readout_s: Tensor | None = None
    """(C,), read-out time of a rolling shutter, seconds: row v of an image of height h is exposed ``readout_s * v / h`` after
    the frame begins"""
