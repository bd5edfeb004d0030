"""Regimes: the measurement errors of simulated keypoints. Noise, missing keypoints, occlusion, outliers, swapped points.

Each regime is a frozen dataclass that takes :class:`Views` and a random generator and returns new views. A session applies its
regimes one after another.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from torchstickcal.simulate.rigs import CameraRig
from torchstickcal.simulate.skeleton import JOINT_INDEX, JOINTS, PARENTS

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

LIMB_RADII_M = {"spine": 0.12, "neck": 0.13, "head": 0.06, "head_top": 0.10, "shoulder": 0.06, "elbow": 0.045, "wrist": 0.04}
LIMB_RADII_M |= {"hand": 0.04, "knee": 0.08, "shin": 0.055, "ankle": 0.05}
_MIN_DISTANCE_BEHIND_M = 0.10
_MIRRORED = [
    JOINT_INDEX[name.replace("left", "right") if name.startswith("left") else name.replace("right", "left")] for name in JOINTS
]


@dataclass(frozen=True, eq=False)
class Views:
    """The keypoints of all cameras with their true errors."""

    rig: CameraRig
    points: Array
    """(C, F, P, 3), positions of the points at the time of exposure, metres; the last two are the ends of the stick"""
    keypoints: Array
    """(C, F, P, 2), pixels; NaN where not detected"""
    inliers: Mask
    """(C, F, P), False for outliers"""
    sigma_px: Array
    """(C, F, P), standard deviation of the noise along each image axis, pixels"""
    confidence: Array | None = None
    """(C, F, P) in [0, 1]; None if the detector gives no confidence"""

    def hiding(self, hidden: Mask) -> Views:
        """A copy without the keypoints where ``hidden`` (broadcast to (C, F, P)) is true."""
        return replace(self, keypoints=np.where(hidden[..., None], np.nan, self.keypoints))

    def with_noise(self, sigma_px: Array, draws: Array) -> Views:
        """A copy with independent noise added to the keypoints.

        Args:
            sigma_px: standard deviation of each keypoint's noise, (C, F, P), pixels.
            draws: (C, F, P, 2), random numbers of variance 1.
        """
        total = np.sqrt(self.sigma_px**2 + sigma_px**2)
        return replace(self, keypoints=self.keypoints + sigma_px[..., None] * draws, sigma_px=total)


class Regime(Protocol):
    """A kind of measurement error."""

    def __call__(self, views: Views, rng: np.random.Generator) -> Views:
        """The views with this error added."""
        ...


@dataclass(frozen=True)
class GaussianNoise:
    """Independent Gaussian noise of the same standard deviation for all keypoints: the noise of the paper's data.

    Args:
        sigma_px: standard deviation along each image axis, pixels.
    """

    sigma_px: float

    def __call__(self, views: Views, rng: np.random.Generator) -> Views:
        """The views with this error added."""
        return views.with_noise(np.full_like(views.sigma_px, self.sigma_px), rng.standard_normal(views.keypoints.shape))


@dataclass(frozen=True)
class DetectorNoise:
    """Noise of a pose detector: its standard deviation differs between joints and between single keypoints.

    The standard deviation of a joint's keypoint is ``sigma_px`` times a log-normal factor of the joint times a log-normal
    factor of the keypoint, that of an end of the stick is ``stick_sigma_px`` times the factor of the keypoint. Over all
    keypoints the distribution has heavy tails. The confidence is low for keypoints of large standard deviation.

    Args:
        sigma_px: root mean square of the standard deviations of joints, pixels. stick_sigma_px: of stick ends.
        joint_spread: standard deviation of the logarithm of the joints' factors. keypoint_spread: of the keypoints' factors.
    """

    sigma_px: float = 2.5
    stick_sigma_px: float = 1.5
    joint_spread: float = 0.25
    keypoint_spread: float = 0.4

    def __call__(self, views: Views, rng: np.random.Generator) -> Views:
        """The views with this error added."""
        joints = self.sigma_px * _factors(self.joint_spread, rng.standard_normal(len(JOINTS)))
        joints *= self.sigma_px / np.sqrt((joints**2).mean())
        own = _factors(self.keypoint_spread, rng.standard_normal(views.inliers.shape))
        sigma = own * np.append(joints, [self.stick_sigma_px] * 2)
        confidence = 0.75 / own * np.exp(0.15 * rng.standard_normal(own.shape))
        noisy = views.with_noise(sigma, rng.standard_normal(views.keypoints.shape))
        return replace(noisy, confidence=np.clip(confidence, 0.05, 1.0))


@dataclass(frozen=True)
class Missing:
    """Single keypoints that are not detected, independently of each other.

    Args:
        share: of the keypoints, 0 to 1.
    """

    share: float

    def __call__(self, views: Views, rng: np.random.Generator) -> Views:
        """The views with this error added."""
        return views.hiding(rng.random(views.inliers.shape) < self.share)


@dataclass(frozen=True)
class Gaps:
    """Gaps in the tracks of single cameras: runs of missing frames with geometrically distributed lengths.

    Args:
        share: of the keypoints that are missing, 0 to 1.
        mean_frames: mean length of a gap, frames.
    """

    share: float
    mean_frames: float = 6.0

    def __call__(self, views: Views, rng: np.random.Generator) -> Views:
        """The views with this error added."""
        start = self.share / ((1 - self.share) * self.mean_frames)
        draws = rng.random(views.inliers.shape)
        missing = draws < self.share
        for frame in range(1, draws.shape[1]):
            missing[:, frame] = draws[:, frame] < np.where(missing[:, frame - 1], 1 - 1 / self.mean_frames, start)
        return views.hiding(missing)


@dataclass(frozen=True)
class DroppedFrames:
    """Frames that a camera lost: none of its keypoints is detected.

    Args:
        share: of the frames of each camera, 0 to 1.
    """

    share: float

    def __call__(self, views: Views, rng: np.random.Generator) -> Views:
        """The views with this error added."""
        return views.hiding((rng.random(views.inliers.shape[:2]) < self.share)[..., None])


@dataclass(frozen=True)
class FrameRates:
    """Cameras with a lower frame rate than the session: they record only a part of its frames.

    Args:
        shares: frame rate of each camera divided by that of the session; repeated if there are more cameras.
    """

    shares: tuple[float, ...]

    def __call__(self, views: Views, rng: np.random.Generator) -> Views:
        """The views with this error added."""
        cameras, frames = views.inliers.shape[:2]
        count = np.outer(np.resize(self.shares, cameras), np.arange(frames + 1) + 1e-9)
        return views.hiding((np.diff(np.floor(count), axis=1) == 0)[..., None])


@dataclass(frozen=True)
class SelfOcclusion:
    """Points behind the athlete's own body are not detected; limbs are capsules."""

    def __call__(self, views: Views, rng: np.random.Generator) -> Views:
        """The views with this error added."""
        hidden = [occluded(centre, points) for centre, points in zip(views.rig.centres, views.points, strict=True)]
        return views.hiding(np.stack(hidden))


