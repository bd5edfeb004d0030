"""nerfstudio's ``transforms.json``: poses from cameras to the world, with y up and z backwards, and pixel corners at (0, 0)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from torchstickcal.errors import CalibrationError
from torchstickcal.files import atomic_path, json_text
from torchstickcal.io.about import about
from torchstickcal.io.colmap import camera_of_image
from torchstickcal.io.formats import calibration_reader, camera_writer, reading
from torchstickcal.io.rig import Rig, RigCamera
from torchstickcal.io.writers import file_names
from torchstickcal.untrusted import read_json

_DESCRIPTION = "cameras of nerfstudio (transforms.json)"
_MODELS = {"OPENCV": False, "PINHOLE": False, "SIMPLE_PINHOLE": False, "OPENCV_FISHEYE": True}
_LENS = ("k1", "k2", "p1", "p2", "k3"), ("k1", "k2", "k3", "k4")
"""The coefficients of both models, in OpenCV's order."""
_TURN = np.diag([1.0, -1.0, -1.0])


@calibration_reader(
    "nerfstudio",
    _DESCRIPTION,
    recognises=lambda path, head: head.lstrip()[:1] == b"{" and (b'"transform_matrix"' in head or b'"fl_x"' in head),
)
def read_nerfstudio(path: str | Path) -> Rig:
    """Read a camera for each frame, called as the folder of the image or else as the image. The scale is not known."""
    with reading(path, _DESCRIPTION):
        content = read_json(path)
        shared = {key: value for key, value in content.items() if key != "frames"}
        return Rig.of([_camera(shared | frame) for frame in content["frames"]], None)


@camera_writer("nerfstudio", "cameras of nerfstudio, in metres", file_name="transforms.json")
def write_nerfstudio(path: Path, rig: Rig) -> None:
    """Write a frame for each camera, whose image is ``images/NAME.png``. All lenses must be of one model."""
    rig.check_plain("nerfstudio")
    if len(set(rig.fisheye)) > 1:
        raise CalibrationError(
            "lenses of both models in one file",
            where="nerfstudio",
            got="fisheye and other lenses",
            expected="lenses of one model",
        )
    rotations, translations = rig.in_metres().poses()
    frames = []
    for camera, name in enumerate(file_names(rig.names)):
        pose = np.eye(4)
        pose[:3, :3] = rotations[camera].mT.numpy() @ _TURN
        pose[:3, 3] = -(rotations[camera].mT @ translations[camera]).numpy()
        (fx, _, cx), (_, fy, cy), _ = rig.intrinsics[camera].tolist()
        width, height = map(round, rig.size(camera))
        lens = zip(_LENS[rig.fisheye[camera]], rig.coefficients(camera, 5, 5, "nerfstudio"), strict=True)
        frame = {"file_path": f"images/{name}.png", "fl_x": fx, "fl_y": fy, "cx": cx + 0.5, "cy": cy + 0.5}
        frames.append(frame | {"w": width, "h": height} | dict(lens) | {"transform_matrix": pose.tolist()})
    model = "OPENCV_FISHEYE" if rig.fisheye[0] else "OPENCV"
    said = about("metres", rig.world, "Poses are from cameras to the world, with y up and z backwards in a camera.")
    with atomic_path(path) as temporary:
        temporary.write_text(json_text({"camera_model": model, "about": said, "frames": frames}) + "\n", "utf-8")


def _camera(frame: Mapping[str, Any]) -> RigCamera:
    model = frame.get("camera_model", "OPENCV")
    if model not in _MODELS:
        raise ValueError(f"a camera of the model {model}; {', '.join(_MODELS)} are read")
    pose = np.array(frame["transform_matrix"], dtype=np.float64)
    rotation = (pose[:3, :3] @ _TURN).T
    return RigCamera(
        name=camera_of_image(frame["file_path"]),
        matrix=[[frame["fl_x"], 0, frame["cx"] - 0.5], [0, frame["fl_y"], frame["cy"] - 0.5], [0, 0, 1]],
        distortion=[frame.get(key, 0.0) for key in _LENS[_MODELS[model]]],
        fisheye=_MODELS[model],
        image_size=(frame["w"], frame["h"]),
        rotation=rotation,
        translation=-rotation @ pose[:3, 3],
    )
