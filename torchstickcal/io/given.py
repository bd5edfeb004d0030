"""What the user says of a recording, and how a detector's keypoints become a session with it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchstickcal.arrays import tensor_of
from torchstickcal.errors import CalibrationError, FileFormatError
from torchstickcal.geometry.cameras import Intrinsics
from torchstickcal.io.formats import read_calibration
from torchstickcal.io.lenses import Lenses, lenses_of
from torchstickcal.io.people import AUTOMATIC, Athlete, athlete_of
from torchstickcal.io.recording import Recording, View
from torchstickcal.io.rig import Rig
from torchstickcal.io.skeletons import point_named, skeleton, skeletons_of
from torchstickcal.observations import Observations
from torchstickcal.stick import Stick, located_sticks

_MOST_EMPTY_FRAMES = 1000
_MOST_EMPTY_SHARE = 20
"""How many times more frames than those with a detection a recording may have, beside the number above."""
_HALFWAY = 0.2
"""How far from the middle between two joints, in lengths of the trunk, a joint is that is defined as their middle."""
_AT_NECK = 0.6
"""How far from the middle between the shoulders, in lengths of the trunk, the neck is at most."""
_Value = TypeVar("_Value")


@dataclass(frozen=True)
class Given:
    """What is known of a recording beside the files of the detector. None for what these say, and for what nobody knows.

    Args:
        stick: one stick or several; the ends are names or indices of points. ``RKnee`` and ``knee_right`` also mean the point
            ``right_knee``. An empty list where none is needed, as for :func:`torchstickcal.triangulate`.
        intrinsics: a calibration, or a file of one, of which the intrinsics are used. Cameras are matched by name, else by the
            last number in the names, else by order.
        image_size: width and height of the images in which the keypoints were detected, (2,) or (C, 2), pixels.
        fps: frames per second.
        skeleton: the names of the points: a key of :data:`~torchstickcal.io.skeletons.SKELETONS` or a TOML file with a list
            ``points``.
        person: who the athlete is, where several people are in view: "largest", "central", "moving", "stick" (who is nearest
            to the stick), "auto" ("stick" where the stick's ends come from files of their own, else "largest"), or the number
            that the tracker gave.
        stick_points: keypoints of the stick's ends, where they are in other files than the body's: the path of a recording.
        turned: how images were turned after the calibration: "left", "right" (a quarter, as a viewer sees it) or "back".

    Example:
        >>> Given(Stick("knob", "barrel", 0.864), intrinsics="Calib.toml", fps=120).person
        'auto'
    """

    stick: Stick | Sequence[Stick] | None = None
    intrinsics: Rig | str | Path | None = None
    image_size: Any = None
    fps: float | None = None
    skeleton: str | None = None
    person: str | int = AUTOMATIC
    stick_points: Recording | None = None
    turned: str | None = None


def complete(recording: Recording, given: Given) -> tuple[Observations, tuple[str, ...]]:
    """The session of a recording, and sentences about how it was understood.

    Raises:
        CalibrationError: if something is not known, or does not fit together.

    Example:
        >>> import numpy as np
        >>> from torchstickcal import Stick
        >>> from torchstickcal.io import Given, Recording, View, complete
        >>> views = [View.of_tracks(name, np.full((1, 5, 2, 2), 100.0), ["knob", "barrel"]) for name in ("left", "right")]
        >>> observations, notes = complete(Recording.of(views), Given(Stick("knob", "barrel", 0.864), image_size=(640, 480)))
        >>> observations.keypoints.shape, observations.camera_names
        (torch.Size([2, 5, 2, 2]), ('left', 'right'))
    """
    notes = list(recording.notes)
    lenses, sentences = _lenses(recording, given)
    notes += sentences
    recording = _in_pixels(recording, lenses.image_size)
    names, sentences = _named(recording, given.skeleton)
    notes += sentences
    views = recording.views
    stick = None if given.stick_points is None else _in_pixels(given.stick_points, lenses.image_size)
    stick_views = None if stick is None else _matching(stick, recording)
    numbers, shifts, sentences = _frame_numbers(recording.views)
    notes += sentences
    cameras = None if lenses.intrinsics is None else Intrinsics(lenses.intrinsics, lenses.distortion, lenses.fisheye)
    athlete = athlete_of(views, shifts, str(given.person), names, cameras, lenses.image_size, stick_views)
    notes += athlete.notes
    keypoints, sentences = _scored(_by_frame(athlete, views, shifts, numbers))
    notes += sentences
    if stick is not None and stick_views is not None:
        held = athlete_of(stick_views, shifts, AUTOMATIC, None, cameras, lenses.image_size, None)
        ends, sentences = _scored(_by_frame(held, stick_views, shifts, numbers))
        notes += (*stick.notes, *sentences)
        keypoints = np.concatenate([keypoints, ends], axis=2)
        names = (*names, *(stick.point_names or (f"stick {number}" for number in range(stick.num_points))))
    lenses.check_inside(keypoints, [view.name for view in views])
    observations = Observations(
        keypoints[..., :2],
        lenses.intrinsics,
        _sticks(given.stick, names),
        lenses.distortion,
        keypoints[..., 2],
        lenses.image_size,
        recording.fps if given.fps is None else given.fps,
        names,
        tuple(view.name for view in recording.views),
        lenses.fisheye,
    )
    return observations, tuple(notes)


def amended(observations: Observations, given: Given) -> tuple[Observations, tuple[str, ...]]:
    """A session in which what the user gives replaces what the file holds.

    Raises:
        CalibrationError: if something is given that a session cannot use, or that does not fit to it.
    """
    for name, value in (("person", given.person if given.person != AUTOMATIC else None), ("stick_points", given.stick_points)):
        if value is not None:
            raise CalibrationError(
                "a session has its athlete and its stick already",
                where=name,
                got=str(value),
                expected="keypoints of a detector",
            )
    if given.turned is not None and given.intrinsics is None:
        raise CalibrationError(
            "nothing to turn", where="turned", got=given.turned, expected="the calibration that was made before (--intrinsics)"
        )
    changes: dict[str, Any] = {}
    notes: tuple[str, ...] = ()
    if given.skeleton is not None:
        changes["point_names"] = skeleton(given.skeleton, observations.num_points)
    if given.image_size is not None:
        changes["image_size"] = given.image_size
    if given.fps is not None:
        changes["fps"] = given.fps
    if given.intrinsics is not None:
        size = observations.image_size if given.image_size is None else tensor_of(given.image_size, "image_size")
        lenses, notes = lenses_of(
            _rig(given.intrinsics), observations.camera_labels, _per_camera(size, observations.num_cameras), given.turned
        )
        changes |= {name: getattr(lenses, name) for name in ("intrinsics", "distortion", "fisheye", "image_size")}
        changes["intrinsics_known"] = True
    if given.stick:
        changes["sticks"] = _sticks(given.stick, changes.get("point_names", observations.point_names) or ())
    return (replace(observations, **changes) if changes else observations), notes


def _in_pixels(recording: Recording, image_size: Tensor | None) -> Recording:
    """A recording whose keypoints are all in pixels.

    Raises:
        CalibrationError: if some are shares of images whose size is not known.
    """
    if not any(view.normalised for view in recording.views):
        return recording
    if image_size is None or len(image_size) != len(recording.views):
        raise CalibrationError(
            "keypoints are shares of the image, whose size is not known",
            where="image_size",
            got="none",
            expected="width and height in pixels",
            remedy="Give it with --image-size WIDTH HEIGHT.",
        )
    views = [
        replace(view, keypoints=view.keypoints * [*size, 1.0], normalised=False) if view.normalised else view
        for view, size in zip(recording.views, image_size.tolist(), strict=True)
    ]
    return replace(recording, views=tuple(views))


def _named(recording: Recording, given: str | None) -> tuple[tuple[str, ...], list[str]]:
    """The names of the points, and a sentence where they were not given."""
    count = recording.num_points
    if given is not None:
        return skeleton(given, count), []
    if recording.point_names is not None:
        return recording.point_names, []
    if recording.skeleton is not None:
        return skeleton(recording.skeleton, count), [f"The skeleton is {recording.skeleton}, as the files say."]
    known = skeletons_of(count)
    if len(known) > 1:
        known = [_either_25(recording.views)]
    if known:
        return skeleton(known[0]), [
            f"The skeleton is taken to be {known[0]}, by its {count} points; --skeleton chooses another."
        ]
    return tuple(f"point {number}" for number in range(count)), []


def _either_25(views: Sequence[View]) -> str:
    """Which of OpenPose's skeletons of 25 points it is: in BODY_25 point 8 is the middle of the hips.

    Raises:
        CalibrationError: if it is clearly neither.
    """
    points = np.concatenate([view.keypoints[..., :2] for view in views])

    def off_middle(point: int, first: int, second: int, trunk: tuple[int, int]) -> float:
        length = np.linalg.norm(points[:, trunk[0]] - points[:, trunk[1]], axis=-1)
        distance = np.linalg.norm(points[:, point] - (points[:, first] + points[:, second]) / 2, axis=-1) / length
        return float(np.median(distance[np.isfinite(distance)])) if np.isfinite(distance).any() else np.inf

    if off_middle(8, 9, 12, (1, 8)) < _HALFWAY and off_middle(1, 2, 5, (1, 8)) < _HALFWAY:
        return "body-25"
    if off_middle(17, 5, 6, (5, 11)) < _AT_NECK:
        return "body-25b"
    raise CalibrationError(
        "the skeleton is not known",
        where="skeleton",
        got="25 points that fit to neither body-25 nor body-25b",
        expected="the name of the skeleton",
        remedy="Give it with --skeleton, as body-25 or body-25b.",
    )


def _lenses(recording: Recording, given: Given) -> tuple[Lenses, list[str]]:
    """The intrinsics, and sentences about them."""
    labels = tuple(view.name for view in recording.views)
    sizes = [view.image_size for view in recording.views]
    stated = torch.tensor([size or (torch.nan, torch.nan) for size in sizes], dtype=torch.float64)
    size = stated if given.image_size is None else _sizes(given.image_size, labels, stated)
    source = recording.intrinsics if given.intrinsics is None else given.intrinsics
    if source is not None:
        lenses, notes = lenses_of(_rig(source), labels, size, given.turned)
        return lenses, [*([f"The intrinsics are those of {source}."] if given.intrinsics is None else []), *notes]
    if not bool(size.isfinite().all()):
        raise CalibrationError(
            "nothing is known of the lenses",
            where="intrinsics",
            got="neither a calibration nor the size of the images",
            expected="one of them",
            remedy="Give a file with --intrinsics, or --image-size WIDTH HEIGHT; focal lengths are then estimated.",
        )
    return Lenses(None, None, False, size), []


def _rig(source: Rig | str | Path) -> Rig:
    return source if isinstance(source, Rig) else read_calibration(source)


def _sizes(given: Any, labels: Sequence[str], stated: Tensor) -> Tensor:
    """The given image sizes (C, 2).

    Raises:
        CalibrationError: if they are others than the files say.
    """
    size = tensor_of(given, "image_size").double()
    if tuple(size.shape) not in {(2,), (len(labels), 2)}:
        expected = f"(2,) or ({len(labels)}, 2): width, height in pixels"
        raise CalibrationError("image size is not usable", where="image_size", got=size.tolist(), expected=expected)
    size = size.expand(len(labels), 2)
    for label, own, read in zip(labels, size.tolist(), stated.tolist(), strict=True):
        if not any(np.isnan(read)) and own != read:
            raise CalibrationError(
                "another image size than the files say", where=f"image_size of {label}", got=own, expected=f"{read}, or none"
            )
    return size


def _per_camera(size: Tensor | None, cameras: int) -> Tensor | None:
    """Image sizes (C, 2), of one for all or of each."""
    return None if size is None else size.double().expand(cameras, 2)


def _matching(points: Recording, recording: Recording) -> tuple[View, ...]:
    """The views of the stick, in the order of the cameras of the body's.

    Raises:
        FileFormatError: if they are not of the same cameras.
    """
    by_name = {view.name: view for view in points.views}
    labels = [view.name for view in recording.views]
    if set(by_name) == set(labels):
        return tuple(by_name[label] for label in labels)
    if len(points.views) == len(labels):
        return points.views
    raise FileFormatError(
        "the stick was recorded by other cameras than the body",
        where="stick_points",
        got=", ".join(by_name),
        expected=", ".join(labels),
    )


def _frame_numbers(views: Sequence[View]) -> tuple[NDArray[np.int64], list[int], list[str]]:
    """The numbers of the frames of all cameras, the number at which each camera's frames begin, and a sentence about it.

    Raises:
        FileFormatError: if nearly all frames between the first and the last are missing.
    """
    firsts, lasts = [int(view.frames[0]) for view in views], [int(view.frames[-1]) for view in views]
    shifts, notes = [0] * len(views), []
    if max(firsts) > min(lasts):
        shifts = firsts
        ranges = ", ".join(f"{view.name} {first} to {last}" for view, first, last in zip(views, firsts, lasts, strict=True))
        notes.append(f"The cameras have no frame numbers in common ({ranges}); their first frames are taken for the same.")
    first = min(first - shift for first, shift in zip(firsts, shifts, strict=True))
    last = max(last - shift for last, shift in zip(lasts, shifts, strict=True))
    seen = max(len(np.unique(view.frames)) for view in views)
    if last - first >= _MOST_EMPTY_FRAMES + _MOST_EMPTY_SHARE * seen:
        raise FileFormatError(
            "frame numbers are far apart",
            where="frames",
            got=f"frames {first} to {last}, of which a camera has at most {seen}",
            expected="numbers that count the frames",
        )
    return np.arange(first, last + 1), shifts, notes


def _by_frame(
    athlete: Athlete, views: Sequence[View], shifts: Sequence[int], numbers: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Keypoints (C, F, P, 3) of the athlete."""
    keypoints = np.full((len(views), len(numbers), views[0].keypoints.shape[1], 3), [np.nan, np.nan, 0.0])
    for camera, (view, rows, shift) in enumerate(zip(views, athlete.rows, shifts, strict=True)):
        frames = view.frames[rows] - shift - numbers[0]
        inside = (frames >= 0) & (frames < len(numbers))
        keypoints[camera, frames[inside]] = view.keypoints[rows[inside]]
    return keypoints


def _scored(keypoints: NDArray[np.float64]) -> tuple[NDArray[np.float64], list[str]]:
    """Keypoints with scores from 0 to 1, and a sentence if they were others."""
    top = float(keypoints[..., 2].max(initial=0.0))
    if top <= 1:
        return keypoints, []
    keypoints[..., 2] /= top
    return keypoints, [f"The scores go up to {top:.4g}; they were divided by it, so that confidences are from 0 to 1."]


def _sticks(given: Stick | Sequence[Stick] | None, names: Sequence[str]) -> tuple[Stick, ...]:
    """The sticks, with their ends as indices of points.

    Raises:
        CalibrationError: if there is none, or if an end is no point.
    """
    if given is None:
        raise CalibrationError(
            "no stick",
            where="stick",
            got="keypoints alone, which have no length",
            expected=f"two of the points and the metres between them; the points are {', '.join(names)}",
            remedy="Give them with --stick START END METRES.",
        )
    sticks = [given] if isinstance(given, Stick) else given
    return located_sticks([_named_ends(stick, names) for stick in sticks], names)


def _named_ends(stick: Stick, names: Sequence[str]) -> Stick:
    start, end = (point_named(e, names) if isinstance(e, str) else e for e in (stick.start, stick.end))
    return replace(stick, start=start, end=end)
