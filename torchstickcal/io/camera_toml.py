"""Calibration files of Pose2Sim, aniposelib and FreeMoCap (``calibration.toml``).

One table per camera: world to camera, rotation vectors; metres in files of Pose2Sim and of this library, millimetres in those
of FreeMoCap, and a unit that the file does not say in those of aniposelib. Both programs take every top-level table other than
``metadata`` for a camera. aniposelib sorts the names of the tables as text, so their numbers are written with leading zeros.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any, TypeVar

import cv2
import torch
from torch import Tensor

from torchstickcal.files import atomic_path, check_text
from torchstickcal.io.formats import calibration_reader, calibration_writer, reading
from torchstickcal.io.rig import METRES, Rig, RigCamera, as_float64
from torchstickcal.result import Calibration
from torchstickcal.shapes import check_shapes
from torchstickcal.untrusted import read_toml

_NAME = "pose2sim"
_DESCRIPTION = "cameras of Pose2Sim, aniposelib, Anipose or FreeMoCap (.toml)"
_NOT_CAMERAS = {"metadata", "capture_volume", "charuco", "checkerboard"}
_CAMERA_TABLE = re.compile(rb"^(?:\xef\xbb\xbf)?\[[^\[\].]+\]\s*\n(?:(?!\[).*\n)*?matrix\s*=", re.MULTILINE)
"""A top-level table with a camera matrix."""
_COEFFICIENTS = 4
"""Number of distortion coefficients that Pose2Sim writes."""
_Value = TypeVar("_Value")


@calibration_writer(_NAME, _DESCRIPTION, file_name="calibration.toml")
def write_camera_toml(path: str | Path, calibration: Calibration) -> None:
    """Write the cameras of a calibration for Pose2Sim and aniposelib.

    The distortion coefficients of a camera are written in OpenCV's order: those of the calibration, with zeros up to 5 of
    them (4 for fisheye lenses). If the image size is not known, twice the principal point is written in its place.

    Args:
        path: of the file.
        calibration: the calibration.

    Raises:
        CalibrationError: if a camera has a name that no file can hold.
        OSError: if the file cannot be written.

    Example:
        >>> import tempfile
        >>> from torchstickcal import calibrate
        >>> from torchstickcal.io import read_camera_toml, write_camera_toml
        >>> from torchstickcal.simulate import golf_session
        >>> calibration = calibrate(golf_session(cameras=3, frames=10)[0])
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_camera_toml(f"{folder}/calibration.toml", calibration)
        ...     rig = read_camera_toml(f"{folder}/calibration.toml")
        >>> bool((rig.translations == calibration.translations).all())
        True
    """
    for name in calibration.camera_names:
        check_text(name, "camera_names")
    count = len(calibration.camera_names)
    names = [f"cam_{number:0{len(str(count - 1))}d}" for number in range(count)]
    tables = [f"[{name}]\n{_camera(calibration, number)}" for number, name in enumerate(names)]
    with atomic_path(path) as temporary:
        temporary.write_text("\n".join([*tables, _metadata(calibration)]), "utf-8")


@calibration_reader(_NAME, _DESCRIPTION, recognises=lambda path, head: _CAMERA_TABLE.search(head) is not None)
def read_camera_toml(path: str | Path) -> Rig:
    """Read a calibration file of Pose2Sim, aniposelib or FreeMoCap.

    Args:
        path: of the file.

    Returns:
        The cameras, in the order of the file.

    Raises:
        FileFormatError: if the file is not TOML, holds no camera, or one whose values are not complete or not finite.
        FileNotFoundError: if there is no such file.

    Example:
        >>> import pathlib, tempfile
        >>> from torchstickcal.io import read_camera_toml
        >>> text = '''
        ... [cam_0]
        ... name = "left"
        ... size = [640.0, 480.0]
        ... matrix = [[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]]
        ... distortions = [0.0, 0.0, 0.0, 0.0]
        ... rotation = [0.0, 0.0, 0.0]
        ... translation = [0.0, 0.0, 2.5]
        ... '''
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = pathlib.Path(folder, "calibration.toml")
        ...     _ = path.write_text(text)
        ...     rig = read_camera_toml(path)
        >>> rig.names, rig.translations.tolist(), rig.unit
        (('left',), [[0.0, 0.0, 2.5]], None)
    """
    with reading(path, _DESCRIPTION):
        content = read_toml(path)
        cameras = {key: table for key, table in content.items() if key not in _NOT_CAMERAS}
        if not cameras:
            raise KeyError("table of a camera")
        return Rig.of([_rig_camera(key, table) for key, table in cameras.items()], _unit(cameras, content.get("metadata", {})))


def _rig_camera(key: str, table: dict[str, Any]) -> RigCamera:
    posed = "rotation" in table or "translation" in table
    return RigCamera(
        name=_given(table, "name", str, key),
        matrix=table["matrix"],
        distortion=_vector(table, "distortions"),
        fisheye=_given(table, "fisheye", bool, False),
        image_size=table["size"],
        rotation=_vector(table, "rotation") if posed else None,
        translation=table["translation"] if posed else None,
    )


def _vector(table: dict[str, Any], key: str) -> Tensor:
    """A list of numbers of a camera's table; rotations are vectors in these files."""
    vector = as_float64(key, table[key])
    check_shapes(key, {key: vector}, {key: "3" if key == "rotation" else "D"})
    return vector


