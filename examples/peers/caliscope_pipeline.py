"""Calibrate a session with Caliscope's distance constraint, for comparison: time and camera error.

In an environment of its own: ``pip install caliscope``, then

    torchstickcal demo --out demo
    python examples/peers/caliscope_pipeline.py demo/session.npz

The session is an .npz with truth, as torchstickcal writes it. The second of two runs is timed.
"""

from __future__ import annotations

import logging
import sys
import time

import numpy as np
import pandas as pd
from caliscope.cameras.camera_array import CameraArray, CameraData
from caliscope.core.calibrate_extrinsics import calibrate_extrinsics
from caliscope.core.constraints import ConstraintSet, DistanceConstraint
from caliscope.core.point_data import ImagePoints

STICK_SIGMA_M = 0.001


def main() -> None:
    """Print the seconds and the mean distance of camera centres after a rigid alignment."""
    logging.disable(logging.CRITICAL)
    session = np.load(sys.argv[1])
    keypoints, fps = session["keypoints"], float(session["fps"])
    camera, frame, point = np.nonzero(np.isfinite(keypoints).all(-1))
    pixels = keypoints[camera, frame, point]
    table = {"sync_index": frame, "cam_id": camera, "object_id": 0, "keypoint_id": point}
    table |= {
        "img_loc_x": pixels[:, 0],
        "img_loc_y": pixels[:, 1],
        "obj_loc_x": np.nan,
        "obj_loc_y": np.nan,
        "obj_loc_z": np.nan,
    }
    points = ImagePoints(pd.DataFrame(table | {"frame_index": frame, "frame_time": frame / fps}))
    matrices = np.broadcast_to(session["intrinsics"], (len(keypoints), 3, 3))
    sizes = np.broadcast_to(session["image_size"], (len(keypoints), 2)).astype(int)
    cameras = CameraArray(
        {
            index: CameraData(
                cam_id=index,
                size=(int(sizes[index, 0]), int(sizes[index, 1])),
                matrix=matrices[index].copy(),
                distortions=session["distortion"][index],
            )
            for index in range(len(keypoints))
        }
    )
    (start,), (end,), (length,) = session["stick_start"], session["stick_end"], session["stick_length_m"]
    stick = DistanceConstraint(0, int(start), 0, int(end), float(length), STICK_SIGMA_M)
    for _ in range(2):
        began = time.perf_counter()
        run = calibrate_extrinsics(points, cameras, ConstraintSet((stick,), frozenset()), refine_intrinsics=False)
        seconds = time.perf_counter() - began
    found = [run.capture_volume.camera_array.cameras[index] for index in range(len(keypoints))]
    rotations = np.stack([np.asarray(camera.rotation) for camera in found])
    translations = np.stack([np.asarray(camera.translation).ravel() for camera in found])
    errors = centre_errors(centres(rotations, translations), centres(session["rotation"], session["translation"]))
    print(f"{seconds:.2f} s, camera centres off by {1000 * errors.mean():.2f} mm")


def centres(rotations: np.ndarray, translations: np.ndarray) -> np.ndarray:
    """Camera centres of poses world to camera."""
    return -np.einsum("cji,cj->ci", rotations, translations)


def centre_errors(estimated: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Distances after the rotation and translation of least squares."""
    a, b = estimated - estimated.mean(0), true - true.mean(0)
    u, _, vh = np.linalg.svd(b.T @ a)
    rotation = u @ np.diag([1, 1, np.linalg.det(u @ vh)]) @ vh
    return np.linalg.norm(a @ rotation.T - b, axis=1)


if __name__ == "__main__":
    main()
