"""Kalibr: ``camchain.yaml``, with the pose of each camera relative to the one before it, in metres."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from torchstickcal.io.formats import calibration_reader, reading
from torchstickcal.io.recording import natural_order
from torchstickcal.io.rig import Rig, RigCamera
from torchstickcal.untrusted import read_yaml

_DESCRIPTION = "cameras of Kalibr (camchain.yaml)"
_MODELS = {"radtan": False, "equidistant": True, "none": False}
"""Models of distortion, and whether each is OpenCV's fisheye model."""


@calibration_reader(
    "kalibr", _DESCRIPTION, recognises=lambda path, head: b"camera_model:" in head and b"distortion_coeffs:" in head
)
def read_kalibr(path: str | Path) -> Rig:
    """Read the cameras of a chain; the first one is the world."""
    with reading(path, _DESCRIPTION):
        content = read_yaml(path)
        cameras, pose = [], np.eye(4)
        for number, name in enumerate(sorted((key for key in content if key.startswith("cam")), key=natural_order)):
            if number:
                pose = np.array(content[name]["T_cn_cnm1"], dtype=np.float64).reshape(4, 4) @ pose
            cameras.append(_camera(name, content[name], pose))
        return Rig.of(cameras)


def _camera(name: str, values: Mapping[str, Any], pose: Any) -> RigCamera:
    model = values["distortion_model"]
    if values["camera_model"] != "pinhole" or model not in _MODELS:
        raise ValueError(
            f"{name} of the model {values['camera_model']} with {model} distortion; pinhole with {', '.join(_MODELS)} is read"
        )
    fx, fy, cx, cy = map(float, values["intrinsics"])
    return RigCamera(
        name=name,
        matrix=[[fx, 0, cx], [0, fy, cy], [0, 0, 1]],
        distortion=list(map(float, values["distortion_coeffs"])) if model != "none" else (),
        fisheye=_MODELS[model],
        image_size=values["resolution"],
        rotation=pose[:3, :3],
        translation=pose[:3, 3],
    )
