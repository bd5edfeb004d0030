"""MC-Calib: ``calibrated_cameras_data.yml``, with poses from each camera to the first one."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torchstickcal.io.formats import calibration_reader, reading
from torchstickcal.io.opencv import matrix_of
from torchstickcal.io.rig import Rig, RigCamera
from torchstickcal.untrusted import read_yaml

_DESCRIPTION = "cameras of MC-Calib (calibrated_cameras_data.yml)"


@calibration_reader("mc-calib", _DESCRIPTION, recognises=lambda path, head: b"nb_camera:" in head)
def read_mc_calib(path: str | Path) -> Rig:
    """Read the cameras. Lengths are in the unit of the board, which the file does not say."""
    with reading(path, _DESCRIPTION):
        content = read_yaml(path)
        return Rig.of([_camera(f"camera_{n}", content[f"camera_{n}"]) for n in range(int(content["nb_camera"]))], None)


def _camera(name: str, values: Mapping[str, Any]) -> RigCamera:
    pose = matrix_of(values["camera_pose_matrix"])
    rotation = pose[:3, :3].T
    return RigCamera(
        name=name,
        matrix=matrix_of(values["camera_matrix"]),
        distortion=matrix_of(values["distortion_vector"]),
        fisheye=int(values.get("distortion_type", 0)) == 1,
        image_size=(values["img_width"], values["img_height"]),
        rotation=rotation,
        translation=-rotation @ pose[:3, 3],
    )
