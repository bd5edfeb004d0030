"""What detectors wrote of a recording, before anything else is known of it: the middle between files and sessions.

A file format says which people each camera saw in which frame. Everything else is the same for all formats and done here:
missing points, scores, names of points and cameras, and the number of a frame.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchstickcal.errors import FileFormatError

_DIGITS = re.compile(r"(\d+)")
_LONGEST_NUMBER = 15
"""Digits of a number in a name; more are a date with a time, or no number at all."""


class Detection(NamedTuple):
    """One person in one frame of one camera."""

    frame: int
    """number of the frame"""
    keypoints: Any
    """(P, 2) pixels, or (P, 3) with a score of each point; NaN where a point was not seen"""
    person: int = -1
    """number that the tracker gave to the person; -1 if there is none"""


@dataclass(frozen=True, eq=False)
class View:
    """What one camera saw: one row for each person in each frame."""

    name: str
    """of the camera"""
    frames: NDArray[np.int64]
    """(N,), numbers of the frames, in ascending order"""
    keypoints: NDArray[np.float64]
    """(N, P, 3), x and y in pixels and a score; NaN, NaN, 0 where a point was not seen"""
    persons: NDArray[np.int64]
    """(N,), as in :class:`Detection`"""
    point_names: tuple[str, ...] | None = None
    """P names, if the file has them"""
    image_size: tuple[float, float] | None = None
    """width and height in pixels, if the file has them"""
    normalised: bool = False
    """whether x and y are shares of the width and the height instead of pixels"""

    @classmethod
    def of(
        cls,
        name: str,
        detections: Iterable[Detection],
        point_names: Sequence[str] | None = None,
        image_size: tuple[float, float] | None = None,
    ) -> View:
        """The view of a camera, from the people that it saw.

        A point was not seen where it is NaN, at (0, 0), at equal negative coordinates such as (-1, -1), or has a score of 0 or
        less.

        Raises:
            ValueError: if there is no detection, or if two of them have different numbers of points.

        Example:
            >>> view = View.of("left", [Detection(7, [[10, 20, 0.9], [0, 0, 0]]), Detection(6, [[11, 20, 0.8], [5, 5, 0.1]])])
            >>> view.frames, view.keypoints[1].tolist()
            (array([6, 7]), [[10.0, 20.0, 0.9], [nan, nan, 0.0]])
        """
        rows = sorted(detections, key=lambda detection: detection.frame)
        if not rows:
            raise ValueError(f"nobody was seen by camera {name!r}")
        counts = {len(row.keypoints) for row in rows}
        if len(counts) != 1 or (point_names is not None and counts != {len(point_names)}):
            named = "" if point_names is None else f", {len(point_names)} names"
            raise ValueError(f"different numbers of points in one camera: {', '.join(map(str, sorted(counts)))}{named}")
        return cls(
            name,
            np.array([row.frame for row in rows], dtype=np.int64),
            cleaned(np.stack([np.asarray(row.keypoints, dtype=np.float64) for row in rows])),
            np.array([row.person for row in rows], dtype=np.int64),
            None if point_names is None else tuple(map(str, point_names)),
            image_size,
        )

    @classmethod
    def of_tracks(
        cls,
        name: str,
        tracks: NDArray[Any],
        point_names: Sequence[str] | None = None,
        image_size: tuple[float, float] | None = None,
        frames: Sequence[int] | None = None,
    ) -> View:
        """The view of a camera, from tracks of people (people, F, P, 2 or 3), without frames in which a person has no point.

        ``frames`` are the numbers of the F frames; None for 0, 1, 2, ...

        Raises:
            ValueError: if no point was ever seen.
        """
        tracks = np.asarray(tracks, dtype=np.float64)
        seen = np.isfinite(tracks[..., :2]).all(-1).any(-1)
        numbers = range(tracks.shape[1]) if frames is None else frames
        if len(set(numbers)) != tracks.shape[1]:
            raise ValueError(f"{tracks.shape[1]} frames with {len(set(numbers))} different numbers")
        several = len(tracks) > 1
        found = (
            Detection(int(numbers[frame]), tracks[person, frame], int(person) if several else -1)
            for frame, person in np.argwhere(seen.T)
        )
        return cls.of(name, found, point_names, image_size)


@dataclass(frozen=True, eq=False)
class Recording:
    """What all cameras of a rig saw, and what else the files say of it."""

    views: tuple[View, ...]
    """of each camera; all have the same points"""
    fps: float | None = None
    """frames per second"""
    intrinsics: Path | None = None
    """a calibration that belongs to the recording"""
    skeleton: str | None = None
    """name of the skeleton, if the files say which it is"""
    notes: tuple[str, ...] = ()
    """sentences about what was read, and how it was understood"""

    @classmethod
    def of(cls, views: Sequence[View], **more: Any) -> Recording:
        """The recording of some cameras, in natural order of their names: cam2 before cam10.

        Points are matched by name where the files name them; a point that a camera lacks was not seen by it.

        Raises:
            ValueError: if there is no camera, if two have one name, or different numbers of points without names.
        """
        if not views:
            raise ValueError("no camera")
        views = sorted(views, key=lambda view: natural_order(view.name))
        labels = [view.name for view in views]
        if repeated := sorted({label for label in labels if labels.count(label) > 1}):
            raise ValueError(f"two cameras called {repeated[0]!r}")
        if any(view.point_names is None for view in views):
            counts = {view.name: view.keypoints.shape[1] for view in views}
            if len(set(counts.values())) > 1:
                raise ValueError(f"cameras with different numbers of points: {counts}")
            return cls(tuple(views), **more)
        names = tuple(dict.fromkeys(name for view in views for name in view.point_names or ()))
        return cls(tuple(_arranged(view, names) for view in views), **more)

    @property
    def num_points(self) -> int:
        """P"""
        return self.views[0].keypoints.shape[1]

    @property
    def point_names(self) -> tuple[str, ...] | None:
        """P names, if the files have them."""
        return self.views[0].point_names

    def with_notes(self, *sentences: str) -> Recording:
        """The same recording with further notes."""
        return replace(self, notes=(*self.notes, *sentences))


def cleaned(keypoints: NDArray[Any]) -> NDArray[np.float64]:
    """Keypoints (..., 2 or 3) as x, y and score (..., 3): NaN, NaN, 0 where a point was not seen, as :meth:`View.of` says.

    Raises:
        ValueError: if they have another shape.
    """
    if keypoints.ndim < 2 or keypoints.shape[-1] not in (2, 3):
        raise ValueError(f"keypoints of the shape {keypoints.shape}, not two or three numbers for each")
    x, y = keypoints[..., 0], keypoints[..., 1]
    score = keypoints[..., 2] if keypoints.shape[-1] == 3 else np.ones_like(x)
    with np.errstate(invalid="ignore"):
        unseen = ~(np.isfinite(x) & np.isfinite(y)) | ((x == y) & (x <= 0)) | ~(score > 0) | np.isinf(score)
    return np.where(unseen[..., None], [np.nan, np.nan, 0.0], np.stack([x, y, score], axis=-1))


def natural_order(name: str) -> tuple[Any, ...]:
    """A key by which names are sorted as people count: cam2 before cam10.

    Example:
        >>> sorted(["cam10", "cam2", "Cam1"], key=natural_order)
        ['Cam1', 'cam2', 'cam10']
    """
    parts = _DIGITS.split(name.lower())
    return (tuple((part.isdecimal(), int(part[:_LONGEST_NUMBER]) if part.isdecimal() else part) for part in parts), name)


def last_number(name: str) -> int | None:
    """The last whole number in a name; None if there is none.

    Example:
        >>> last_number("cam01.0042"), last_number("left")
        (42, None)
    """
    found = _DIGITS.findall(name)
    return int(found[-1]) if found and len(found[-1]) <= _LONGEST_NUMBER else None


def in_folder(folder: Path, pattern: str = "*") -> list[Path]:
    """The entries of a folder that match a pattern, without hidden ones, in natural order."""
    return sorted((path for path in folder.glob(pattern) if not path.name.startswith(".")), key=lambda p: natural_order(p.name))


def frame_files(folder: Path, pattern: str) -> list[tuple[int, Path]]:
    """The files of a folder that hold one frame each, with the numbers of their frames, in their order.

    The number of a frame is the last number in the name that is another one in every file.

    Raises:
        FileFormatError: if the names have no such number.
    """
    files = in_folder(folder, pattern)
    numbers = [[int(digits) for digits in _DIGITS.findall(path.stem) if len(digits) <= _LONGEST_NUMBER] for path in files]
    for place in range(1, min(map(len, numbers), default=0) + 1):
        frames = [own[-place] for own in numbers]
        if len(set(frames)) == len(files):
            return sorted(zip(frames, files, strict=True))
    raise FileFormatError(
        "files of frames are not numbered",
        where=str(folder),
        got=", ".join(path.name for path in files[:3]) or f"no {pattern}",
        expected="a file for each frame, with the number of the frame at the end of its name",
    )


def _arranged(view: View, names: tuple[str, ...]) -> View:
    """A view with the points of these names, in this order."""
    own = view.point_names or ()
    if len(set(own)) != len(own):
        raise ValueError(f"two points of one name in camera {view.name!r}")
    keypoints = np.full((len(view.frames), len(names), 3), [np.nan, np.nan, 0.0])
    keypoints[:, [names.index(name) for name in own]] = view.keypoints
    return replace(view, keypoints=keypoints, point_names=names)
