"""The truth of a session: the values that a calibration should find."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from torchstickcal.errors import CalibrationError
from torchstickcal.io.rig import check_finite, check_rotations, put_float64
from torchstickcal.observations import Observations
from torchstickcal.shapes import check_shapes

_SHAPES = {
    "rotations": "C 3 3",
    "translations": "C 3",
    "points": "F P 3",
    "intrinsics": "C 3 3",
    "distortion": "C D",
    "time_offsets_s": "C",
    "readout_s": "C",
}


@dataclass(frozen=True, eq=False)
class Truth:
    """True values of a session: known exactly in a simulation, from another calibration in a recording.

    None for a value that is not known. Arrays and lists are accepted and kept as tensors of dtype float64. Points may be NaN
    where they are not known.

    Raises:
        CalibrationError: if the values do not fit together, are not finite, or if a rotation is none.
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

    def __post_init__(self) -> None:
        put_float64(self, tuple(_SHAPES))
        check_shapes("Truth", vars(self), _SHAPES)
        check_finite("Truth", {name: getattr(self, name) for name in _SHAPES if name != "points"})
        check_rotations("Truth", self.rotations)

    def check_belongs_to(self, observations: Observations) -> None:
        """Raise a CalibrationError if it is not the truth of as many cameras, frames and points as a session has."""
        given = {"C": observations.num_cameras, "F": observations.num_frames, "P": observations.keypoints.shape[2]}
        for axis, size in check_shapes("Truth", vars(self), _SHAPES).items():
            if given.get(axis, size) != size:
                what = {"C": "cameras", "F": "frames", "P": "points"}[axis]
                raise CalibrationError(
                    "the truth is not that of the session",
                    where="Truth",
                    got=f"{size} {what}",
                    expected=f"{given[axis]} {what}",
                )
