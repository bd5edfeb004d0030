"""COCO: annotations and results of keypoint detectors, one JSON file for each camera; and results of AlphaPose."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from torchstickcal.io.formats import camera_reader
from torchstickcal.io.recording import Detection, View, last_number
from torchstickcal.io.skeletons import conventional
from torchstickcal.untrusted import read_json

_ANNOTATIONS = re.compile(rb'\A\s*\{\s*"(info|licenses|images|annotations|categories)"\s*:')
_RESULTS = re.compile(rb"\A\s*\[\s*\{")
_IMAGE_NAME = re.compile(rb'"image_id"\s*:\s*"')
_HALF_VISIBLE = {0.0: 0.0, 1.0: 0.5, 2.0: 1.0}
"""Scores of COCO's marks: not in the image, occluded, visible."""


def _are_results(head: bytes) -> bool:
    return _RESULTS.match(head) is not None and b'"image_id"' in head and b'"keypoints"' in head


@camera_reader(
    "coco",
    "COCO keypoints: annotations, or a list of results; a JSON file for each camera",
    recognises=lambda path, head: (
        _ANNOTATIONS.match(head) is not None or (_are_results(head) and _IMAGE_NAME.search(head) is None)
    ),
)
def read_coco(path: Path) -> View:
    """Read the annotations of images, or a list of results. The frame is the last number in an image's name, else its id.

    The marks 1 (occluded) and 2 (visible) of annotations become the scores 0.5 and 1.
    """
    content = read_json(path)
    if isinstance(content, list):
        return View.of(path.stem, [_detection(result, _frame(result["image_id"])) for result in content])
    images: dict[Any, Mapping[str, Any]] = {image["id"]: image for image in content["images"]}
    folders = {str(PurePosixPath(str(image.get("file_name", ""))).parent) for image in images.values()}
    if len(folders) > 1:
        raise ValueError(f"images in {len(folders)} folders, as of several cameras; a file for each camera is needed")
    frames = _frames(images)
    found = [one for one in content["annotations"] if any(one.get("keypoints", ()))]
    marks = {float(mark) for one in found for mark in one["keypoints"][2::3]}
    scores = _HALF_VISIBLE if marks <= set(_HALF_VISIBLE) else None
    detections = [_detection(one, frames[one["image_id"]], scores) for one in found]
    return View.of(path.stem, detections, _point_names(content), _size(images.values()))


@camera_reader(
    "alphapose",
    "AlphaPose: a JSON file with a list of results for each camera",
    recognises=lambda path, head: _are_results(head) and _IMAGE_NAME.search(head) is not None,
)
def read_alphapose(path: Path) -> View:
    """Read a list of results. The frame is the last number in an image's name, and ``idx`` the number of the person."""
    return View.of(path.stem, [_detection(result, _frame(result["image_id"])) for result in read_json(path)])


def _detection(result: Mapping[str, Any], frame: int, scores: Mapping[float, float] | None = None) -> Detection:
    keypoints = np.array(result["keypoints"], dtype=np.float64).reshape(-1, 3)
    if scores is not None:
        keypoints[:, 2] = [scores[mark] for mark in keypoints[:, 2].tolist()]
    number = result.get("idx", result.get("track_id", -1))
    number = number[0] if isinstance(number, list) and number else number
    return Detection(frame, keypoints, int(number) if isinstance(number, int | float) else -1)


def _frame(image: int | str) -> int:
    """The frame of an image by its id, which may be its name."""
    number = image if isinstance(image, int) else last_number(PurePosixPath(image).stem)
    if number is None:
        raise ValueError(f"an image {image!r} without a number")
    return number


def _frames(images: Mapping[Any, Mapping[str, Any]]) -> dict[Any, int]:
    """The frames of images by their ids: the numbers in their names, where these differ, else the ids."""
    numbers = {id: last_number(PurePosixPath(str(image.get("file_name", ""))).stem) for id, image in images.items()}
    known = {id: number for id, number in numbers.items() if number is not None}
    return known if len(set(known.values())) == len(images) else {id: int(id) for id in images}


def _size(images: Sequence[Mapping[str, Any]] | Any) -> tuple[float, float] | None:
    sizes = {(float(image["width"]), float(image["height"])) for image in images if "width" in image and "height" in image}
    if len(sizes) > 1:
        raise ValueError(f"images of different sizes: {sorted(sizes)[:3]}")
    return next(iter(sizes), None)


def _point_names(content: Mapping[str, Any]) -> list[str] | None:
    names = next((category["keypoints"] for category in content.get("categories", ()) if category.get("keypoints")), None)
    return None if names is None else list(map(conventional, names))
