"""Sports-Stick-Syn, the data set of the paper: one pickle file per sequence."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchstickcal.io import safe_pickle
from torchstickcal.io.formats import reading, session_of, session_reader
from torchstickcal.io.truth import Truth
from torchstickcal.observations import Observations
from torchstickcal.skeletons import SPORTS_STICK_SYN_JOINTS
from torchstickcal.stick import Stick

_DESCRIPTION = "sequence of the data set Sports-Stick-Syn (a pickle; none of its code is run)"


@session_reader(
    "sports-stick-syn", _DESCRIPTION, recognises=lambda path, head: head.startswith(b"\x80") and b"intrinsicMat" not in head
)
def read_sports_stick_syn(path: str | Path) -> tuple[Observations, Truth]:
    """Read a sequence of Sports-Stick-Syn, the data set of the paper. The file is a pickle; none of its code is run.

    Args:
        path: of the file.

    Returns:
        The observations, with keypoints (C, F, 21, 2) of the 19 joints and of the stick's start and end, NaN where not seen
        (a stick end at (0, 0) was not seen); and the truth: extrinsics and points (F, 21, 3), metres.

    Raises:
        FileFormatError: if the file is not such a sequence, is damaged, or holds more than plain data.
        ObservationError: if the session cannot be used for a calibration.
        FileNotFoundError: if there is no such file.

    Example:
        >>> import pathlib, pickle, tempfile
        >>> import numpy as np
        >>> from torchstickcal.io import read_sports_stick_syn
        >>> cameras, frames = 3, 4
        >>> data = {
        ...     "stick_length": 1.2,
        ...     "K": [[1600, 0, 600], [0, 1600, 600], [0, 0, 1]],
        ...     "cameras": [{"name": f"Camera_{number}"} for number in range(cameras)],
        ...     "Rs_gt": np.tile(np.eye(3), (cameras, 1, 1)),
        ...     "ts_gt": np.zeros((cameras, 3, 1)),
        ...     "pose_3d_gt": np.zeros((frames, 19, 3)),
        ...     "stick_3d_gt": np.zeros((frames, 2, 3)),
        ...     "all_pose_projections_2d": np.ones((cameras, frames, 19, 2)),
        ...     "all_projection_masks": np.ones((cameras, frames, 19), dtype=bool),
        ...     "all_observed_points_2d": np.ones((cameras, frames, 2, 2)),
        ... }
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = pathlib.Path(folder, "sequence.pkl")
        ...     _ = path.write_bytes(pickle.dumps(data))
        ...     observations, truth = read_sports_stick_syn(path)
        >>> observations.keypoints.shape, observations.sticks[0].length_m, truth.points.shape
        (torch.Size([3, 4, 21, 2]), 1.2, torch.Size([4, 21, 3]))
    """
    data = safe_pickle.load(path)
    with reading(path, _DESCRIPTION):
        observations, truth = _observations(data), _truth(data)
        session_of(observations, truth)
        return observations, truth


def _observations(data: dict[str, Any]) -> Observations:
    joints, seen = np.array(data["all_pose_projections_2d"], float), np.array(data["all_projection_masks"], bool)
    ends = np.array(data["all_observed_points_2d"], float)
    joints[~seen] = np.nan
    ends[(ends == 0).all(-1)] = np.nan
    first = joints.shape[2]
    matrix = np.array(data["K"], float)
    return Observations(
        np.concatenate([joints, ends], axis=2),
        matrix,
        Stick(first, first + 1, float(data["stick_length"])),
        image_size=2 * matrix[:2, 2],
        point_names=[*_joint_names(first), "stick_start", "stick_end"],
        camera_names=[str(camera["name"]) for camera in data["cameras"]],
    )


def _joint_names(count: int) -> tuple[str, ...]:
    if count == len(SPORTS_STICK_SYN_JOINTS):
        return SPORTS_STICK_SYN_JOINTS
    return tuple(f"joint_{number}" for number in range(count))


def _truth(data: dict[str, Any]) -> Truth:
    return Truth(
        torch.from_numpy(np.array(data["Rs_gt"], float)),
        torch.from_numpy(np.array(data["ts_gt"], float)).flatten(1),
        torch.from_numpy(np.concatenate([np.array(data["pose_3d_gt"], float), np.array(data["stick_3d_gt"], float)], axis=1)),
    )
