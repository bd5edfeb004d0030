"""What is wrong with keypoints: noise, gaps, occlusion, gross errors, confusions. Regimes are applied one after another.

Each is a small frozen dataclass that takes :class:`Views` and a random generator and returns other views.
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

_LIMB_RADII_M = {"spine": 0.12, "neck": 0.13, "head": 0.06, "head_top": 0.10, "shoulder": 0.06, "elbow": 0.045, "wrist": 0.04}
_LIMB_RADII_M |= {"hand": 0.04, "knee": 0.08, "shin": 0.055, "ankle": 0.05}
_BESIDE_M = 0.10
_OTHER_SIDE = [
    JOINT_INDEX[name.replace("left", "right") if name.startswith("left") else name.replace("right", "left")] for name in JOINTS
]


@dataclass(frozen=True, eq=False)
class Views:
    """What the cameras see of the points, and what is known about it."""

    rig: CameraRig
    points: Array
    """(C, F, P, 3): where each camera found the points when it looked, metres; the last two are the stick's ends"""
    keypoints: Array
    """(C, F, P, 2) pixels, NaN where not seen"""
    inliers: Mask
    """(C, F, P), False where drawn with a gross error"""
    sigma_px: Array
    """(C, F, P), standard deviation along each axis that a keypoint was drawn with"""
    confidence: Array | None = None
    """(C, F, P) in [0, 1], of a detector that gives one"""

    def hiding(self, hidden: Mask) -> Views:
        """Without the keypoints where ``hidden`` (broadcast to (C, F, P)) is true."""
        return replace(self, keypoints=np.where(hidden[..., None], np.nan, self.keypoints))

    def scattered(self, sigma_px: Array, draws: Array) -> Views:
        """With independent errors added: ``draws`` (C, F, P, 2) of unit variance times ``sigma_px`` (C, F, P)."""
        total = np.sqrt(self.sigma_px**2 + sigma_px**2)
        return replace(self, keypoints=self.keypoints + sigma_px[..., None] * draws, sigma_px=total)


class Regime(Protocol):
    """Something that goes wrong."""

    def __call__(self, views: Views, rng: np.random.Generator) -> Views:
        """The views after it."""
        ...


@dataclass(frozen=True)
class GaussianNoise:
    """Independent normal errors of one standard deviation: the paper's noise."""

    sigma_px: float

    def __call__(self, views: Views, rng: np.random.Generator) -> Views:
        """The views after it."""
        return views.scattered(np.full_like(views.sigma_px, self.sigma_px), rng.standard_normal(views.keypoints.shape))


@dataclass(frozen=True)
class DetectorNoise:
    """Errors as pose detectors make them: joints differ, single keypoints too (hence heavy tails), and confidence tells of it.

    The standard deviation of a keypoint is that of its kind, times a factor of its joint, times a log-normal factor of its
    own; the factors' root mean square is 1.

    Args:
        sigma_px: of joints. stick_sigma_px: of stick ends.
        joint_spread: of the logarithm of the joints' factors. keypoint_spread: of the keypoints'.
    """

    sigma_px: float = 2.5
    stick_sigma_px: float = 1.5
    joint_spread: float = 0.25
    keypoint_spread: float = 0.4

    def __call__(self, views: Views, rng: np.random.Generator) -> Views:
        """The views after it."""
        joints = self.sigma_px * _factors(self.joint_spread, rng.standard_normal(len(JOINTS)))
        joints *= self.sigma_px / np.sqrt((joints**2).mean())
        own = _factors(self.keypoint_spread, rng.standard_normal(views.inliers.shape))
        sigma = own * np.append(joints, [self.stick_sigma_px] * 2)
        told = 0.75 / own * np.exp(0.15 * rng.standard_normal(own.shape))
        noisy = views.scattered(sigma, rng.standard_normal(views.keypoints.shape))
        return replace(noisy, confidence=np.clip(told, 0.05, 1.0))


@dataclass(frozen=True)
class Missing:
    """Single keypoints not detected, independently of each other."""

    share: float

    def __call__(self, views: Views, rng: np.random.Generator) -> Views:
        """The views after it."""
        return views.hiding(rng.random(views.inliers.shape) < self.share)


@dataclass(frozen=True)
class Gaps:
    """Tracks that break off and come back: runs of missing frames, of geometrically distributed length."""

    share: float
    mean_frames: float = 6.0

    def __call__(self, views: Views, rng: np.random.Generator) -> Views:
        """The views after it."""
        begin = self.share / ((1 - self.share) * self.mean_frames)
        draws = rng.random(views.inliers.shape)
        gone = draws < self.share
        for frame in range(1, draws.shape[1]):
            gone[:, frame] = draws[:, frame] < np.where(gone[:, frame - 1], 1 - 1 / self.mean_frames, begin)
        return views.hiding(gone)


@dataclass(frozen=True)
class DroppedFrames:
    """Whole frames lost by single cameras."""

    share: float

    def __call__(self, views: Views, rng: np.random.Generator) -> Views:
        """The views after it."""
        return views.hiding((rng.random(views.inliers.shape[:2]) < self.share)[..., None])


