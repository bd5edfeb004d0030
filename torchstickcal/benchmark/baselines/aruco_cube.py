"""One static ArUco cube in the middle of the scene, as ArucoCalib and CALICO use it (Tabb and Medeiros, 2019)."""

from __future__ import annotations

import cv2
import numpy as np
import torch

from torchstickcal.benchmark.baselines.base import Array, Estimate, Inputs, required
from torchstickcal.simulate import CubeViews

_MIN_CORNERS = 4
_FLAT = 1e-6
_REFINEMENT = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 100, 1e-14)


def aruco_cube(inputs: Inputs) -> Estimate:
    """Every camera's pose from the corners of the cube that it sees.

    A first pose by perspective-n-point, then the least reprojection error. All cameras look at the same cube of known
    geometry and its frame is the world's, so their joint adjustment falls apart into one refinement per camera.

    Args:
        inputs: needs ``cube``.

    Returns:
        The estimate; a camera that sees fewer than four corners has a pose of NaN and is named by the status.

    Raises:
        MissingInputError: if the cube is not given.
    """
    cube: CubeViews = required(inputs, "cube")
    observations = inputs.observations
    rays = observations.cameras.undistort(torch.as_tensor(cube.keypoints, dtype=torch.float64)).numpy()
    rotations, translations = np.full((len(rays), 3, 3), np.nan), np.full((len(rays), 3), np.nan)
    failures: list[str] = []
    for camera, image in enumerate(rays):
        seen = np.isfinite(image).all(1)
        if seen.sum() < _MIN_CORNERS:
            failures.append(f"{observations.camera_label(camera)} sees {seen.sum()} corners of the cube, fewer than 4")
        else:
            rotations[camera], translations[camera] = _pose(cube.corners_m[seen], image[seen])
    relative = rotations @ rotations[0].T
    shifts = translations - relative @ translations[0]
    return Estimate(torch.from_numpy(relative), torch.from_numpy(shifts), "; ".join(failures) or "converged")


def _pose(corners: Array, image: Array) -> tuple[Array, Array]:
    """Rotation and translation, cube to camera; a single face allows two poses, of which the better one is taken."""
    spread = np.linalg.svd(corners - corners.mean(0), compute_uv=False)
    method = cv2.SOLVEPNP_IPPE if spread[2] < _FLAT * spread[0] else cv2.SOLVEPNP_SQPNP
    corners, image, camera = np.ascontiguousarray(corners), np.ascontiguousarray(image), np.eye(3)
    _, turns, shifts, _ = cv2.solvePnPGeneric(corners, image, camera, None, flags=method)
    refined = [
        cv2.solvePnPRefineLM(corners, image, camera, None, *pose, _REFINEMENT) for pose in zip(turns, shifts, strict=True)
    ]
    errors = [np.square(cv2.projectPoints(corners, *pose, camera, None)[0][:, 0] - image).sum() for pose in refined]
    turn, shift = refined[int(np.argmin(errors))]
    return np.asarray(cv2.Rodrigues(turn)[0], np.float64), np.asarray(shift[:, 0], np.float64)
