"""aniposelib-pytorch: its recipe for calibration from keypoints without a board, scaled by the stick.

``aniposelib.init.calibrate_from_points`` as in its README ("Keypoint self-calibration"): structure from motion, robust
adjustment of the extrinsics, then the scale of ``aniposelib.scale.from_lengths``. The scale needs stick ends on which three
views agree. If there are too few of them, it is computed from two views. The quality report is made afterwards, and its time is
not included.

Intrinsics are held fixed, as in the recipe. ``ANIPOSE_REFINE`` in the environment lists those that the adjustment estimates for
each camera at the end: ``fx,fy,cx,cy,k1,k2`` is the default of its adjustment outside the recipe, ``f`` is one focal length.

The cameras are assumed to be synchronised. With ``ANIPOSE_CLOCKS=offsets``, ``aniposelib.stba.SpatiotemporalBA`` continues from
the result with its default options: points on splines, a time offset of each camera. With ``offsets,readout`` it also estimates
the read-out time of the sensors. The median length of the stick on the splines then gives the scale, and no report is made.
"""

from __future__ import annotations

import os
import time

import numpy as np
from aniposelib import CameraGroup, quality, scale
from aniposelib.init import calibrate_from_points
from aniposelib.params import ParamSpec
from aniposelib.stba import SpatiotemporalBA, TimedObservations
from sessions import Array, Found, NotCalibratedError, Session, main, stick_scale

REFINE = tuple(filter(None, os.environ.get("ANIPOSE_REFINE", "").split(",")))
CLOCKS = os.environ.get("ANIPOSE_CLOCKS", "").split(",")


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
    adjustment = {"only_extrinsics": not REFINE, "spec": ParamSpec(intrinsics=REFINE, n_dist=0)}
    group, _ = calibrate_from_points(keypoints, names, session.sizes, lenses, ba_kwargs=adjustment, report=False, rng=0)
    if len(group.cameras) < len(names):
        raise NotCalibratedError(f"{len(group.cameras)} of {len(names)} cameras placed")
    found = scale.from_lengths(group, keypoints, [session.stick], [session.stick_length_m])
    if not found.accepted:
        found = scale.from_lengths(group, keypoints, [session.stick], [session.stick_length_m], min_inliers=2)
    found.apply(group)
    if "offsets" in CLOCKS:
        group = _with_clocks(session, group, keypoints)
    seconds = time.perf_counter() - began
    poses = np.stack([camera.get_extrinsics_mat().detach().numpy() for camera in group.cameras])
    failures = [] if "offsets" in CLOCKS else quality.report(group, keypoints).failures()
    return Found(poses[:, :3, :3], poses[:, :3, 3], seconds, "; ".join(failure[:60] for failure in failures) or "done")


def _with_clocks(session: Session, group: CameraGroup, keypoints: Array) -> CameraGroup:
    """The cameras, adjusted together with their clocks and scaled to metres."""
    times = np.arange(keypoints.shape[1]) / session.fps
    observations = TimedObservations.from_dense(keypoints, times)
    found = SpatiotemporalBA(group, observations, rolling_shutter="readout" in CLOCKS).fit()
    points = np.stack([found.trajectories.evaluate(times, point) for point in range(keypoints.shape[2])], axis=1)
    scale.rescale(found.group, stick_scale(session, points))
    return found.group


if __name__ == "__main__":
    main(calibrate, __doc__)
