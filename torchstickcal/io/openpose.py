"""OpenPose: a folder for each camera, a JSON file for each frame; and the projects of Pose2Sim that hold such folders."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from torchstickcal.errors import FileFormatError
from torchstickcal.io.formats import CALIBRATION_READERS, KEYPOINT_READERS, camera_reader, find_reader, keypoint_reader
from torchstickcal.io.recording import Detection, Recording, View, frame_files, in_folder
from torchstickcal.untrusted import read_head, read_json, read_toml

_POSES = ("pose-associated", "poseTracked", "pose-sync", "pose")
"""The folders of a Pose2Sim project with keypoints, the most processed first."""
_MODELS = {
    "body_with_feet": "halpe-26", "whole_body_wrist": "coco-wholebody", "whole_body": "coco-wholebody", "body": "coco-17",
    "halpe_26": "halpe-26", "coco_133": "coco-wholebody", "coco_133_wrist": "coco-wholebody", "coco_17": "coco-17",
    "coco": "coco-17", "body_25": "body-25", "body_25b": "body-25b", "blazepose": "blazepose-33",
}  # fmt: skip
"""Pose2Sim's names of skeletons."""


def _is_camera(path: Path, head: bytes) -> bool:
    first = next(iter(in_folder(path, "*.json")), None) if path.is_dir() else None
    return first is not None and _is_frame(read_head(first, 4096))


def _is_frame(head: bytes) -> bool:
    return head.lstrip(b"\xef\xbb\xbf \r\n\t").startswith(b"{") and b'"people"' in head and b'"instance' not in head


@camera_reader("openpose", "OpenPose: for each camera a folder with a JSON file for each frame", recognises=_is_camera)
def read_openpose(path: Path) -> View:
    """Read the frames of one camera. The number of a frame is the last number in the file's name."""
    frames = frame_files(path, "*.json")
    name = re.sub(r"[-_. ]?json$", "", path.name, flags=re.IGNORECASE)
    return View.of(name or path.name, [person for frame, file in frames for person in _people(frame, file)])


def _people(frame: int, file: Path) -> list[Detection]:
    found = []
    for person in filter(None, read_json(file)["people"]):  # Pose2Sim leaves {} in the place of a person who was not seen
        keypoints = np.array(person["pose_keypoints_2d"], dtype=np.float64).reshape(-1, 3)
        if len(keypoints):
            found.append(Detection(frame, keypoints, _number(person.get("person_id"))))
    return found


def _number(given: Any) -> int:
    """The number of a person, of ``[number]`` or a number; -1 for none."""
    number = given[0] if isinstance(given, list) and given else given
    return number if isinstance(number, int) else -1


def _poses_of(path: Path) -> Path | None:
    """The folder of a Pose2Sim project in which the most processed keypoints are."""
    reader = KEYPOINT_READERS["openpose"]
    return next((path / name for name in _POSES if (path / name).is_dir() and reader.takes(path / name, b"")), None)


@keypoint_reader(
    "pose2sim-project",
    "Pose2Sim project: a folder with pose, pose-sync or pose-associated, and calibration",
    recognises=lambda path, head: _poses_of(path) is not None,
)
def read_pose2sim_project(path: Path) -> Recording:
    """Read the keypoints of a project or of one of its trials. Calibration and Config.toml are used if there are any."""
    poses = _poses_of(path)
    if poses is None:
        raise FileNotFoundError(f"none of the folders {', '.join(_POSES)} with keypoints in {path}")
    recording = KEYPOINT_READERS["openpose"].read(poses)
    configs = [folder / "Config.toml" for folder in (path, path.parent) if (folder / "Config.toml").is_file()]
    config = read_toml(configs[0]) if configs else {}
    fps = config.get("project", {}).get("frame_rate")
    model = str(config.get("pose", {}).get("pose_model", "")).lower()
    return Recording(
        recording.views,
        float(fps) if isinstance(fps, int | float) else None,
        _calibration_of(path),
        _MODELS.get(model),
        (f"Keypoints are those in {poses.name}.", *recording.notes),
    )


def _calibration_of(path: Path) -> Path | None:
    """The calibration of a project, or of the project that a trial is in; None if there is none.

    Raises:
        FileFormatError: if there are several.
    """
    for folder in (path, path.parent):
        files = [file for kind in ("calibration", "Calibration") for file in in_folder(folder / kind) if _is_calibration(file)]
        files = list(dict.fromkeys(file.resolve() for file in files))
        if len(files) > 1:  # Pose2Sim reads the TOML file that it made of another one
            files = [file for file in files if file.suffix == ".toml"] or files
        if len(files) > 1:
            raise FileFormatError(
                "several calibrations in one project",
                where=str(folder),
                got=", ".join(file.name for file in files),
                expected="one",
                remedy="Say which with --intrinsics.",
            )
        if files:
            return files[0]
    return None


def _is_calibration(path: Path) -> bool:
    try:
        return path.is_file() and find_reader(path, CALIBRATION_READERS) is not None
    except FileFormatError:
        return False
