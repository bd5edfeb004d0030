"""Calibration files of Pose2Sim, aniposelib and FreeMoCap (``calibration.toml``).

One table per camera: world to camera, rotation vectors; metres in files of Pose2Sim and of this library, millimetres in those
of FreeMoCap, and a unit that the file does not say in those of aniposelib. Both programs take every top-level table other than
``metadata`` for a camera. aniposelib sorts the names of the tables as text, so their numbers are written with leading zeros.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import cv2
from torch import Tensor

from torchstickcal.files import atomic_path, check_text, toml_string
from torchstickcal.io.about import about
from torchstickcal.io.formats import calibration_reader, camera_writer, reading
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
_MOST_COEFFICIENTS = 14
"""Number of distortion coefficients that OpenCV, which these programs use, knows."""
_Value = TypeVar("_Value")


@camera_writer(_NAME, _DESCRIPTION, file_name="calibration.toml")
def write_camera_toml(path: str | Path, calibration: Calibration | Rig) -> None:
    """Write the cameras of a calibration for Pose2Sim and aniposelib.

    The distortion coefficients of a camera are written in OpenCV's order: those of the calibration, with zeros up to 5 of
    them (4 for fisheye lenses). If the image size is not known, twice the principal point is written in its place.

    Args:
        path: of the file.
        calibration: the calibration, or its cameras.

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
    rig = calibration if isinstance(calibration, Rig) else Rig.of_calibration(calibration)
    tables = [
        (key, camera_table(rig, camera) | {"fisheye": str(rig.fisheye[camera]).lower()})
        for camera, key in enumerate(table_names(rig))
    ]
    write_tables(path, tables, {"adjusted": "false", "error": _number(rig.error_px), **_about("m", "metres", rig)})


@camera_writer("anipose", "cameras of aniposelib and Anipose, in metres (.toml)", file_name="anipose.toml")
def write_anipose(path: Path, rig: Rig) -> None:
    """Write the cameras for aniposelib, which knows lenses of up to 5 coefficients."""
    lenses = [rig.coefficients(camera, 5, 5, "aniposelib") for camera in range(len(rig.names))]
    tables = [
        (key, camera_table(rig, camera) | {"distortions": lenses[camera], "fisheye": str(rig.fisheye[camera]).lower()})
        for camera, key in enumerate(table_names(rig))
    ]
    write_tables(path, tables, {"adjusted": "false", "error": _number(rig.error_px), **_about("m", "metres", rig)})


@camera_writer("freemocap", "cameras of FreeMoCap, in millimetres (.toml)", file_name="freemocap_camera_calibration.toml")
def write_freemocap(path: Path, rig: Rig) -> None:
    """Write the cameras for FreeMoCap: lengths in millimetres, and where each camera is in the world."""
    rig.check_plain("FreeMoCap", fisheye=False)
    rotations, translations = rig.in_metres().poses()
    tables = []
    for camera, name in enumerate(rig.names):
        centre = -rotations[camera].mT @ translations[camera] / METRES["mm"]
        table = camera_table(rig, camera, "mm") | {
            "id": toml_string(name),
            "index": camera,
            "distortions": rig.coefficients(camera, 5, 5, "FreeMoCap"),
            "world_orientation": rotations[camera].mT.tolist(),
            "world_position": centre.tolist(),
        }
        tables.append((toml_string(name), table))
    more = {"reprojection_error_px": _number(rig.error_px)}
    write_tables(path, tables, more | _about("mm", "millimetres", rig))


def write_tables(path: str | Path, tables: Sequence[tuple[str, Mapping[str, object]]], metadata: Mapping[str, object]) -> None:
    """Write the tables of cameras, by their keys, and one of metadata, whose values are as TOML writes them."""
    texts = (
        f"[{key}]\n" + "".join(f"{name} = {value}\n" for name, value in table.items())
        for key, table in [*tables, ("metadata", metadata)]
    )
    with atomic_path(path) as temporary:
        temporary.write_text("\n".join(texts), "utf-8")


def table_names(rig: Rig) -> list[str]:
    """Keys for the tables of cameras that sort as text in the order of the cameras.

    Raises:
        CalibrationError: if a camera has a name that no file can hold.
    """
    for name in rig.names:
        check_text(name, "camera_names")
    count = len(rig.names)
    return [f"cam_{number:0{len(str(count - 1))}d}" for number in range(count)]


def camera_table(rig: Rig, camera: int, unit: str = "m") -> dict[str, object]:
    """What the files of all these programs say of a camera, as TOML writes it. No pose where none is known."""
    table: dict[str, object] = {
        "name": toml_string(rig.names[camera]),
        "size": rig.size(camera),
        "matrix": rig.intrinsics[camera].tolist(),
        "distortions": rig.coefficients(camera, 5, _MOST_COEFFICIENTS, "calibration"),
    }
    if rig.rotations is None:
        return table
    rotations, translations = rig.poses()
    rotation, _ = cv2.Rodrigues(rotations[camera].numpy())
    translation = translations[camera] / METRES[unit]
    return table | {"rotation": rotation[:, 0].tolist(), "translation": translation.tolist()}


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


def _about(unit: str, words: str, rig: Rig) -> dict[str, str]:
    said = {key: toml_string(text) for key, text in about(words, rig.world).items()}
    return said | {"units": toml_string(unit)}


def _number(value: float | None) -> float:
    return 0.0 if value is None or not math.isfinite(value) else value


def _given(camera: dict[str, Any], key: str, kind: type[_Value], default: _Value) -> _Value:
    """A value of a camera's table, or a default where it has none."""
    value = camera.get(key, default)
    if not isinstance(value, kind):
        raise TypeError(f"{key} is a {type(value).__name__} where a {kind.__name__} is expected")
    return value
