"""Relative poses of pairs of cameras from essential matrices."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from torchstickcal.pipeline.initialise.views import Array, Views, spread

_RANSAC_CONFIDENCE = 0.9999
_MAX_ROUNDS = 1000
_PATIENT_ROUNDS = 20_000
"""Rounds of RANSAC, and rounds where few points are inliers: five that are have then to be drawn together."""
_MANY_INLIERS, _FEW_INLIERS = 0.8, 0.5
"""Shares of inliers below which RANSAC is run again with the steady points, and with more points and rounds."""
_MAX_COUNTED_POINTS = 1000
"""Number of points among which the inliers are counted."""
_MIN_POINTS = 8
_SUFFICIENT_PARALLAX_RAD = 0.1


@dataclass(frozen=True)
class RelativePose:
    """One of the four poses that an essential matrix allows: ``x_second = R x_first + s t`` with |t| = 1 and unknown s."""

    rotation: Array
    translation: Array
    in_front: int
    """number of the sampled inliers that lie in front of both cameras"""

    def inverse(self) -> RelativePose:
        """The pose of the first camera relative to the second."""
        return RelativePose(self.rotation.T, -self.rotation.T @ self.translation, self.in_front)


@dataclass(frozen=True)
class Pair:
    """Two cameras with common points."""

    common: int
    """number of points that both cameras see, over all frames"""
    inliers: int
    """estimated number of common points that fit the essential matrix and lie in front of both cameras; with a wrong matrix,
    many points lie behind a camera"""
    parallax_rad: float
    """median angle between the two rays to an inlier; without parallax, the direction of the baseline is not determined"""
    poses: tuple[RelativePose, ...]
    """the four poses, ordered by decreasing number of points in front of both cameras; empty if no essential matrix fits"""

    @property
    def strength(self) -> float:
        """Number of inliers that the pair is worth as a part of the rig: fewer where it has little parallax."""
        return self.inliers * min(1.0, self.parallax_rad / _SUFFICIENT_PARALLAX_RAD)


def relate(views: Views, first: int, second: int, *, max_points: int, threshold_px: float) -> Pair:
    """Estimate the relative poses of two cameras by RANSAC with essential matrices.

    Args:
        views: the keypoints.
        first: index of one camera.
        second: index of the other camera.
        max_points: number of points for RANSAC, evenly spaced in the session. The inliers are counted among 1000 points.
        threshold_px: largest distance of an inlier from its epipolar line.
    """
    columns = np.flatnonzero(views.visible[first] & views.visible[second])
    counted = columns[spread(len(columns), _MAX_COUNTED_POINTS)]
    (a, b), seen = views.rays([first, second], counted)
    counted, a, b = counted[seen.all(0)], a[:, seen.all(0)], b[:, seen.all(0)]
    threshold = threshold_px / float(np.sqrt(views.focal_px[first] * views.focal_px[second]))
    sample = spread(a.shape[1], max_points)
    essential, inliers = _fitted(a, b, sample, threshold, _MAX_ROUNDS)

    def agreement(fitted: tuple[Array | None, NDArray[np.intp]]) -> float:
        return 0.0 if fitted[0] is None else _agreement(fitted[0], a, b, threshold)

    if len(inliers) < _MANY_INLIERS * a.shape[1]:
        steady = np.flatnonzero(views.steady[first, counted] & views.steady[second, counted])
        essential, inliers = max((essential, inliers), _fitted(a, b, steady, threshold, _MAX_ROUNDS), key=agreement)
    if len(inliers) < _FEW_INLIERS * a.shape[1]:
        every = np.arange(a.shape[1])
        essential, inliers = max((essential, inliers), _fitted(a, b, every, threshold, _PATIENT_ROUNDS), key=agreement)
    if essential is None:
        return Pair(len(columns), 0, 0.0, ())
    sampled_inliers = inliers[spread(len(inliers), max_points)]
    poses = _decompose(essential, a[:, sampled_inliers], b[:, sampled_inliers])
    share_in_front = poses[0].in_front / max(1, len(sampled_inliers))
    fitting = round(len(columns) * share_in_front * len(inliers) / a.shape[1])
    return Pair(len(columns), fitting, _parallax(poses[0].rotation, a[:, sampled_inliers], b[:, sampled_inliers]), poses)


def two_view_depths(rotation: Array, translation: Array, a: Array, b: Array) -> tuple[Array, Array]:
    """Depths (N,) in the first and in the second camera at which the rays (2, N) a and b are closest to each other."""
    from_first = rotation @ _homogeneous(a)
    from_second = _homogeneous(b)
    aa, bb = (from_first**2).sum(0), (from_second**2).sum(0)
    ab = (from_first * from_second).sum(0)
    at, bt = translation @ from_first, translation @ from_second
    determinant = np.maximum(aa * bb - ab**2, 1e-15)
    return (ab * bt - bb * at) / determinant, (aa * bt - ab * at) / determinant


def _fitted(
    a: Array, b: Array, sample: NDArray[np.intp], threshold: float, rounds: int
) -> tuple[Array | None, NDArray[np.intp]]:
    """The essential matrix of a sample of the points, and the indices of its inliers among all; None and none if none fits."""
    if len(sample) < _MIN_POINTS:
        return None, np.zeros(0, np.intp)
    first, second = (np.ascontiguousarray(rays[:, sample].T) for rays in (a, b))
    found, _ = cv2.findEssentialMat(first, second, np.eye(3), cv2.USAC_ACCURATE, _RANSAC_CONFIDENCE, threshold, rounds)
    if found is None or found.shape[0] < 3:
        return None, np.zeros(0, np.intp)
    essential = np.asarray(found[:3], dtype=np.float64)
    return essential, np.flatnonzero(_sampson_distance(essential, a, b) < threshold)


def _agreement(essential: Array, a: Array, b: Array, threshold: float) -> float:
    """How many pairs of points fit an essential matrix, each counted the less the larger its distance is (MSAC)."""
    return float((1 - (_sampson_distance(essential, a, b) / threshold) ** 2).clip(0).sum())


def _sampson_distance(essential: Array, a: Array, b: Array) -> Array:
    """Sampson distance of each pair of points from the epipolar constraint, in normalised image coordinates."""
    lines_b, lines_a = essential @ _homogeneous(a), essential.T @ _homogeneous(b)
    algebraic = (_homogeneous(b) * lines_b).sum(0)
    return np.abs(algebraic) / np.sqrt((lines_a[:2] ** 2).sum(0) + (lines_b[:2] ** 2).sum(0) + 1e-300)


def _decompose(essential: Array, a: Array, b: Array) -> tuple[RelativePose, ...]:
    """The four poses of an essential matrix, ordered by decreasing number of points in front of both cameras."""
    rotation_1, rotation_2, direction = (np.asarray(v, dtype=np.float64) for v in cv2.decomposeEssentialMat(essential))
    poses: list[RelativePose] = []
    for rotation in (rotation_1, rotation_2):
        depth_a, depth_b = two_view_depths(rotation, direction[:, 0], a, b)
        for sign in (1.0, -1.0):
            in_front = int(((sign * depth_a > 0) & (sign * depth_b > 0)).sum())
            poses.append(RelativePose(rotation, sign * direction[:, 0], in_front))
    return tuple(sorted(poses, key=lambda pose: -pose.in_front))


def _parallax(rotation: Array, a: Array, b: Array) -> float:
    """Median angle between the rays to the same points, radians."""
    if not a.shape[1]:
        return 0.0
    (x, y, z), (u, v) = rotation @ _homogeneous(a), b
    sine = np.hypot(np.hypot(y - z * v, z * u - x), x * v - y * u)
    return float(np.median(np.arctan2(sine, x * u + y * v + z)))


def _homogeneous(rays: Array) -> Array:
    return np.concatenate([rays, np.ones_like(rays[:1])])
