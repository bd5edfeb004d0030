"""The cameras of a calibration, as files hold them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import torch
from torch import Tensor

from torchstickcal.errors import CalibrationError
from torchstickcal.shapes import check_shapes
from torchstickcal.world import World

if TYPE_CHECKING:
    from torchstickcal.result import Calibration

_ROTATION_TOLERANCE = 1e-3
"""Largest entry of ``R R^T - 1`` of a rotation: files may give rotations with three or four digits."""

METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001}
"""The units of length that a file may have, in metres."""


@dataclass(frozen=True, eq=False)
class RigCamera:
    """One camera of a calibration file, as files give it: arrays or lists of numbers."""

    name: str
    matrix: Any
    """(3, 3)"""
    distortion: Any = ()
    """coefficients in OpenCV's order, in any shape"""
    fisheye: bool = False
    image_size: Any = None
    """width and height; None if they are not known"""
    rotation: Any = None
    """a rotation vector (3,) or matrix (3, 3), world to camera; None if the pose is not known"""
    translation: Any = None
    """(3,), world to camera"""


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
    image_size: Tensor | None = None
    """(C, 2), width and height, pixels; NaN or None where they are not known"""
    rotations: Tensor | None = None
    """(C, 3, 3), world to camera; None if the poses of some cameras are not known"""
    translations: Tensor | None = None
    """(C, 3), world to camera, in metres unless ``unit`` is None"""
    unit: str | None = "m"
    """unit of length in the file; None if neither the file nor its format says which it is"""
    world: World | None = None
    """the frame of the poses; None where a file does not say it"""
    error_px: float | None = None
    """median reprojection error, mean over the cameras; None where it is not known"""

    @classmethod
    def of_calibration(cls, calibration: Calibration) -> Rig:
        """The cameras of a calibration that was estimated."""
        distortion, size = calibration.distortion, calibration.image_size
        none = torch.zeros(0, dtype=torch.float64)
        count = len(calibration.camera_names)
        lenses = tuple(none if distortion is None else distortion[index].double().cpu() for index in range(count))
        return cls(
            names=calibration.camera_names,
            intrinsics=calibration.intrinsics.cpu(),
            distortion=lenses,
            fisheye=(calibration.fisheye,) * count,
            image_size=None if size is None else size.cpu(),
            rotations=calibration.rotations.cpu(),
            translations=calibration.translations.cpu(),
            world=calibration.world,
            error_px=float(calibration.reprojection_median_px.mean()),
        )

    def in_metres(self, unit: str | None = None) -> Rig:
        """The same in metres; arguments and errors as of :meth:`poses`. Without poses there is nothing to do."""
        if self.rotations is None:
            return self
        rotations, translations = self.poses(unit)
        return replace(self, rotations=rotations, translations=translations, unit="m")

    def coefficients(self, camera: int, least: int, most: int, what: str) -> list[float]:
        """The distortion coefficients of a camera for a format that holds some number of them.

        Args:
            camera: its index.
            least: how many there must be; zeros are appended.
            most: how many there may be, 4 for a fisheye lens.
            what: the format, for the message.

        Raises:
            CalibrationError: if it has more.
        """
        values = self.distortion[camera].tolist()
        most = min(most, 4) if self.fisheye[camera] else most
        if any(values[most:]):
            raise CalibrationError(
                "a lens that the format cannot hold",
                where=f"{what}, {self.names[camera]}",
                got=f"{len(values)} distortion coefficients",
                expected=f"at most {most}",
            )
        values = values[:most]
        return values + [0.0] * (min(least, most) - len(values))

    def size(self, camera: int) -> list[float]:
        """Width and height of a camera's images, pixels; where they are not known, twice the principal point."""
        if self.image_size is not None and bool(self.image_size[camera].isfinite().all()):
            return self.image_size[camera].tolist()
        return (2 * self.intrinsics[camera, :2, 2]).tolist()

    def check_plain(self, what: str, fisheye: bool = True) -> None:
        """Raise a CalibrationError if the cameras are skewed, or have fisheye lenses that a format (``what``) cannot hold."""
        for name, matrix, is_fisheye in zip(self.names, self.intrinsics, self.fisheye, strict=True):
            got = f"a skew of {float(matrix[0, 1]):g} pixels" if matrix[0, 1] else "a fisheye lens"
            if bool(matrix[0, 1]) or (is_fisheye and not fisheye):
                expected = "pixels at right angles" if matrix[0, 1] else "OpenCV's usual lens model"
                raise CalibrationError(
                    "a camera that the format cannot hold", where=f"{what}, {name}", got=got, expected=expected
                )

    @classmethod
    def of(cls, cameras: Sequence[RigCamera], unit: str | None = "m") -> Rig:
        """The rig of some cameras, whose translations are in a unit of :data:`METRES`, or in one that is not known (None).

        Raises:
            CalibrationError: as for :class:`Rig`.

        Example:
            >>> matrix = [[500, 0, 320], [0, 500, 240], [0, 0, 1]]
            >>> rig = Rig.of([RigCamera("left", matrix, rotation=[0, 0, 0], translation=[0, 0, 2500])], "mm")
            >>> rig.translations, rig.image_size
            (tensor([[0.0000, 0.0000, 2.5000]], dtype=torch.float64), tensor([[nan, nan]], dtype=torch.float64))
        """
        posed = all(camera.rotation is not None and camera.translation is not None for camera in cameras)
        sizes = [(np.nan, np.nan) if camera.image_size is None else camera.image_size for camera in cameras]
        return cls(
            names=tuple(camera.name for camera in cameras),
            intrinsics=_stacked("matrix", [camera.matrix for camera in cameras], (3, 3)),
            distortion=tuple(as_float64("distortion", camera.distortion).flatten() for camera in cameras),
            fisheye=tuple(camera.fisheye for camera in cameras),
            image_size=_stacked("image size", sizes, (2,)),
            rotations=torch.stack([rotation_matrix(camera.rotation) for camera in cameras]) if posed and cameras else None,
            translations=_stacked("translation", [camera.translation for camera in cameras], (3,)) * METRES[unit or "m"]
            if posed
            else None,
            unit=unit,
        )

    def poses(self, unit: str | None = None) -> tuple[Tensor, Tensor]:
        """The rotations (C, 3, 3) and the translations (C, 3) in metres, world to camera.

        Args:
            unit: of the file, a key of :data:`METRES`; needed where :attr:`unit` is None.

        Raises:
            CalibrationError: if there are no poses, or if their unit is not known or another one.
        """
        if self.rotations is None or self.translations is None:
            raise CalibrationError(
                "a calibration without poses", where="Rig", got="intrinsics alone", expected="a pose of every camera"
            )
        if unit is not None and unit not in METRES:
            raise CalibrationError("no unit of length", where="units", got=repr(unit), expected=f"one of {', '.join(METRES)}")
        if self.unit is None and unit is None:
            raise CalibrationError(
                "the unit of length is not known",
                where="units",
                got="a file that does not say it",
                expected=f"one of {', '.join(METRES)}",
                remedy="Say it with --units.",
            )
        if self.unit is not None and unit not in (None, self.unit):
            raise CalibrationError("another unit of length", where="units", got=unit, expected=f"{self.unit}, as in the file")
        return self.rotations, self.translations * (METRES[unit] if self.unit is None and unit else 1.0)

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
        finite = {name: getattr(self, name) for name in shapes if name != "image_size"}
        check_finite("Rig", finite | {"distortion": torch.cat(distortion)})
        if self.image_size is not None and bool(((self.image_size <= 0) | self.image_size.isinf()).any()):
            got = self.image_size.tolist()
            raise CalibrationError("an image without pixels", where="Rig: image_size", got=got, expected="width and height")
        if self.rotations is not None:
            check_rotations("Rig", self.rotations)


def rotation_matrix(rotation: Any) -> Tensor:
    """The matrix (3, 3) of a rotation vector of 3 numbers, or of a matrix of 9.

    Raises:
        CalibrationError: if it is neither.
    """
    values = as_float64("rotation", rotation)
    if values.numel() == 9:
        return values.reshape(3, 3)
    if values.numel() == 3:
        check_finite("rotation", {"vector": values})
        return torch.from_numpy(cv2.Rodrigues(values.reshape(3).numpy())[0])
    got = f"{values.numel()} numbers"
    raise CalibrationError("not a rotation", where="rotation", got=got, expected="a vector of 3 numbers or a matrix of 9")


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


def _stacked(what: str, values: Sequence[Any], shape: tuple[int, ...]) -> Tensor:
    """Values (C, *shape) of all cameras.

    Raises:
        CalibrationError: if one of them has another number of numbers.
    """
    tensors = [as_float64(what, value) for value in values]
    for tensor in tensors:
        if tensor.numel() != int(np.prod(shape)):
            raise CalibrationError("a value of another shape", where=what, got=tuple(tensor.shape), expected=str(shape))
    return torch.stack([tensor.reshape(shape) for tensor in tensors]) if tensors else torch.zeros(0, *shape)
