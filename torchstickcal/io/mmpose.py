"""MMPose: what its inferencer and its top-down demo write, a JSON file for each camera or for each frame."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from torchstickcal.io.formats import HEAD_BYTES, camera_reader
from torchstickcal.io.recording import Detection, View, frame_files, in_folder
from torchstickcal.io.skeletons import conventional
from torchstickcal.untrusted import read_head, read_json

_VIDEO = re.compile(rb'\A\s*(\{\s*"(meta_info|instance_info)"|\[\s*\{\s*"(frame_id|instances)")')
_IMAGE = re.compile(rb'\A\s*\[\s*\{\s*"(keypoints"\s*:\s*\[\s*\[|keypoint_scores")')


def _is_camera(path: Path, head: bytes) -> bool:
    if not path.is_dir():
        return _VIDEO.match(head) is not None
    first = next(iter(in_folder(path, "*.json")), None)
    return first is not None and _IMAGE.match(read_head(first, HEAD_BYTES)) is not None


@camera_reader("mmpose", "MMPose: for each camera a JSON file, or a folder with one for each frame", recognises=_is_camera)
def read_mmpose(path: Path) -> View:
    """Read the instances of a video, or those of a folder of images whose names end with the number of the frame."""
    if path.is_dir():
        files = frame_files(path, "*.json")
        return View.of(path.name, [person for frame, file in files for person in _people(frame, read_json(file))])
    content = read_json(path)
    names = _point_names(content.get("meta_info", {})) if isinstance(content, dict) else None
    frames = content["instance_info"] if isinstance(content, dict) else content
    people = (person for one in frames for person in _people(int(one["frame_id"]), one["instances"]))
    return View.of(path.stem, people, names)


def _people(frame: int, instances: Iterable[Mapping[str, Any]]) -> Iterable[Detection]:
    for instance in instances:
        points = np.array(instance["keypoints"], dtype=np.float64)
        scores = np.array(instance["keypoint_scores"], dtype=np.float64)
        number = instance.get("track_id", -1)
        yield Detection(frame, np.column_stack([points[:, :2], scores]), number if isinstance(number, int) else -1)


def _point_names(meta: Mapping[str, Any]) -> list[str] | None:
    by_number = meta.get("keypoint_id2name")
    if not isinstance(by_number, dict) or not by_number:
        return None
    return [conventional(by_number[str(number)]) for number in range(len(by_number))]
