"""COLMAP's text files ``cameras.txt`` and ``images.txt``: the corner of the image, not the centre of a pixel, is at (0, 0)."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from torchstickcal.files import atomic_set
from torchstickcal.io.about import about, comments
from torchstickcal.io.formats import HEAD_BYTES, calibration_reader, camera_writer, reading
from torchstickcal.io.rig import Rig, RigCamera
from torchstickcal.io.writers import file_names
from torchstickcal.untrusted import read_head, read_text

_DESCRIPTION = "cameras of COLMAP: a folder with cameras.txt and images.txt"
_CAMERA = re.compile(rb"(?m)^\d+ [A-Z][A-Z_]+ \d+ \d+ [-\d.]")
_FOLDERS = (".", "sparse/0", "sparse", "0")
_MODELS: dict[str, tuple[str, bool]] = {
    "SIMPLE_PINHOLE": ("f cx cy", False),
    "PINHOLE": ("fx fy cx cy", False),
    "SIMPLE_RADIAL": ("f cx cy k1", False),
    "RADIAL": ("f cx cy k1 k2", False),
    "OPENCV": ("fx fy cx cy k1 k2 p1 p2", False),
    "FULL_OPENCV": ("fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6", False),
    "OPENCV_FISHEYE": ("fx fy cx cy k1 k2 k3 k4", True),
    "SIMPLE_RADIAL_FISHEYE": ("f cx cy k1", True),
    "RADIAL_FISHEYE": ("f cx cy k1 k2", True),
}
"""By the names of camera models: their parameters, and whether the distortion is that of OpenCV's fisheye model."""


def _cameras_of(path: Path) -> Path | None:
    """The file of cameras that a path is, or that is in a folder."""
    files = [path] if not path.is_dir() else [path / folder / "cameras.txt" for folder in _FOLDERS]
    return next((file for file in files if file.is_file() and _CAMERA.search(read_head(file, HEAD_BYTES))), None)


@calibration_reader("colmap", _DESCRIPTION, recognises=lambda path, head: _cameras_of(path) is not None)
def read_colmap(path: str | Path) -> Rig:
    """Read a camera for each image, called as the folder of the image or else as the image. The scale is not known.

    Without ``images.txt``, or with several images of one camera, only the intrinsics are known.
    """
    with reading(path, _DESCRIPTION):
        file = _cameras_of(Path(path)) or Path(path)
        lenses = {line[0]: line[1:] for line in _lines(file) if len(line) > 4}
        images = file.with_name("images.txt")
        poses = list(_poses(images)) if images.is_file() else []
        if poses and len({name for name, *_ in poses}) == len(poses):
            return Rig.of([_camera(name, lenses[lens], *pose) for name, lens, *pose in poses], None)
        named = {lens: name for name, lens, *_ in poses}
        return Rig.of([_camera(named.get(number, f"cam_{number}"), values) for number, values in lenses.items()], None)


@camera_writer(
    "colmap",
    "cameras of COLMAP as text, in metres",
    file_name="colmap",
    files=("cameras.txt", "images.txt", "points3D.txt"),
)
def write_colmap(path: Path, rig: Rig) -> None:
    """Write ``cameras.txt``, ``images.txt`` and an empty ``points3D.txt`` into a folder. The image of a camera is NAME.png."""
    rig.check_plain("COLMAP")
    rotations, translations = rig.in_metres().poses()
    head = comments(about("metres", rig.world, "x_camera = R x_world + t; the corner of the image is at (0, 0)."))
    cameras = f"{head}# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
    images = f"{head}# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n# POINTS2D[] as (X, Y, POINT3D_ID)\n"
    for camera, name in enumerate(file_names(rig.names)):
        model, parameters = _model(rig, camera)
        width, height = map(round, rig.size(camera))
        cameras += f"{camera + 1} {model} {width} {height} {_numbers(parameters)}\n"
        pose = [*_quaternion(rotations[camera].numpy()), *translations[camera].tolist()]
        images += f"{camera + 1} {_numbers(pose)} {camera + 1} {name}.png\n\n"
    with atomic_set(path) as folder:
        for file, text in (("cameras.txt", cameras), ("images.txt", images), ("points3D.txt", head)):
            (folder / file).write_text(text, "utf-8")


