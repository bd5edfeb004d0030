"""Where one camera is, by known points: from nothing or from an earlier pose, robustly."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor

from torchstickcal.geometry import se3
from torchstickcal.geometry.cameras import Intrinsics
from torchstickcal.geometry.singular import solve_information
from torchstickcal.geometry.vectors import lengths
from torchstickcal.losses import ReprojectionLoss
from torchstickcal.losses.robust import GemanMcClure
from torchstickcal.solvers.elimination.cross_blocks import cross_rows

_MOST_POINTS, _LEAST_POINTS = 400, 12
_ROUNDS, _REACH_SIGMAS = 400, 8.0
_STEPS = 12
_KERNEL_SIGMAS = 6.0
AGREEING_SIGMAS = 4.5
LEAST_REACH = 0.006
"""Distance in the image, in noise and at least in focal lengths, within which a keypoint agrees with a point that has an error
of its own."""


class Resection(NamedTuple):
    """A camera placed by known points."""

    rotation: Tensor
    """(3, 3), world to camera"""
    translation: Tensor
    """(3,), metres"""
    agreeing: Tensor
    """(n,), True where a keypoint agrees with its point"""
    information: Tensor
    """(6, 6), about the tangent of the pose"""
    distance_sigmas: float
    """median distance of the keypoints from their points, in noise"""

    @property
    def share(self) -> float:
        """Share of the keypoints that agree."""
        return float(self.agreeing.double().mean()) if len(self.agreeing) else 0.0


def resected(
    points: Tensor, pixels: Tensor, sigma_px: Tensor, camera: Intrinsics, start: tuple[Tensor, Tensor] | None = None
) -> Resection | None:
    """Place a camera by known points; None where no place fits.

    Args:
        points: (3, n), metres.
        pixels: (2, n).
        sigma_px: (n,), noise of the keypoints along an axis, pixels.
        camera: intrinsics of this one camera.
        start: rotation (3, 3) and translation (3,) to start from; None to search.
    """
    if points.shape[1] < _LEAST_POINTS:
        return None
    pose = start if start is not None else _searched(points, pixels, sigma_px, camera)
    if pose is None:
        return None
    rotation, translation = pose
    batch = camera.batched()
    information = 1 / sigma_px.square()
    loss = ReprojectionLoss(kernel=GemanMcClure(_KERNEL_SIGMAS))
    moments = torch.eye(6).to(points)
    for _ in range(_STEPS):
        in_camera = se3.moved(rotation[None, None], translation[None, None], points[None])
        weights = information * (in_camera[0, 0, 2] > 0)
        terms = loss.linearise(in_camera, rotation[None, None], pixels[None, None], weights[None, None], batch)
        gradient, rows = terms.gradient[0, 0], cross_rows(terms.hessian, points[None])[0, 0]
        pull = torch.cat([gradient, torch.linalg.cross(points, gradient, dim=0)]).sum(-1)
        turned = torch.linalg.cross(points.expand(6, 3, -1), rows, dim=1)
        moments = torch.cat([rows, turned], dim=1).sum(-1)
        step = -solve_information(moments, pull)
        rotation, translation = se3.retract(rotation, translation, step)
        if float(pull @ -step) < 1e-6:
            break
    if not bool(rotation.isfinite().all() and translation.isfinite().all()):
        return None
    return _compared(points, pixels, sigma_px, camera, (rotation, translation), moments)


def at_later_frames(points: Tensor, later: int) -> Tensor:
    """Points (3, F, P) some frames later, which may be fewer than 0; NaN where there is no such frame."""
    moved = points.roll(-later, 1)
    if later:
        moved[:, -later if later > 0 else 0 : None if later > 0 else -later] = torch.nan
    return moved


def placed_at(
    points: Tensor, pixels: Tensor, sigma_px: Tensor, camera: Intrinsics, pose: tuple[Tensor, Tensor]
) -> Resection | None:
    """A camera where it is, with the points that agree; None where there are too few. The arguments are those of
    :func:`resected`."""
    if points.shape[1] < _LEAST_POINTS:
        return None
    return _compared(points, pixels, sigma_px, camera, pose, torch.eye(6).to(points))


def _compared(
    points: Tensor, pixels: Tensor, sigma_px: Tensor, camera: Intrinsics, pose: tuple[Tensor, Tensor], moments: Tensor
) -> Resection:
    """A camera at a place, and which keypoints agree with it."""
    rotation, translation = pose
    in_camera = rotation @ points + translation[:, None]
    reach = (AGREEING_SIGMAS * sigma_px).clamp_min(LEAST_REACH * float(camera.focal_px.mean()))
    distance = lengths(camera.project(in_camera.mT[None])[0].mT - pixels)
    agreeing = (distance < reach) & (in_camera[2] > 0)
    return Resection(rotation, translation, agreeing, moments, float((distance / sigma_px).median()))


def _searched(points: Tensor, pixels: Tensor, sigma_px: Tensor, camera: Intrinsics) -> tuple[Tensor, Tensor] | None:
    """A pose by random samples of the keypoints (perspective-n-point, RANSAC)."""
    rays = camera.undistort(pixels.mT[None])[0]
    usable = rays.isfinite().all(-1).nonzero().flatten()
    chosen = usable[torch.linspace(0, len(usable) - 1, min(_MOST_POINTS, len(usable))).long()]
    if len(chosen) < _LEAST_POINTS:
        return None
    reach = _REACH_SIGMAS * float(sigma_px.median() / camera.focal_px.mean())
    known, seen = (np.ascontiguousarray(values.cpu().numpy()) for values in (points[:, chosen].mT, rays[chosen]))
    try:
        found, turn, shift, _ = cv2.solvePnPRansac(
            known, seen, np.eye(3), None,
            iterationsCount=_ROUNDS, reprojectionError=reach, confidence=0.9999, flags=cv2.SOLVEPNP_SQPNP,
        )  # fmt: skip
    except cv2.error:  # points in one place or on one line
        return None
    if not found or not (np.isfinite(turn).all() and np.isfinite(shift).all()):
        return None
    rotation, translation = (np.asarray(part, dtype=np.float64) for part in (cv2.Rodrigues(turn)[0], shift[:, 0]))
    return torch.from_numpy(rotation).to(points), torch.from_numpy(translation).to(points)
