"""The frames of a video, upright, each with the time at which it was taken."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from torchstickcal.errors import FileFormatError

Image = NDArray[np.uint8]
"""(H, W, 3), blue, green, red"""

_SAME_TIME_S = 1e-4


@dataclass(frozen=True)
class VideoInfo:
    """What the header of a video says."""

    size: tuple[int, int]
    """width and height of the upright frames, pixels"""
    fps: float
    """frames per second, as written in the header"""
    frames: int
    """their number; 0 where the header does not say it"""
    turned_deg: int
    """by how much the frames are turned so that they are upright"""


def video_info(path: str | Path) -> VideoInfo:
    """What the header of a video says.

    Raises:
        FileFormatError: if it cannot be read as a video.
        FileNotFoundError: if there is no such file.
    """
    capture = _opened(path)
    try:
        size = tuple(int(capture.get(key)) for key in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
        turned = int(capture.get(cv2.CAP_PROP_ORIENTATION_META)) % 360
        count = max(0, int(capture.get(cv2.CAP_PROP_FRAME_COUNT)))
        return VideoInfo((size[0], size[1]), float(capture.get(cv2.CAP_PROP_FPS)), count, turned)
    finally:
        capture.release()


def frames_of(path: str | Path) -> Iterator[tuple[float, Image]]:
    """Times in seconds and images of the frames of a video. Images are upright also where the camera was turned.

    Times are those of the video's frames, so that a variable rate and frames that were dropped are seen in them. Where a video
    has no times, they follow from the rate in its header.

    Raises:
        FileFormatError: if it cannot be read as a video, or has no frame.
        FileNotFoundError: if there is no such file.
    """
    capture = _opened(path)
    fps = float(capture.get(cv2.CAP_PROP_FPS)) or 30.0
    before, number = -np.inf, 0
    try:
        while True:
            read, image = capture.read()
            if not read:
                break
            time_s = float(capture.get(cv2.CAP_PROP_POS_MSEC)) / 1000
            if time_s <= before + _SAME_TIME_S:
                time_s = number / fps if number == 0 else before + 1 / fps
            yield time_s, np.asarray(image, dtype=np.uint8)
            before, number = time_s, number + 1
    finally:
        capture.release()
    if number == 0:
        raise _unreadable(path, "no frame")


def frames_at(path: str | Path, numbers: set[int]) -> Iterator[Image]:
    """The images of some frames of a video, counted from 0; errors as of :func:`frames_of`."""
    capture, number = _opened(path), 0
    try:
        while number <= max(numbers, default=-1) and capture.grab():
            if number in numbers:
                yield np.asarray(capture.retrieve()[1], dtype=np.uint8)
            number += 1
    finally:
        capture.release()


def frame_numbers(times: NDArray[np.float64]) -> tuple[NDArray[np.int64], float]:
    """Numbers of frames that leave out those that were dropped, and the frame rate, from the times (F,) of the frames.

    Example:
        >>> frame_numbers(np.array([0.0, 0.01, 0.02, 0.05, 0.06]))[0].tolist()
        [0, 1, 2, 5, 6]
    """
    if len(times) < 2:
        return np.zeros(len(times), dtype=np.int64), 0.0
    step = float(np.median(np.diff(times)))
    whole = np.round((times - times[0]) / step)
    if whole[-1] > 0:  # the median of rounded times is itself rounded
        step = float((times[-1] - times[0]) / whole[-1])
    numbers = np.round((times - times[0]) / step).astype(np.int64)
    if len(set(numbers.tolist())) != len(numbers):
        return np.arange(len(times), dtype=np.int64), 1 / step
    return numbers, 1 / step


def _opened(path: str | Path) -> cv2.VideoCapture:
    if not Path(path).exists():
        raise FileNotFoundError(f"no such video: {path}")
    if not Path(path).is_file():
        raise _unreadable(path, "a folder or a device")
    capture = cv2.VideoCapture(str(path))
    if not capture.isOpened():
        raise _unreadable(path, "another kind of file, or a damaged one")
    return capture


def _unreadable(path: str | Path, got: str) -> FileFormatError:
    return FileFormatError("a file cannot be read as a video", where=str(path), got=got, expected="a video that OpenCV reads")
