"""EasyMocap: keypoints in ``annots``, and cameras in ``intri.yml`` and ``extri.yml``."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from torchstickcal.files import atomic_set
from torchstickcal.io.formats import (
    HEAD_BYTES,
    KEYPOINT_READERS,
    calibration_reader,
    camera_reader,
    camera_writer,
    keypoint_reader,
    reading,
)
from torchstickcal.io.opencv import matrix_of, storage_head, storage_matrix
from torchstickcal.io.recording import Detection, Recording, View, frame_files, in_folder
from torchstickcal.io.rig import Rig, RigCamera
from torchstickcal.io.writers import file_names
from torchstickcal.untrusted import read_head, read_json, read_yaml

_CAMERAS = "cameras of EasyMocap: a folder with intri.yml and extri.yml, or intri.yml alone"
_MATRIX = re.compile(rb"(?m)^K_[^\s:]+:")


def _is_camera(path: Path) -> bool:
    first = next(iter(in_folder(path, "*.json")), None) if path.is_dir() else None
    return first is not None and b'"annots"' in read_head(first, HEAD_BYTES)


@camera_reader(
    "easymocap-annots",
    "EasyMocap: for each camera a folder with a JSON file for each frame",
    recognises=lambda path, head: _is_camera(path),
)
def read_easymocap_annots(path: Path) -> View:
    """Read the people of each frame, with the size of the images."""
    frames = [(frame, read_json(file)) for frame, file in frame_files(path, "*.json")]
    sizes = {(float(content["width"]), float(content["height"])) for _, content in frames}
    if len(sizes) != 1:
        raise ValueError(f"images of different sizes: {sorted(sizes)[:3]}")
    people = [
        Detection(frame, np.array(person["keypoints"], dtype=np.float64), int(person.get("personID", -1)))
        for frame, content in frames
        for person in content["annots"]
    ]
    return View.of(path.name, people, image_size=sizes.pop())


@keypoint_reader(
    "easymocap",
    "EasyMocap: a folder with annots, and intri.yml",
    recognises=lambda path, head: KEYPOINT_READERS["easymocap-annots"].takes(path / "annots", b""),
)
def read_easymocap(path: Path) -> Recording:
    """Read the keypoints of all cameras, with the intrinsics beside them."""
    recording = KEYPOINT_READERS["easymocap-annots"].read(path / "annots")
    has_cameras = (path / "intri.yml").is_file()
    return Recording(recording.views, intrinsics=path if has_cameras else None, notes=recording.notes)


def _intrinsics_of(path: Path) -> Path:
    return path / "intri.yml" if path.is_dir() else path


@calibration_reader(
    "easymocap",
    _CAMERAS,
    recognises=lambda path, head: _MATRIX.search(head or read_head(_intrinsics_of(path), HEAD_BYTES)) is not None,
)
def read_easymocap_cameras(path: str | Path) -> Rig:
    """Read the cameras of both files, in metres; the poses are not known without ``extri.yml`` in the same folder."""
    path = Path(path)
    with reading(path, _CAMERAS):
        intrinsics = read_yaml(_intrinsics_of(path))
        poses = _intrinsics_of(path).parent / "extri.yml"
        extrinsics = read_yaml(poses) if poses.is_file() else {}
        names = [key.removeprefix("K_") for key in intrinsics if key.startswith("K_")]  # `names` may have lost its zeros
        return Rig.of([_camera(name, intrinsics, extrinsics) for name in names])


@camera_writer("easymocap", "cameras of EasyMocap, in metres", file_name="easymocap", files=("intri.yml", "extri.yml"))
def write_easymocap(path: Path, rig: Rig) -> None:
    """Write ``intri.yml`` and ``extri.yml`` into a folder."""
    rig.check_plain("EasyMocap", fisheye=False)
    keys = file_names([name.replace(":", "_") for name in rig.names])
    listed = "names:\n" + "".join(f"  - {json.dumps(key)}\n" for key in keys)
    intrinsics = extrinsics = storage_head(rig, "x_camera = Rot x_world + T.") + listed
    rotations, translations = rig.in_metres().poses()
    for camera, key in enumerate(keys):
        width, height = map(round, rig.size(camera))
        intrinsics += storage_matrix(f"K_{key}", rig.intrinsics[camera].numpy())
        intrinsics += storage_matrix(f"dist_{key}", [rig.coefficients(camera, 5, 5, "EasyMocap")])
        intrinsics += f"H_{key}: {height}\nW_{key}: {width}\n"
        rotation = rotations[camera].numpy()
        extrinsics += storage_matrix(f"R_{key}", cv2.Rodrigues(rotation)[0]) + storage_matrix(f"Rot_{key}", rotation)
        extrinsics += storage_matrix(f"T_{key}", translations[camera][:, None].numpy())
    with atomic_set(path) as folder:
        (folder / "intri.yml").write_text(intrinsics, "utf-8")
        (folder / "extri.yml").write_text(extrinsics, "utf-8")


def _camera(name: str, intrinsics: Mapping[str, Any], extrinsics: Mapping[str, Any]) -> RigCamera:
    distortion = intrinsics.get(f"dist_{name}", intrinsics.get(f"D_{name}"))
    rotation = extrinsics.get(f"Rot_{name}", extrinsics.get(f"R_{name}"))
    size = [intrinsics.get(f"{side}_{name}") for side in "WH"]
    return RigCamera(
        name=name,
        matrix=matrix_of(intrinsics[f"K_{name}"]),
        distortion=() if distortion is None else matrix_of(distortion),
        image_size=None if None in size else size,
        rotation=None if rotation is None else matrix_of(rotation),
        translation=matrix_of(extrinsics[f"T_{name}"]) if rotation is not None else None,
    )
