"""The cameras of a calibration, as files hold them."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True, eq=False)
class Rig:
    """The C cameras of a calibration file, float64.

    A camera maps a point X of the world to ``R X + t`` in its own frame, metres.
    """

    names: tuple[str, ...]
    """C names"""
    intrinsics: Tensor
    """(C, 3, 3), camera matrices, pixels"""
    distortion: tuple[Tensor, ...]
    """C vectors of distortion coefficients, in OpenCV's order"""
    fisheye: tuple[bool, ...]
    """for each camera, whether its coefficients are those of OpenCV's fisheye model"""
    image_size: Tensor
    """(C, 2), width and height, pixels"""
    rotations: Tensor
    """(C, 3, 3), world to camera"""
    translations: Tensor
    """(C, 3), world to camera, metres"""
