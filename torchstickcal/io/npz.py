"""The library's own files of sessions: NumPy arrays by name in an ``.npz`` file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from torchstickcal.archives import save_arrays
from torchstickcal.files import atomic_path
from torchstickcal.io.formats import reading, session_of, session_reader
from torchstickcal.io.truth import Truth
from torchstickcal.observations import Observations
from torchstickcal.stick import Stick
from torchstickcal.untrusted import open_arrays

_DESCRIPTION = "NumPy arrays of keypoints, intrinsics and sticks (.npz)"

_OPTIONAL_ARRAYS = ("distortion", "confidence", "image_size", "timestamps")
"""Arrays that have the names of fields of :class:`Observations`."""

_TRUTH_ARRAYS = {
    "rotations": "rotation",
    "translations": "translation",
    "points": "points",
    "intrinsics": "true_intrinsics",
    "distortion": "true_distortion",
    "time_offsets_s": "time_offsets_s",
    "readout_s": "readout_s",
}
"""By the fields of :class:`Truth`, the names of their arrays."""


@session_reader("npz", _DESCRIPTION, recognises=lambda path, head: head.startswith(b"PK"))
def read_npz(path: str | Path) -> tuple[Observations, Truth | None]:
    """Read a session from an ``.npz`` file.

    The file holds these arrays:

    - ``keypoints`` (C, F, P, 2), pixels, NaN where a point was not seen;
    - ``intrinsics`` (C, 3, 3) or (3, 3), camera matrices, pixels;
    - ``stick_start``, ``stick_end`` (S,), indices of points, and ``stick_length_m`` (S,), metres.

    It may hold:

    - ``stick_sigma_m`` (S,), standard deviation of each stick's length, metres; ``stick_offset_m`` (S, 2), offsets of start
      and end, metres, NaN where they are not known;
    - ``confidence`` (C, F, P), from 0 to 1; ``distortion`` (C, D) in OpenCV's order; ``fisheye`` (), true or false;
      ``image_size`` (C, 2), width and height, pixels; ``intrinsics_known`` (), false where ``intrinsics`` is a guess;
    - ``fps`` (), frames per second; ``timestamps`` (C, F), seconds; ``known_readout_s`` (), read-out time of the rolling
      shutters, seconds;
    - ``names`` (P,) of points and ``camera_names`` (C,);
    - the truth: ``rotation`` (C, 3, 3) and ``translation`` (C, 3), metres, world to camera; with these also ``points``
      (F, P, 3), metres, ``true_intrinsics`` (C, 3, 3), ``true_distortion`` (C, D), ``time_offsets_s`` (C,), seconds, and
      ``readout_s`` (C,), seconds.

    Other arrays are ignored and not read.

    Args:
        path: of the file.

    Returns:
        The observations, and the truth or None.

    Raises:
        FileFormatError: if an array is missing or the file is damaged.
        ObservationError: if the session cannot be used for a calibration.
        FileNotFoundError: if there is no such file.

    Example:
        >>> import tempfile
        >>> import numpy as np
        >>> from torchstickcal.io import read_npz
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     np.savez(
        ...         f"{folder}/session.npz",
        ...         keypoints=np.ones((2, 5, 2, 2)),
        ...         intrinsics=[[1000, 0, 320], [0, 1000, 240], [0, 0, 1]],
        ...         stick_start=[0],
        ...         stick_end=[1],
        ...         stick_length_m=[1.2],
        ...     )
        ...     observations, truth = read_npz(f"{folder}/session.npz")
        >>> observations.sticks, truth
        ((Stick(start=0, end=1, length_m=1.2, sigma_m=0.001),), None)
    """
    with reading(path, "a session with keypoints, intrinsics and sticks"), open_arrays(path) as arrays:
        return session_of(_observations(arrays), _truth(arrays))


def write_npz(
    path: str | Path, observations: Observations, truth: Truth | None = None, more: Mapping[str, Any] | None = None
) -> None:
    """Write a session to an ``.npz`` file, from which :func:`read_npz` reads exactly the same values.

    Args:
        path: of the file.
        observations: the session.
        truth: its true values, if they are known.
        more: further arrays to write, which :func:`read_npz` ignores.

    Raises:
        OSError: if the file cannot be written.

    Example:
        >>> import tempfile
        >>> from torchstickcal.io import read_npz, write_npz
        >>> from torchstickcal.simulate import golf_session
        >>> observations, truth = golf_session(cameras=3, frames=10)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_npz(f"{folder}/swing.npz", observations, truth)
        ...     back, back_truth = read_npz(f"{folder}/swing.npz")
        >>> bool((back.keypoints == observations.keypoints).all()), bool((back_truth.points == truth.points).all())
        (True, True)
    """
    arrays = _arrays(observations) | _truth_arrays(truth) | dict(more or {})
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        save_arrays(file, arrays)


def _observations(arrays: Mapping[str, Any]) -> Observations:
    return Observations(
        arrays["keypoints"],
        arrays["intrinsics"],
        _sticks(arrays),
        **{name: arrays.get(name) for name in _OPTIONAL_ARRAYS},
        fps=_number(arrays, "fps"),
        point_names=_names(arrays, "names"),
        camera_names=_names(arrays, "camera_names"),
        fisheye=bool(arrays.get("fisheye", False)),
        intrinsics_known=bool(arrays.get("intrinsics_known", True)),
        readout_s=_number(arrays, "known_readout_s"),
    )


def _sticks(arrays: Mapping[str, Any]) -> list[Stick]:
    columns = [arrays[name].tolist() for name in ("stick_start", "stick_end", "stick_length_m")]
    if "stick_sigma_m" in arrays:
        columns.append(arrays["stick_sigma_m"].tolist())
    sticks = [Stick(int(start), int(end), *map(float, lengths)) for start, end, *lengths in zip(*columns, strict=True)]
    if "stick_offset_m" not in arrays:
        return sticks
    offsets = [[None if np.isnan(own) else float(own) for own in pair] for pair in arrays["stick_offset_m"]]
    return [replace(stick, start_offset_m=start, end_offset_m=end) for stick, (start, end) in zip(sticks, offsets, strict=True)]


def _number(arrays: Mapping[str, Any], name: str) -> float | None:
    return float(arrays[name]) if name in arrays else None


def _names(arrays: Mapping[str, Any], name: str) -> list[str] | None:
    return list(arrays[name]) if name in arrays else None


def _truth(arrays: Mapping[str, Any]) -> Truth | None:
    if "rotation" not in arrays:
        return None
    return Truth(**{field: arrays[name] for field, name in _TRUTH_ARRAYS.items() if name in arrays})


def _arrays(observations: Observations) -> dict[str, Any]:
    sticks = observations.sticks
    offsets = np.array([(s.start_offset_m, s.end_offset_m) for s in sticks], dtype=np.float64).reshape(-1, 2)
    optional = {name: getattr(observations, name) for name in _OPTIONAL_ARRAYS}
    values = {
        "fps": observations.fps,
        "names": observations.point_names,
        "camera_names": observations.camera_names,
        "known_readout_s": observations.readout_s,
        "stick_offset_m": offsets if (offsets != 0).any() else None,
        "intrinsics_known": None if observations.intrinsics_known else False,
    }
    return {
        "keypoints": observations.keypoints.cpu().numpy(),
        "intrinsics": observations.intrinsics.cpu().numpy(),
        "stick_start": np.array([stick.ends[0] for stick in sticks], dtype=np.int64),
        "stick_end": np.array([stick.ends[1] for stick in sticks], dtype=np.int64),
        "stick_length_m": np.array([stick.length_m for stick in sticks], dtype=np.float64),
        "stick_sigma_m": np.array([stick.sigma_m for stick in sticks], dtype=np.float64),
        "fisheye": np.array(observations.fisheye),
        **{name: tensor.cpu().numpy() for name, tensor in optional.items() if tensor is not None},
        **{name: np.array(value) for name, value in values.items() if value is not None},
    }


def _truth_arrays(truth: Truth | None) -> dict[str, Any]:
    if truth is None:
        return {}
    values = {name: getattr(truth, field) for field, name in _TRUTH_ARRAYS.items()}
    return {name: value.cpu().numpy() for name, value in values.items() if value is not None}
