"""OpenCV's FileStorage, as YAML, XML or JSON: a camera in each file, whose matrices have the names that programs often use."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray

from torchstickcal.files import atomic_set
from torchstickcal.io.about import about, comments
from torchstickcal.io.formats import calibration_reader, camera_writer, head_of, reading
from torchstickcal.io.recording import in_folder
from torchstickcal.io.rig import Rig, RigCamera
from torchstickcal.io.writers import file_names
from torchstickcal.untrusted import read_json, read_xml, read_yaml

_DESCRIPTION = "a camera of OpenCV (.yml, .xml or .json of FileStorage), or a folder with several"
_MATRIX = (
    "camera_matrix",
    "cameraMatrix",
    "Camera_Matrix",
    "CameraMatrix",
    "camera_matrix_left",
    "intrinsic_matrix",
    "mtx",
    "K",
)
_DISTORTION = (
    "distortion_coefficients", "distCoeffs", "Distortion_Coefficients", "dist_coeffs", "DistCoeffs", "distortion", "dist", "D",
)  # fmt: skip
_SIZE = (("image_width", "image_height"), ("image_Width", "image_Height"), ("width", "height"))
_ROTATION, _TRANSLATION = ("R", "rotation", "rotation_matrix", "rvec", "Rvec"), ("T", "t", "translation", "tvec", "Tvec")
_FISHEYE = ("fisheye", "equidistant", "kannala_brandt")
"""Names of the fisheye model, after ``distortion_model`` or ``fisheye_model``."""


def _is_camera(head: bytes) -> bool:
    text = head.decode("utf-8", "replace")
    storage = "opencv-matrix" in text or "opencv_storage" in text
    named = any(f"\n{key}:" in f"\n{text}" or f"<{key} " in text or f'"{key}"' in text for key in _MATRIX)
    return storage and named and "nb_camera" not in text


def _cameras_of(path: Path) -> list[Path]:
    return [file for file in in_folder(path) if file.is_file() and _is_camera(head_of(file))] if path.is_dir() else [path]


@calibration_reader(
    "opencv",
    _DESCRIPTION,
    recognises=lambda path, head: _is_camera(head) if head else bool(path.is_dir() and _cameras_of(path)),
)
def read_opencv(path: str | Path) -> Rig:
    """Read cameras that are called as the file says, else as it is called. The unit of length is not known.

    Poses are read where each file has ``R`` and ``T`` or similar names for them, world to camera.
    """
    path = Path(path)
    with reading(path, _DESCRIPTION):
        cameras = []
        for file in _cameras_of(path):
            with reading(file, _DESCRIPTION):
                cameras.append(_camera(file))
        return Rig.of(cameras, None)


@camera_writer(
    "opencv",
    "a file of OpenCV's FileStorage for each camera, in metres (.yml)",
    file_name="opencv",
    files=("*.yml",),
)
def write_opencv(path: Path, rig: Rig) -> None:
    """Write a file for each camera into a folder, called as the camera. A fisheye lens has ``distortion_model: fisheye``."""
    with atomic_set(path) as folder:
        for camera, (name, file) in enumerate(zip(rig.names, file_names(rig.names), strict=True)):
            width, height = map(round, rig.size(camera))
            text = storage_head(rig, "x_camera = R x_world + T.") + f"camera_name: {json.dumps(name)}\n"
            text += f"image_width: {width}\nimage_height: {height}\n"
            text += f"distortion_model: {'fisheye' if rig.fisheye[camera] else 'plumb_bob'}\n"
            text += storage_matrix("camera_matrix", rig.intrinsics[camera].numpy())
            text += storage_matrix("distortion_coefficients", [rig.coefficients(camera, 5, 14, "OpenCV")])
            if rig.rotations is not None:
                rotations, translations = rig.poses()
                text += storage_matrix("R", rotations[camera].numpy())
                text += storage_matrix("T", translations[camera][:, None].numpy())
            (folder / f"{file}.yml").write_text(text, "utf-8")


def storage_head(rig: Rig, more: str = "") -> str:
    """The first lines of a file of FileStorage, with comments about its content."""
    return "%YAML:1.0\n---\n" + comments(about("metres", rig.world, more))


def storage_matrix(name: str, matrix: Any) -> str:
    """A matrix as FileStorage writes it.

    Example:
        >>> print(storage_matrix("T", [[0.5], [2]]), end="")
        T: !!opencv-matrix
           rows: 2
           cols: 1
           dt: d
           data: [ 0.5, 2.0 ]
    """
    values = np.asarray(matrix, dtype=np.float64)
    rows, columns = values.shape
    data = ", ".join(map(repr, values.ravel().tolist()))
    return f"{name}: !!opencv-matrix\n   rows: {rows}\n   cols: {columns}\n   dt: d\n   data: [ {data} ]\n"


def matrix_of(value: Any) -> NDArray[np.float64]:
    """A matrix of FileStorage, or lists of numbers.

    Raises:
        ValueError: if it has another number of values than it declares; TypeError or KeyError if it is something else.

    Example:
        >>> matrix_of({"rows": 1, "cols": 2, "dt": "d", "data": [0.5, 2]}).tolist()
        [[0.5, 2.0]]
    """
    if isinstance(value, Mapping):
        sizes = value["sizes"] if "sizes" in value else (value["rows"], value["cols"])
        return np.array(value["data"], dtype=np.float64).reshape(np.array(sizes, dtype=int))
    if not isinstance(value, Sequence) or isinstance(value, str):
        raise TypeError(f"a {type(value).__name__} where a matrix is expected")
    return np.array(value, dtype=np.float64)


def _camera(path: Path) -> RigCamera:
    head = head_of(path).lstrip(b"\xef\xbb\xbf \r\n\t")
    content = (
        _of_xml(read_xml(path)) if head.startswith(b"<") else read_json(path) if head.startswith(b"{") else read_yaml(path)
    )

    def first(names: Sequence[str]) -> Any:
        return next((matrix_of(content[name]) for name in names if name in content), None)

    model = str(content.get("distortion_model", content.get("fisheye_model", ""))).lower()
    size = next(([float(content[name]) for name in names] for names in _SIZE if set(names) <= set(content)), None)
    matrix = first(_MATRIX)
    if matrix is None:
        raise KeyError(f"camera matrix, called {', '.join(_MATRIX)}")
    distortion = first(_DISTORTION)
    if distortion is None:
        raise KeyError(f"distortion, called {', '.join(_DISTORTION)}")
    rotation, translation = first(_ROTATION), first(_TRANSLATION)
    return RigCamera(
        name=str(content.get("camera_name", path.stem)),
        matrix=matrix,
        distortion=distortion,
        fisheye=model in ("1", *_FISHEYE),
        image_size=size,
        rotation=None if translation is None else rotation,
        translation=None if rotation is None else translation,
    )


def _of_xml(root: Element) -> dict[str, Any]:
    """The values of a FileStorage in XML."""
    return {child.tag: (child.text or "").strip() if child.find("data") is None else _matrix_of_xml(child) for child in root}


def _matrix_of_xml(element: Element) -> dict[str, Any]:
    numbers = {part.tag: (part.text or "").split() for part in element}
    shape = {key: [int(word) for word in numbers[key]] for key in ("sizes", "rows", "cols") if key in numbers}
    return {
        "sizes": shape.get("sizes") or [*shape["rows"], *shape["cols"]],
        "data": [float(word) for word in numbers["data"]],
    }
