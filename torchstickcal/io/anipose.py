"""Anipose: a session with keypoints in ``pose-2d`` or ``pose-2d-filtered``, and a calibration."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

from torchstickcal.io.deeplabcut import camera_name
from torchstickcal.io.formats import KEYPOINT_READERS, find_reader, keypoint_reader
from torchstickcal.io.recording import Recording, View, in_folder
from torchstickcal.untrusted import read_toml

_POSES = ("pose-2d-filtered", "pose-2d")
"""The folders with keypoints, the more processed first."""
_CAMERA = "-cam([A-Z])"
"""Anipose's own pattern of a camera's name in the name of a file."""
_PLAIN = r"[^()|*+?{}]*"
_SIMPLE = re.compile(rf"{_PLAIN}\({_PLAIN}[+*]?{_PLAIN}\){_PLAIN}")
"""Patterns that are searched for in no more time than a name is long."""


def _poses_of(path: Path) -> Path | None:
    return next((path / name for name in _POSES if in_folder(path / name)), None)


@keypoint_reader(
    "anipose",
    "Anipose session: a folder with pose-2d or pose-2d-filtered, and calibration",
    recognises=lambda path, head: _poses_of(path) is not None,
)
def read_anipose(path: Path) -> Recording:
    """Read the keypoints of a session with one trial. The names of cameras are found by ``cam_regex`` of its config.toml."""
    poses = _poses_of(path)
    if poses is None:
        raise FileNotFoundError(f"none of the folders {', '.join(_POSES)} with keypoints in {path}")
    pattern = _pattern(path)
    views: dict[str, View] = {}
    for file in in_folder(poses):
        found = re.search(pattern, camera_name(file))
        if found is None:
            raise ValueError(f"{file.name}, in which {pattern!r} finds no camera")
        if found[1] in views:
            raise ValueError(
                f"two files of camera {found[1]}, as of several trials; give the files of one trial, one per camera"
            )
        (view,) = find_reader(file, KEYPOINT_READERS).read(file).views
        views[found[1]] = replace(view, name=found[1])
    calibrations = [folder / "calibration" / "calibration.toml" for folder in (path, path.parent)]
    calibration = next((file for file in calibrations if file.is_file()), None)
    return Recording.of(list(views.values()), intrinsics=calibration, notes=(f"Keypoints are those in {poses.name}.",))


def _pattern(path: Path) -> str:
    """The pattern of a camera's name: that of the nearest config.toml."""
    config: dict[str, Any] = next(
        (read_toml(f / "config.toml") for f in (path, *path.parents[:2]) if (f / "config.toml").is_file()), {}
    )
    pattern = config.get("triangulation", {}).get("cam_regex", _CAMERA)
    if not isinstance(pattern, str) or _SIMPLE.fullmatch(pattern) is None:
        raise ValueError(f"cam_regex {pattern!r} with more than one group and one repetition; as in -cam([A-Z]) or (cam[0-9]+)")
    return pattern