@dataclass(frozen=True)
class Outliers:
    """Outliers: keypoints displaced by a uniformly distributed error.

    Args:
        share: of the keypoints, 0 to 1.
        reach_px: largest displacement along each image axis, pixels.
    """

    share: float
    reach_px: float = 150.0

    def __call__(self, views: Views, rng: np.random.Generator) -> Views:
        """The views with this error added."""
        gross = rng.random(views.inliers.shape) < self.share
        moved = views.keypoints + gross[..., None] * rng.uniform(-self.reach_px, self.reach_px, views.keypoints.shape)
        return replace(views, keypoints=moved, inliers=views.inliers & ~gross)


@dataclass(frozen=True)
class Flips:
    """Frames in which the detector of a camera confuses left and right, for all joints at once.

    Args:
        share: of the frames of each camera, 0 to 1.
    """

    share: float

    def __call__(self, views: Views, rng: np.random.Generator) -> Views:
        """The views with this error added."""
        return _swapped(views, rng.random(views.inliers.shape[:2]) < self.share, [*_MIRRORED, len(JOINTS), len(JOINTS) + 1])


@dataclass(frozen=True)
class SwappedEnds:
    """Frames in which the detector of a camera confuses the start and the end of the stick.

    Args:
        share: of the frames of each camera, 0 to 1.
    """

    share: float

    def __call__(self, views: Views, rng: np.random.Generator) -> Views:
        """The views with this error added."""
        joints = range(len(JOINTS))
        return _swapped(views, rng.random(views.inliers.shape[:2]) < self.share, [*joints, len(JOINTS) + 1, len(JOINTS)])