def _model(rig: Rig, camera: int) -> tuple[str, list[float]]:
    """The model of a camera and its parameters, of as few coefficients as it needs."""
    (fx, _, cx), (_, fy, cy), _ = rig.intrinsics[camera].tolist()
    lens = rig.coefficients(camera, 8, 8, "COLMAP")
    pinhole = [fx, fy, cx + 0.5, cy + 0.5]
    if rig.fisheye[camera]:
        return "OPENCV_FISHEYE", [*pinhole, *lens]
    return ("FULL_OPENCV", [*pinhole, *lens]) if any(lens[4:]) else ("OPENCV", [*pinhole, *lens[:4]])


def _quaternion(rotation: NDArray[np.float64]) -> list[float]:
    """The unit quaternion w, x, y, z of a rotation, w not negative: the eigenvector of a symmetric matrix (Bar-Itzhack)."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = rotation.tolist()
    symmetric = np.array([
        [xx + yy + zz, zy - yz, xz - zx, yx - xy],
        [zy - yz, xx - yy - zz, xy + yx, xz + zx],
        [xz - zx, xy + yx, yy - xx - zz, yz + zy],
        [yx - xy, xz + zx, yz + zy, zz - xx - yy],
    ])  # fmt: skip
    vector = np.linalg.eigh(symmetric)[1][:, -1]
    return (vector * (-1.0 if vector[0] < 0 else 1.0)).tolist()


def _numbers(values: Sequence[float]) -> str:
    return " ".join(map(repr, values))


def camera_of_image(name: str) -> str:
    """The name of a camera, of the path of one of its images: that of the folder, else that of the image.

    Example:
        >>> camera_of_image("images/cam01.png"), camera_of_image("cam02/000001.jpg")
        ('cam01', 'cam02')
    """
    path = PurePosixPath(name)
    return path.stem if path.parent.name in ("", "images") else path.parent.name


def _lines(path: Path) -> list[list[str]]:
    return [line.split() for line in read_text(path).splitlines() if line.strip() and not line.startswith("#")]


def _poses(path: Path) -> Iterator[tuple[str, str, NDArray[np.float64], NDArray[np.float64]]]:
    """Name, number of the lens, rotation and translation of each image; every second line has points, or is empty."""
    lines = iter(line for line in read_text(path).splitlines() if not line.startswith("#"))
    for line in lines:
        if not line.strip():
            continue
        _, *pose, lens, name = line.split(maxsplit=9)
        w, x, y, z, *translation = map(float, pose)
        yield camera_of_image(name), lens, _rotation(np.array([w, x, y, z])), np.array(translation)
        next(lines, None)


def _rotation(quaternion: NDArray[np.float64]) -> NDArray[np.float64]:
    w, x, y, z = quaternion / np.linalg.norm(quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _camera(
    name: str,
    lens: Sequence[str],
    rotation: NDArray[np.float64] | None = None,
    translation: NDArray[np.float64] | None = None,
) -> RigCamera:
    model, width, height, *values = lens
    if model not in _MODELS:
        raise ValueError(f"a camera of the model {model}; {', '.join(_MODELS)} are read")
    keys, fisheye = _MODELS[model]
    given = dict(zip(keys.split(), map(float, values), strict=True))
    order = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
    last = max((place + 1 for place, key in enumerate(order) if key in given), default=0)
    return RigCamera(
        name=name,
        matrix=[
            [given.get("fx", given.get("f")), 0, given["cx"] - 0.5],
            [0, given.get("fy", given.get("f")), given["cy"] - 0.5],
            [0, 0, 1],
        ],
        distortion=[given.get(key, 0.0) for key in order[: max(last, 4) if last else 0]],
        fisheye=fisheye,
        image_size=(float(width), float(height)),
        rotation=rotation,
        translation=translation,
    )
