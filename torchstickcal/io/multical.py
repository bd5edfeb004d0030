"""multical: ``calibration.json``."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torchstickcal.io.formats import calibration_reader, reading
from torchstickcal.io.rig import Rig, RigCamera
from torchstickcal.untrusted import read_json

_DESCRIPTION = "cameras of multical (calibration.json)"


@calibration_reader(
    "multical",
    _DESCRIPTION,
    recognises=lambda path, head: head.lstrip()[:1] == b"{" and b'"cameras"' in head and b'"K"' in head,
)
def read_multical(path: str | Path) -> Rig:
    """Read the cameras. Lengths are in the unit of the board, which the file does not say."""
    with reading(path, _DESCRIPTION):
        content = read_json(path)
        poses = content.get("camera_poses", {})
        return Rig.of([_camera(name, camera, poses) for name, camera in content["cameras"].items()], None)


def _camera(name: str, camera: Mapping[str, Any], poses: Mapping[str, Any]) -> RigCamera:
    pose = next((value for key, value in poses.items() if key == name or key.startswith(f"{name}_to_")), {})
    return RigCamera(
        name=name,
        matrix=camera["K"],
        distortion=camera["dist"],
        fisheye="fisheye" in str(camera.get("model", "")),
        image_size=camera.get("image_size"),
        rotation=pose.get("R"),
        translation=pose.get("T"),
    )