@dataclass(frozen=True)
class FrameRates:
    """Cameras slower than the session's clock: each has pictures at some of the session's frames only.

    Args:
        shares: of the frames that each camera takes, repeated over the cameras.
    """

    shares: tuple[float, ...]

    def __call__(self, views: Views, rng: np.random.Generator) -> Views:
        """The views after it."""
        cameras, frames = views.inliers.shape[:2]
        count = np.outer(np.resize(self.shares, cameras), np.arange(frames + 1) + 1e-9)
        return views.hiding((np.diff(np.floor(count), axis=1) == 0)[..., None])


@dataclass(frozen=True)
class SelfOcclusion:
    """Points behind the athlete's own body, limbs being capsules, are not seen."""

    def __call__(self, views: Views, rng: np.random.Generator) -> Views:
        """The views after it."""
        hidden = [occluded(centre, points) for centre, points in zip(views.rig.centres, views.points, strict=True)]
        return views.hiding(np.stack(hidden))


@dataclass(frozen=True)
class Outliers:
    """Gross errors: keypoints displaced uniformly by up to ``reach_px`` along each axis."""

    share: float
    reach_px: float = 150.0

    def __call__(self, views: Views, rng: np.random.Generator) -> Views:
        """The views after it."""
        gross = rng.random(views.inliers.shape) < self.share
        moved = views.keypoints + gross[..., None] * rng.uniform(-self.reach_px, self.reach_px, views.keypoints.shape)
        return replace(views, keypoints=moved, inliers=views.inliers & ~gross)


@dataclass(frozen=True)
class Flips:
    """Frames in which a camera's detector takes left for right, in every pair of joints."""

    share: float

    def __call__(self, views: Views, rng: np.random.Generator) -> Views:
        """The views after it."""
        return _exchanged(views, rng.random(views.inliers.shape[:2]) < self.share, [*_OTHER_SIDE, len(JOINTS), len(JOINTS) + 1])


@dataclass(frozen=True)
class SwappedEnds:
    """Frames in which a camera's detector takes the stick's start for its end."""

    share: float

    def __call__(self, views: Views, rng: np.random.Generator) -> Views:
        """The views after it."""
        same = list(range(len(JOINTS)))
        return _exchanged(views, rng.random(views.inliers.shape[:2]) < self.share, [*same, len(JOINTS) + 1, len(JOINTS)])


@dataclass(frozen=True)
class Noise:
    """A plain mixture: normal errors, some keypoints displaced by up to ``outlier_px`` along each axis, some missing."""

    sigma_px: float = 1.0
    missing: float = 0.0
    outliers: float = 0.0
    outlier_px: float = 150.0

    def __call__(self, views: Views, rng: np.random.Generator) -> Views:
        """The views after it."""
        parts = (GaussianNoise(self.sigma_px), Outliers(self.outliers, self.outlier_px), Missing(self.missing))
        return apply(parts, views, rng)


def apply(regimes: Sequence[Regime], views: Views, rng: np.random.Generator) -> Views:
    """The views after one regime after another."""
    for regime in regimes:
        views = regime(views, rng)
    return views


def occluded(centre: Array, points: Array) -> Mask:
    """Whether a limb stands between a camera centre (3,) and points (F, P, 3); (F, P).

    Limbs that meet in a point do not hide it, nor does what is within a hand's breadth of it.
    """
    rays = points - centre
    ranges = np.linalg.norm(rays, axis=-1)
    hidden = np.zeros(points.shape[:2], dtype=bool)
    for joint, parent in PARENTS.items():
        start, end = JOINT_INDEX[parent], JOINT_INDEX[joint]
        radius = _LIMB_RADII_M[joint.removeprefix("left_").removeprefix("right_")]
        distance, share = _ray_to_segment(rays, points[:, None, start] - centre, points[:, None, end] - centre)
        in_front = (distance < radius) & ((1 - share) * ranges > _BESIDE_M + radius)
        in_front[:, [start, end]] = False
        hidden |= in_front
    return hidden


def _ray_to_segment(rays: Array, start: Array, end: Array) -> tuple[Array, Array]:
    """Least distance of the stretches from 0 to ``rays`` (F, P, 3) to segments (F, 1, 3), and the share of the ray there."""
    bone = end - start
    rr, rb, bb = (rays**2).sum(-1), (rays * bone).sum(-1), (bone**2).sum(-1)
    rs, bs = (rays * start).sum(-1), (bone * start).sum(-1)
    determinant = np.maximum(rr * bb - rb**2, 1e-12)
    along_ray = np.clip((rs * bb - rb * bs) / determinant, 0, 1)
    along_bone = np.clip((along_ray * rb - bs) / bb, 0, 1)
    along_ray = np.clip((rs + along_bone * rb) / rr, 0, 1)
    nearest = along_ray[..., None] * rays - start - along_bone[..., None] * bone
    return np.linalg.norm(nearest, axis=-1), along_ray


def _exchanged(views: Views, frames: Mask, order: Sequence[int]) -> Views:
    """With the points of the chosen frames (C, F) in another order; those that moved are no inliers."""
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
    """Log-normal factors with a root mean square of 1."""
    return np.exp(spread * draws - spread**2)
