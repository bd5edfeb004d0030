"""aniposelib-pytorch: its recipe for calibration from keypoints without a board, scaled by the stick.

``aniposelib.init.calibrate_from_points`` as its README gives it ("Keypoint self-calibration"): structure from motion, robust
adjustment of the extrinsics, then the scale of ``aniposelib.scale.from_lengths``. That wants three views of a stick end that
agree; where too few have them it is asked again with two.
"""

from __future__ import annotations

import time

import numpy as np
from aniposelib import scale
from aniposelib.init import calibrate_from_points
from sessions import Found, NotCalibratedError, Session, main


def calibrate(session: Session) -> Found:
    """Poses of all cameras.

    Raises:
        NotCalibratedError: if a camera is not placed.
        ValueError: if no scale is accepted.
    """
    names = [f"{index}" for index in range(len(session.keypoints))]
    keypoints = np.where(session.visible[..., None], session.keypoints, np.nan)
    lenses = {
        name: {"matrix": matrix, "dist": lens}
        for name, matrix, lens in zip(names, session.matrices, session.distortion, strict=True)
    }
    began = time.perf_counter()
    group, _ = calibrate_from_points(keypoints, names, session.sizes, lenses, report=False, rng=0)
    if len(group.cameras) < len(names):
        raise NotCalibratedError(f"{len(group.cameras)} of {len(names)} cameras placed")
    found = scale.from_lengths(group, keypoints, [session.stick], [session.stick_length_m])
    if not found.accepted:
        found = scale.from_lengths(group, keypoints, [session.stick], [session.stick_length_m], min_inliers=2)
    found.apply(group)
    seconds = time.perf_counter() - began
    poses = np.stack([camera.get_extrinsics_mat().detach().numpy() for camera in group.cameras])
    return Found(poses[:, :3, :3], poses[:, :3, 3], seconds)


if __name__ == "__main__":
    main(calibrate, __doc__)
