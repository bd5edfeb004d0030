"""Caliscope: its whole extrinsic calibration, with the stick as its distance constraint.

``calibrate_extrinsics`` as its application calls it: bootstrap, adjustment, robust refinement, filter, adjustment. Intrinsics
are held fixed; with ``CALISCOPE_REFINE_INTRINSICS=1`` in the environment it may estimate them, as it does by default.
``CALISCOPE_FILTER_PERCENTILE`` replaces the 2.5 % of the keypoints, those with the largest errors, that its filter removes.
"""

from __future__ import annotations

import os
import time

import numpy as np
import pandas as pd
from caliscope.cameras.camera_array import CameraArray, CameraData
from caliscope.core.calibrate_extrinsics import calibrate_extrinsics
from caliscope.core.constraints import ConstraintSet, DistanceConstraint
from caliscope.core.point_data import ImagePoints
from sessions import Found, NotCalibratedError, Session, main

STICK_SIGMA_M = 0.001
REFINE_INTRINSICS = os.environ.get("CALISCOPE_REFINE_INTRINSICS") == "1"
FILTER_PERCENTILE = float(os.environ.get("CALISCOPE_FILTER_PERCENTILE", "2.5"))


def calibrate(session: Session) -> Found:
    """Poses of all cameras.

    Raises:
        NotCalibratedError: if a camera is not placed.
    """
    stick = DistanceConstraint(0, session.stick[0], 0, session.stick[1], session.stick_length_m, STICK_SIGMA_M)
    points, cameras = _image_points(session), _cameras(session)
    began = time.perf_counter()
    run = calibrate_extrinsics(
        points,
        cameras,
        ConstraintSet((stick,), frozenset()),
        refine_intrinsics=REFINE_INTRINSICS,
        filter_percentile=FILTER_PERCENTILE,
    )
    seconds = time.perf_counter() - began
    placed = run.capture_volume.camera_array.posed_cameras
    if len(placed) < len(session.keypoints):
        raise NotCalibratedError(f"{len(placed)} of {len(session.keypoints)} cameras placed")
    found = [placed[index] for index in range(len(placed))]
    rotations = np.stack([np.asarray(camera.rotation, dtype=float) for camera in found])
    translations = np.stack([np.asarray(camera.translation, dtype=float).ravel() for camera in found])
    return Found(rotations, translations, seconds, "intrinsics not refined" if run.intrinsic_refinement_gated else "done")


def _image_points(session: Session) -> ImagePoints:
    camera, frame, point = np.nonzero(session.visible)
    pixels = session.keypoints[camera, frame, point]
    table = {"sync_index": frame, "cam_id": camera, "object_id": 0, "keypoint_id": point}
    table |= {"img_loc_x": pixels[:, 0], "img_loc_y": pixels[:, 1]}
    table |= {"obj_loc_x": np.nan, "obj_loc_y": np.nan, "obj_loc_z": np.nan}
    return ImagePoints(pd.DataFrame(table | {"frame_index": frame, "frame_time": frame / session.fps}))


def _cameras(session: Session) -> CameraArray:
    described = zip(session.sizes, session.matrices, session.distortion, strict=True)
    return CameraArray(
        {
            index: CameraData(cam_id=index, size=(int(width), int(height)), matrix=matrix.copy(), distortions=lens.copy())
            for index, ((width, height), matrix, lens) in enumerate(described)
        }
    )


if __name__ == "__main__":
    main(calibrate, __doc__)