@dataclass(frozen=True)
class Noise:
    """Gaussian noise, outliers and missing keypoints, independently for every keypoint.

    Args:
        sigma_px: standard deviation of the noise along each image axis, pixels.
        missing: share of the keypoints that are not detected, 0 to 1.
        outliers: share of the keypoints that are outliers, 0 to 1.
        outlier_px: largest displacement of an outlier along each image axis, pixels.

    Example:
        >>> from torchstickcal.simulate import Noise, golf_session
        >>> observations, truth = golf_session(cameras=4, frames=60, noise=Noise(sigma_px=2.0, missing=0.25))
        >>> round(observations.visible.double().mean().item(), 2)  # share of detected keypoints
        0.76
    """

    sigma_px: float = 1.0
    missing: float = 0.0
    outliers: float = 0.0
    outlier_px: float = 150.0

    def __call__(self, views: Views, rng: np.random.Generator) -> Views:
        """The views with this error added."""
        parts = (GaussianNoise(self.sigma_px), Outliers(self.outliers, self.outlier_px), Missing(self.missing))
        return apply(parts, views, rng)


def apply(regimes: Sequence[Regime], views: Views, rng: np.random.Generator) -> Views:
    """The views with the errors of all regimes added, one after another."""
    for regime in regimes:
        views = regime(views, rng)
    return views


def occluded(centre: Array, points: Array) -> Mask:
    """Whether a limb of the athlete is between a camera and a point.

    A joint is not hidden by the limbs that start or end at it, nor by limbs less than 0.1 m in front of it.

    Args:
        centre: of the camera, (3,).
        points: (F, P, 3), the joints first.

    Returns:
        (F, P).
    """
    rays = points - centre
    ranges = np.linalg.norm(rays, axis=-1)
    hidden = np.zeros(points.shape[:2], dtype=bool)
    for joint, parent in PARENTS.items():
        start, end = JOINT_INDEX[parent], JOINT_INDEX[joint]
        radius = LIMB_RADII_M[joint.removeprefix("left_").removeprefix("right_")]
        distance, share = _ray_to_segment(rays, points[:, None, start] - centre, points[:, None, end] - centre)
        in_front = (distance < radius) & ((1 - share) * ranges > _MIN_DISTANCE_BEHIND_M + radius)
        in_front[:, [start, end]] = False
        hidden |= in_front
    return hidden


def _ray_to_segment(rays: Array, start: Array, end: Array) -> tuple[Array, Array]:
    """Shortest distance between line segments from the origin and a bone.

    Args:
        rays: ends of the segments, (F, P, 3). start: of the bone, (F, 1, 3). end: of the bone, (F, 1, 3).

    Returns:
        Distances (F, P), and the position of the closest point on the segment as a share of its length, (F, P).
    """
    bone = end - start
    rr, rb, bb = (rays**2).sum(-1), (rays * bone).sum(-1), (bone**2).sum(-1)
    rs, bs = (rays * start).sum(-1), (bone * start).sum(-1)
    determinant = np.maximum(rr * bb - rb**2, 1e-12)
    along_ray = np.clip((rs * bb - rb * bs) / determinant, 0, 1)
    along_bone = np.clip((along_ray * rb - bs) / bb, 0, 1)
    along_ray = np.clip((rs + along_bone * rb) / rr, 0, 1)
    shortest = along_ray[..., None] * rays - start - along_bone[..., None] * bone
    return np.linalg.norm(shortest, axis=-1), along_ray


def _swapped(views: Views, frames: Mask, order: Sequence[int]) -> Views:
    """A copy with the points of the given frames (C, F) in another order; swapped points are outliers."""
    chosen = frames[..., None]
    moved = np.array(order) != np.arange(len(order))
    confidence = views.confidence
    return replace(
        views,
        keypoints=np.where(chosen[..., None], views.keypoints[:, :, order], views.keypoints),
        sigma_px=np.where(chosen, views.sigma_px[..., order], views.sigma_px),
        inliers=np.where(chosen, views.inliers[..., order] & ~moved, views.inliers),
        confidence=None if confidence is None else np.where(chosen, confidence[..., order], confidence),
    )


def _factors(spread: float, draws: Array) -> Array:
    """Log-normal factors with a root mean square of 1, from draws of variance 1."""
    return np.exp(spread * draws - spread**2)