def _unit(cameras: dict[str, Any], metadata: dict[str, Any]) -> str | None:
    """The unit of length: as the file says, else that of the program that wrote it.

    FreeMoCap writes millimetres and ``world_position``; Pose2Sim writes metres, ``fisheye`` and no more than 4 coefficients.
    aniposelib writes whatever unit its board was measured in.
    """
    said = metadata.get("units")
    if said in METRES:
        return str(said)
    if any("world_position" in table for table in cameras.values()):
        return "mm"
    pose2sim = all("fisheye" in table and len(table["distortions"]) == _COEFFICIENTS for table in cameras.values())
    return "m" if pose2sim else None


def _camera(calibration: Calibration, index: int) -> str:
    """The lines of a camera's table."""
    matrix = calibration.intrinsics[index].double().cpu()
    size = 2 * matrix[:2, 2] if calibration.image_size is None else calibration.image_size[index].double().cpu()
    rotation, _ = cv2.Rodrigues(calibration.rotations[index].double().cpu().numpy())
    values = {
        "name": _quoted(calibration.camera_names[index]),
        "size": size.tolist(),
        "matrix": matrix.tolist(),
        "distortions": _distortion(calibration, index).tolist(),
        "rotation": rotation[:, 0].tolist(),
        "translation": calibration.translations[index].double().cpu().tolist(),
        "fisheye": str(calibration.fisheye).lower(),
    }
    return "".join(f"{key} = {value}\n" for key, value in values.items())


def _distortion(calibration: Calibration, index: int) -> Tensor:
    """The distortion coefficients of a camera, (4,) for a fisheye lens, else (D,) with D of 5 or more."""
    given = torch.zeros(5) if calibration.distortion is None else calibration.distortion[index].double().cpu()
    return given if calibration.fisheye else torch.nn.functional.pad(given, (0, max(0, 5 - len(given))))


def _metadata(calibration: Calibration) -> str:
    error = float(calibration.reprojection_median_px.mean())
    return f'[metadata]\nadjusted = false\nerror = {error!r}\nunits = "m"\ngenerator = "torchstickcal"\n'


def _given(camera: dict[str, Any], key: str, kind: type[_Value], default: _Value) -> _Value:
    """A value of a camera's table, or a default where it has none."""
    value = camera.get(key, default)
    if not isinstance(value, kind):
        raise TypeError(f"{key} is a {type(value).__name__} where a {kind.__name__} is expected")
    return value


def _quoted(name: str) -> str:
    """A text as TOML: JSON, with the one character escaped that JSON allows and TOML does not."""
    return json.dumps(name, ensure_ascii=False).replace("\x7f", "\\u007f")
