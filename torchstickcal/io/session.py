"""Sessions: recorded keypoints with their cameras and sticks, and the truth where it is known."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchstickcal.errors import CalibrationError, FileFormatError
from torchstickcal.files import atomic_path
from torchstickcal.io import safe_pickle
from torchstickcal.observations import Observations
from torchstickcal.stick import Stick

SPORTS_STICK_SYN_JOINTS = (
    "pelvis", "spine", "right_shoulder", "left_shoulder", "neck", "head", "head_top",
    "right_elbow", "right_wrist", "right_hand", "left_elbow", "left_wrist", "left_hand",
    "right_knee", "right_shin", "right_ankle", "left_knee", "left_shin", "left_ankle",
)  # fmt: skip
"""The 19 joints of Sports-Stick-Syn; the files do not name them, these names follow the bones' lengths and positions."""


@dataclass(frozen=True, eq=False)
class Truth:
    """Reference values of a session, as far as its file has them."""

    rotations: Tensor
    """(C, 3, 3), world to camera"""
    translations: Tensor
    """(C, 3), world to camera, metres"""
    points: Tensor | None = None
    """(F, P, 3), metres, at the frame times of camera 0"""
    intrinsics: Tensor | None = None
    """(C, 3, 3), where those given with the session may be wrong"""
    distortion: Tensor | None = None
    """(C, D), likewise"""
    time_offsets_s: Tensor | None = None
    """(C,): a camera's frame f begins at frame f of camera 0 plus this"""
    readout_s: Tensor | None = None
    """(C,), of a rolling shutter: row v of h is exposed ``readout_s * v / h`` after the frame begins"""


_TRUTH_ARRAYS = {
    "rotations": "rotation",
    "translations": "translation",
    "points": "points",
    "intrinsics": "true_intrinsics",
    "distortion": "true_distortion",
    "time_offsets_s": "time_offsets_s",
    "readout_s": "readout_s",
}


def read_session(path: str | Path) -> tuple[Observations, Truth | None]:
    """Read a session of any known format, told by its content.

    Raises:
        FileFormatError: if the file is of no known format, or damaged.
        ObservationError: if what it holds cannot be calibrated from.
        OSError: if it cannot be opened.
    """
    with Path(path).open("rb") as file:
        head = file.read(4)
    if head.startswith(b"PK"):
        return read_npz(path)
    if head.startswith(b"\x80"):
        return read_sports_stick_syn(path)
    raise FileFormatError(
        "unknown kind of session", where=str(path), got=f"a file starting with {head!r}", expected="an .npz or .pkl session"
    )


def read_sports_stick_syn(path: str | Path) -> tuple[Observations, Truth]:
    """Read a sequence of Sports-Stick-Syn, the paper's data: a pickle, read without running it.

    The points are the 19 joints followed by the stick's start and end. A stick end at (0, 0) was not seen.

    Raises:
        FileFormatError: if the file is not such a sequence, is damaged, or holds anything but plain data.
    """
    data = safe_pickle.load(path)
    try:
        joints, seen = np.array(data["all_pose_projections_2d"], float), np.array(data["all_projection_masks"], bool)
        ends = np.array(data["all_observed_points_2d"], float)
        joints[~seen] = np.nan
        ends[(ends == 0).all(-1)] = np.nan
        keypoints = np.concatenate([joints, ends], axis=2)
        first = joints.shape[2]
        matrix = np.array(data["K"], float)
        names = SPORTS_STICK_SYN_JOINTS if first == len(SPORTS_STICK_SYN_JOINTS) else [f"joint_{k}" for k in range(first)]
        observations = Observations(
            keypoints,
            matrix,
            Stick(first, first + 1, float(data["stick_length"])),
            image_size=2 * matrix[:2, 2],
            point_names=[*names, "stick_start", "stick_end"],
            camera_names=[str(camera["name"]) for camera in data["cameras"]],
        )
        truth = Truth(
            torch.tensor(data["Rs_gt"], dtype=torch.float64),
            torch.tensor(data["ts_gt"], dtype=torch.float64).flatten(1),
            torch.from_numpy(np.concatenate([np.array(data["pose_3d_gt"]), np.array(data["stick_3d_gt"])], axis=1)),
        )
    except CalibrationError:
        raise
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise _not_a_session(path, error, "a Sports-Stick-Syn sequence") from error
    return observations, truth


