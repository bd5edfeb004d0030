"""Ultralytics YOLO-pose: a folder for each camera, with a text or a JSON file for each frame."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from torchstickcal.io.formats import HEAD_BYTES, camera_reader
from torchstickcal.io.recording import Detection, View, frame_files, in_folder
from torchstickcal.untrusted import read_head, read_json, read_text

_JSON = re.compile(rb'\A\s*\[\s*\{[^\[\]]*"keypoints"\s*:\s*\{\s*"(x|y|visible)"')
_TEXT = re.compile(rb"\A\d+( -?[\d.eE+-]+){4,}\s*(\n|\Z)")
_BOX_COLUMNS = 5
"""Class, and the box: centre x and y, width, height."""


def _first(path: Path, pattern: str) -> bytes:
    """The beginning of the first file that is not empty; frames without people may be empty files."""
    heads = (read_head(file, HEAD_BYTES) for file in in_folder(path, pattern)[:100])
    return next((head for head in heads if head.strip() not in (b"", b"[]")), b"")


@camera_reader(
    "ultralytics",
    "Ultralytics YOLO-pose: for each camera a folder with a .json file for each frame",
    recognises=lambda path, head: path.is_dir() and _JSON.match(_first(path, "*.json")) is not None,
)
def read_ultralytics(path: Path) -> View:
    """Read the results that ``to_json`` gave for each frame, in pixels."""
    people = (person for frame, file in frame_files(path, "*.json") for person in _people(frame, read_json(file)))
    view = View.of(path.name, people)
    if np.nanmax(view.keypoints[..., :2], initial=0) <= 1:
        raise ValueError("keypoints as shares of the image; save them in pixels, with normalize=False")
    return view


@camera_reader(
    "ultralytics-txt",
    "Ultralytics YOLO-pose: for each camera a folder with a .txt file for each frame (needs the size of the images)",
    recognises=lambda path, head: path.is_dir() and _is_text(_first(path, "*.txt")),
)
def read_ultralytics_txt(path: Path) -> View:
    """Read the rows that ``save_txt`` wrote: class, box, then x, y and visibility of each keypoint as shares of the image."""
    rows = [
        (frame, np.array(line.split(), dtype=np.float64))
        for frame, file in frame_files(path, "*.txt")
        for line in read_text(file).splitlines()
        if line.strip()
    ]
    return replace(View.of(path.name, [_row(frame, values) for frame, values in rows]), normalised=True)


def _is_text(head: bytes) -> bool:
    found = _TEXT.match(head)
    return found is not None and len(found.group().split()) >= _BOX_COLUMNS + 3


def _row(frame: int, values: Any) -> Detection:
    """A person, of a row that may end with the confidence of the box, and with the number of the person."""
    after = (len(values) - _BOX_COLUMNS) % 3
    keypoints = values[_BOX_COLUMNS : len(values) - after].reshape(-1, 3)
    if (np.abs(keypoints[:, 2] - 0.5) > 0.5).any():
        raise ValueError(f"frame {frame}: a visibility that is not from 0 to 1; keypoints need x, y and visibility")
    return Detection(frame, keypoints, int(values[-1]) if after == 2 else -1)


def _people(frame: int, results: Iterable[Mapping[str, Any]]) -> Iterable[Detection]:
    for result in results:
        points = result["keypoints"]
        number = result.get("track_id", -1)
        scores = points.get("visible", [1.0] * len(points["x"]))
        keypoints = np.column_stack([np.array(values, dtype=np.float64) for values in (points["x"], points["y"], scores)])
        yield Detection(frame, keypoints, number if isinstance(number, int) else -1)
