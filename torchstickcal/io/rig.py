"""The cameras of a calibration, as files hold them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchstickcal.errors import CalibrationError
from torchstickcal.shapes import check_shapes

_ROTATION_TOLERANCE = 1e-3
"""Largest entry of ``R R^T - 1`` of a rotation: files may give rotations with three or four digits."""


@dataclass(frozen=True, eq=False)
class Rig:
    """The C cameras of a calibration file, float64. Arrays and lists are accepted and kept as tensors.

    A camera maps a point X of the world to ``R X + t`` in its own frame, metres.

    Raises:
        CalibrationError: if the values do not fit together, are not finite, or if a rotation is none.
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

    def __post_init__(self) -> None:
        put_float64(self, ("rotations", "translations", "intrinsics", "image_size"))
        distortion = tuple(as_float64(f"Rig: distortion[{number}]", one) for number, one in enumerate(self.distortion))
        object.__setattr__(self, "distortion", distortion)
        shapes = {"rotations": "C 3 3", "translations": "C 3", "intrinsics": "C 3 3", "image_size": "C 2"}
        cameras = check_shapes("Rig", vars(self), shapes)["C"]
        for coefficients in distortion:
            check_shapes("Rig", {"distortion": coefficients}, {"distortion": "D"})
        counts = {"names": len(self.names), "distortion": len(distortion), "fisheye": len(self.fisheye)}
        for name, count in counts.items():
            if count != cameras or cameras == 0:
                raise CalibrationError(
                    "not one value for each camera", where=f"Rig: {name}", got=count, expected=f"{cameras}, and 1 or more"
                )
        check_finite("Rig", {name: getattr(self, name) for name in shapes} | {"distortion": torch.cat(distortion)})
        check_rotations("Rig", self.rotations)


def put_float64(owner: Any, names: tuple[str, ...]) -> None:
    """Turn fields of a frozen dataclass, if they are not None, into tensors of dtype float64."""
    for name in names:
        value = getattr(owner, name)
        if value is not None:
            object.__setattr__(owner, name, as_float64(f"{type(owner).__name__}: {name}", value))


def as_float64(where: str, value: Any) -> Tensor:
    """A tensor of dtype float64 from a tensor, an array or lists of real numbers; a CalibrationError for anything else."""
    try:
        if isinstance(value, Tensor) and not value.is_complex():
            return value.detach().double()
        array = np.asarray(value)
        if array.dtype.kind in "biuf":
            return torch.from_numpy(array.astype(np.float64))
        got = f"an array of the type {array.dtype}"
    except (TypeError, ValueError, OverflowError) as error:
        got = f"{type(value).__name__}: {error}"[:200]
    raise CalibrationError("not an array of numbers", where=where, got=got, expected="real numbers")


def check_finite(owner: str, tensors: dict[str, Tensor | None]) -> None:
    """Raise a CalibrationError for the first tensor with NaN or infinity."""
    for name, tensor in tensors.items():
        if tensor is not None and not bool(tensor.isfinite().all()):
            bad = f"{int((~tensor.isfinite()).sum())} of {tensor.numel()} values that are NaN or infinite"
            raise CalibrationError("a value that is not finite", where=f"{owner}: {name}", got=bad, expected="finite numbers")


def check_rotations(owner: str, rotations: Tensor) -> None:
    """Raise a CalibrationError for the first of some matrices (C, 3, 3) that is not a rotation."""
    deviations = (rotations @ rotations.mT - torch.eye(3, dtype=rotations.dtype, device=rotations.device)).abs().amax((1, 2))
    bad = ~(deviations <= _ROTATION_TOLERANCE) | (torch.linalg.det(rotations) <= 0)
    if bool(bad.any()):
        raise CalibrationError(
            "a matrix that is not a rotation",
            where=f"{owner}: rotations[{int(bad.nonzero()[0])}]",
            got=[[float(f"{entry:.4g}") for entry in row] for row in rotations[bad][0].tolist()],
            expected="an orthogonal matrix of determinant 1",
            remedy="Rotations are given as matrices from the world to the camera.",
        )
