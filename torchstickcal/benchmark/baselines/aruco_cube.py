"""A static cube with ArUco markers in the centre of the scene, as ArucoCalib and CALICO use it (Tabb and Medeiros, 2019)."""

from __future__ import annotations

import cv2
import numpy as np
import torch

from torchstickcal.benchmark.baselines.base import Array, Estimate, Inputs, Listing, PublishedErrors, baseline, required
from torchstickcal.simulate import CubeViews

_MIN_CORNERS = 4
_PLANAR = 1e-6
_REFINEMENT = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 100, 1e-14)
_CUBE_SIZE = (
    "The paper does not give the size of its cube; here its edge is 0.4 m. With 0.6, 1.0 and 1.2 m the errors are 0.229, 0.116 "
    "and 0.089 degrees, and 10.5, 5.3 and 4.1 mm."
)


@baseline(
    "aruco_cube",
    Listing("ArUco cube", {"sota": PublishedErrors(0.087, 0.007)}, (_CUBE_SIZE,), position=20),
    needs=("cube",),
)
def aruco_cube(inputs: Inputs) -> Estimate:
    """Pose of each camera from the corners of the cube that it sees.

    Perspective-n-point, then minimisation of the reprojection error. The geometry of the cube is known and defines the world
    frame, so each camera can be refined on its own.

    Args:
        inputs: needs ``cube``.

    Returns:
        The estimate. A camera that sees fewer than four corners has a pose of NaN, and the status names it.
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
    """Rotation (3, 3) and translation (3,) from cube to camera, of corners (K, 3) and their normalised image points (K, 2).

    The corners of a single face allow two poses; the one with the smaller reprojection error is returned.
    """
    spread = np.linalg.svd(corners - corners.mean(0), compute_uv=False)
    method = cv2.SOLVEPNP_IPPE if spread[2] < _PLANAR * spread[0] else cv2.SOLVEPNP_SQPNP
    corners, image, camera = np.ascontiguousarray(corners), np.ascontiguousarray(image), np.eye(3)
    _, turns, shifts, _ = cv2.solvePnPGeneric(corners, image, camera, None, flags=method)
    refined = [
        cv2.solvePnPRefineLM(corners, image, camera, None, *pose, _REFINEMENT) for pose in zip(turns, shifts, strict=True)
    ]
    errors = [np.square(cv2.projectPoints(corners, *pose, camera, None)[0][:, 0] - image).sum() for pose in refined]
    turn, shift = refined[int(np.argmin(errors))]
    return np.asarray(cv2.Rodrigues(turn)[0], np.float64), np.asarray(shift[:, 0], np.float64)