def read_npz(path: str | Path) -> tuple[Observations, Truth | None]:
    """Read a session from an ``.npz`` file.

    Arrays: ``keypoints`` (C, F, P, 2), NaN where not seen; ``intrinsics`` (C, 3, 3); ``stick_start``, ``stick_end`` and
    ``stick_length_m`` (S,); optional ``confidence`` (C, F, P), ``distortion`` (C, D), ``image_size`` (C, 2), ``names`` (P),
    ``camera_names`` (C), ``fps``, ``timestamps`` (C, F), ``known_readout_s``, and as truth ``rotation`` (C, 3, 3),
    ``translation`` (C, 3), ``points`` (F, P, 3), ``true_intrinsics`` (C, 3, 3), ``true_distortion`` (C, D),
    ``time_offsets_s`` (C), ``readout_s`` (C).

    Raises:
        FileFormatError: if an array is missing or the file is damaged.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            data: dict[str, Any] = {name: file[name] for name in file.files}
        sticks = [
            Stick(int(start), int(end), float(length))
            for start, end, length in zip(data["stick_start"], data["stick_end"], data["stick_length_m"], strict=True)
        ]
        observations = Observations(
            data["keypoints"],
            data["intrinsics"],
            sticks,
            distortion=data.get("distortion"),
            confidence=data.get("confidence"),
            image_size=data.get("image_size"),
            fps=float(data["fps"]) if "fps" in data else None,
            point_names=list(data["names"]) if "names" in data else None,
            camera_names=list(data["camera_names"]) if "camera_names" in data else None,
            fisheye=bool(data.get("fisheye", False)),
            timestamps=data.get("timestamps"),
            readout_s=float(data["known_readout_s"]) if "known_readout_s" in data else None,
        )
        if "rotation" not in data:
            return observations, None
        return observations, Truth(
            **{name: torch.from_numpy(data[array]) for name, array in _TRUTH_ARRAYS.items() if array in data}
        )
    except CalibrationError:
        raise
    except (KeyError, TypeError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise _not_a_session(path, error, "a session with keypoints, intrinsics and sticks") from error


def write_npz(
    path: str | Path, observations: Observations, truth: Truth | None = None, more: Mapping[str, Any] | None = None
) -> None:
    """Write a session as :func:`read_npz` reads it, with ``more`` arrays that it passes over."""
    arrays: dict[str, Any] = {
        "keypoints": observations.keypoints.cpu().numpy(),
        "intrinsics": observations.intrinsics.cpu().numpy(),
        "stick_start": np.array([stick.start for stick in observations.sticks], dtype=np.int64),
        "stick_end": np.array([stick.end for stick in observations.sticks], dtype=np.int64),
        "stick_length_m": np.array([stick.length_m for stick in observations.sticks], dtype=np.float64),
        "fisheye": np.array(observations.fisheye),
    }
    for name in ("distortion", "confidence", "image_size", "timestamps"):
        if (tensor := getattr(observations, name)) is not None:
            arrays[name] = tensor.cpu().numpy()
    optional = {
        "fps": observations.fps,
        "names": observations.point_names,
        "camera_names": observations.camera_names,
        "known_readout_s": observations.readout_s,
    }
    arrays |= {name: np.array(value) for name, value in optional.items() if value is not None}
    if truth is not None:
        known = {array: getattr(truth, name) for name, array in _TRUTH_ARRAYS.items()}
        arrays |= {array: value.numpy() for array, value in known.items() if value is not None}
    arrays |= more or {}
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, **arrays)


def _not_a_session(path: str | Path, error: Exception, expected: str) -> FileFormatError:
    missing = f"no {error}" if isinstance(error, KeyError) else f"{type(error).__name__}: {error}"
    return FileFormatError("not a usable session", where=str(path), got=missing, expected=expected)
