"""Relative poses of camera pairs from essential matrices."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from torchstickcal.pipeline.initialise.views import Array, Views, spread

_CONFIDENCE = 0.9999
_MAX_COUNTED = 1000
_MIN_POINTS = 8


@dataclass(frozen=True)
class RelativePose:
    """One of the four poses an essential matrix stands for: ``x_second = R x_first + s t`` with |t| = 1, s unknown."""

    rotation: Array
    translation: Array
    in_front: int
    """inliers looked at that lie in front of both cameras"""

    def inverse(self) -> RelativePose:
        """The pose of the first camera relative to the second."""
        return RelativePose(self.rotation.T, -self.rotation.T @ self.translation, self.in_front)


@dataclass(frozen=True)
class Pair:
    """Two cameras that see common points."""

    common: int
    """points both cameras see, over all frames"""
    inliers: int
    """those that agree with the essential matrix and lie in front of both cameras, as those of a wrong one need not"""
    poses: tuple[RelativePose, ...]
    """the four poses, the one with most points in front of both cameras first"""


def relate(views: Views, first: int, second: int, *, max_points: int, threshold_px: float) -> Pair:
    """Relate two cameras by RANSAC over essential matrices.

    Args:
        views: what the cameras see.
        first: one camera.
        second: the other.
        max_points: points that RANSAC looks at, spread evenly over the session; a thousand count for the inliers.
        threshold_px: distance from the epipolar line up to which a point is an inlier.

    Returns:
        The pair; without poses where no essential matrix fits.
    """
    columns = np.flatnonzero(views.visible[first] & views.visible[second])
    (a, b), seen = views.rays([first, second], columns[spread(len(columns), _MAX_COUNTED)])
    a, b = a[:, seen.all(0)], b[:, seen.all(0)]
    threshold = threshold_px / float(np.sqrt(views.focal_px[first] * views.focal_px[second]))
    sample = spread(a.shape[1], max_points)
    essential = _essential_matrix(a[:, sample], b[:, sample], threshold)
    if essential is None:
        return Pair(len(columns), 0, ())
    inliers = np.flatnonzero(_sampson_distance(essential, a, b) < threshold)
    sample = inliers[spread(len(inliers), max_points)]
    poses = _decompose(essential, a[:, sample], b[:, sample])
    in_front = poses[0].in_front / max(1, len(sample))
    return Pair(len(columns), round(len(columns) * in_front * len(inliers) / a.shape[1]), poses)


def two_view_depths(rotation: Array, translation: Array, a: Array, b: Array) -> tuple[Array, Array]:
    """Depths (N,) in both cameras at which the rays (2, N) of two views come closest."""
    from_first = rotation @ _homogeneous(a)
    from_second = _homogeneous(b)
    aa, bb = (from_first**2).sum(0), (from_second**2).sum(0)
    ab = (from_first * from_second).sum(0)
    at, bt = translation @ from_first, translation @ from_second
    determinant = np.maximum(aa * bb - ab**2, 1e-15)
    return (ab * bt - bb * at) / determinant, (aa * bt - ab * at) / determinant


def _essential_matrix(a: Array, b: Array, threshold: float) -> Array | None:
    if a.shape[1] < _MIN_POINTS:
        return None
    essential, _ = cv2.findEssentialMat(
        np.ascontiguousarray(a.T), np.ascontiguousarray(b.T), np.eye(3), cv2.USAC_ACCURATE, _CONFIDENCE, threshold
    )
    return None if essential is None or essential.shape[0] < 3 else np.asarray(essential[:3], dtype=np.float64)


def _sampson_distance(essential: Array, a: Array, b: Array) -> Array:
    """First-order distance of point pairs from the epipolar constraint, in normalised coordinates."""
    lines_b, lines_a = essential @ _homogeneous(a), essential.T @ _homogeneous(b)
    algebraic = (_homogeneous(b) * lines_b).sum(0)
    return np.abs(algebraic) / np.sqrt((lines_a[:2] ** 2).sum(0) + (lines_b[:2] ** 2).sum(0) + 1e-300)


def _decompose(essential: Array, a: Array, b: Array) -> tuple[RelativePose, ...]:
    """The four poses of an essential matrix, by falling number of points in front of both cameras."""
    rotation_1, rotation_2, direction = (np.asarray(v, dtype=np.float64) for v in cv2.decomposeEssentialMat(essential))
    poses: list[RelativePose] = []
    for rotation in (rotation_1, rotation_2):
        depth_a, depth_b = two_view_depths(rotation, direction[:, 0], a, b)
        for sign in (1.0, -1.0):
            in_front = int(((sign * depth_a > 0) & (sign * depth_b > 0)).sum())
            poses.append(RelativePose(rotation, sign * direction[:, 0], in_front))
    return tuple(sorted(poses, key=lambda pose: -pose.in_front))


def _homogeneous(rays: Array) -> Array:
    return np.concatenate([rays, np.ones_like(rays[:1])])
