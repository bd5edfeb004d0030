"""``calibration.toml``: cameras as Pose2Sim and aniposelib read them.

One table per camera, world to camera, rotation vectors, metres. Both programs take every top-level table other than
``metadata`` for a camera; keys are zero-padded because aniposelib sorts them as text.
"""

from __future__ import annotations

import json
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from torchstickcal.errors import FileFormatError
from torchstickcal.files import atomic_path
from torchstickcal.result import Calibration

_NOT_CAMERAS = {"metadata", "capture_volume", "charuco", "checkerboard"}


@dataclass(frozen=True, eq=False)
class Rig:
    """The cameras of a calibration file, float64, metres."""

    names: tuple[str, ...]
    intrinsics: Tensor
    """(C, 3, 3)"""
    distortion: tuple[Tensor, ...]
    """C vectors, OpenCV's order"""
    fisheye: tuple[bool, ...]
    image_size: Tensor
    """(C, 2)"""
    rotations: Tensor
    """(C, 3, 3), world to camera"""
    translations: Tensor
    """(C, 3), world to camera"""


def write_camera_toml(path: str | Path, calibration: Calibration) -> None:
    """Write the cameras of a calibration.

    Lenses are written with 5 coefficients (8 where the model has them, 4 for fisheye lenses). Where the image size is not
    known, twice the principal point stands for it.
    """
    count = len(calibration.camera_names)
    intrinsics = calibration.intrinsics.double().cpu()
    sizes = 2 * intrinsics[:, :2, 2] if calibration.image_size is None else calibration.image_size.double().cpu()
    lenses = torch.zeros(count, 5) if calibration.distortion is None else calibration.distortion.double().cpu()
    lenses = lenses if calibration.fisheye else torch.nn.functional.pad(lenses, (0, max(0, 5 - lenses.shape[1])))
    lines: list[str] = []
    for index, name in enumerate(calibration.camera_names):
        rotation, _ = cv2.Rodrigues(calibration.rotations[index].double().cpu().numpy())
        lines += [
            f"[cam_{index:0{len(str(count - 1))}d}]",
            f"name = {json.dumps(name, ensure_ascii=False)}",
            f"size = {sizes[index].tolist()}",
            f"matrix = {intrinsics[index].tolist()}",
            f"distortions = {lenses[index].tolist()}",
            f"rotation = {rotation[:, 0].tolist()}",
            f"translation = {calibration.translations[index].double().cpu().tolist()}",
            f"fisheye = {str(calibration.fisheye).lower()}",
            "",
        ]
    error = float(calibration.reprojection_median_px.mean())
    lines += ["[metadata]", "adjusted = false", f"error = {error!r}", 'units = "m"', 'generator = "torchstickcal"', ""]
    with atomic_path(path) as temporary:
        temporary.write_text("\n".join(lines), "utf-8")


def read_camera_toml(path: str | Path) -> Rig:
    """Read the cameras of a file as Pose2Sim, aniposelib or :func:`write_camera_toml` write it, in the order of the file.

    Raises:
        FileFormatError: if the file is not TOML or has no complete camera.
    """
    try:
        tables: dict[str, Any] = tomllib.loads(Path(path).read_text("utf-8"))
        cameras = {key: table for key, table in tables.items() if key not in _NOT_CAMERAS}
        if not cameras:
            raise KeyError("camera tables")
        rotations = [cv2.Rodrigues(np.array(camera["rotation"], dtype=np.float64))[0] for camera in cameras.values()]
        return Rig(
            names=tuple(str(camera.get("name", key)) for key, camera in cameras.items()),
            intrinsics=_stacked(cameras, "matrix"),
            distortion=tuple(torch.tensor(camera["distortions"], dtype=torch.float64) for camera in cameras.values()),
            fisheye=tuple(bool(camera.get("fisheye", False)) for camera in cameras.values()),
            image_size=_stacked(cameras, "size"),
            rotations=torch.from_numpy(np.stack(rotations)),
            translations=_stacked(cameras, "translation"),
        )
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, KeyError, TypeError, ValueError, AttributeError, cv2.error) as error:
        raise FileFormatError(
            "not a camera file", where=str(path), got=repr(error), expected="a calibration.toml of Pose2Sim or aniposelib"
        ) from error


def _stacked(cameras: dict[str, Any], key: str) -> Tensor:
    return torch.tensor([camera[key] for camera in cameras.values()], dtype=torch.float64)
