"""A golf swing seen by a ring of cameras: a session with known truth, for demonstrations and tests."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from torchstickcal.cameras import Intrinsics
from torchstickcal.io.session import SPORTS_STICK_SYN_JOINTS, Truth
from torchstickcal.observations import Observations, Stick

Array = NDArray[np.float64]

CLUB_LENGTH_M = 1.0
_UPPER_ARM_M, _FOREARM_M, _HAND_M, _THIGH_M, _SHANK_M = 0.30, 0.26, 0.09, 0.43, 0.43
_HUB, _BALL = np.array([0.0, 0.12, 1.38]), np.array([0.0, 0.95, 0.0])
_HANDS_RADIUS_M = 0.56
_SWING_S = (0.0, 0.3, 1.1, 1.35, 1.5, 2.0, 2.4)
"""address, takeaway, top, impact, release, finish, end"""
_ARM_DEG = (0, 0, -140, 0, 60, 165, 165)
_WRIST_DEG = (0, 0, -95, 0, 25, 100, 100)
_SHOULDER_DEG = (0, 0, -90, 10, 45, 95, 95)
_HIP_DEG = (0, 0, -40, 30, 50, 80, 80)


@dataclass(frozen=True)
class Noise:
    """What is wrong with the keypoints.

    Args:
        sigma_px: standard deviation of a keypoint along each axis.
        missing: share of keypoints not seen.
        outliers: share of keypoints displaced by up to ``outlier_px`` along each axis.
        outlier_px: see ``outliers``.
    """

    sigma_px: float = 1.0
    missing: float = 0.0
    outliers: float = 0.0
    outlier_px: float = 150.0


def golf_session(cameras: int = 6, frames: int = 240, noise: Noise | None = None, seed: int = 0) -> tuple[Observations, Truth]:
    """A right-handed swing, 2.4 s long, with a club of 1 m, seen by cameras on a ring of 4.5 m.

    Args:
        cameras: number of cameras.
        frames: number of frames the swing is divided into.
        noise: what is done to the keypoints; None for perfect ones.
        seed: of everything random.
    """
    rng = np.random.default_rng(seed)
    times = np.linspace(0, _SWING_S[-1], frames)
    points = np.stack([_pose(time) for time in times])
    rotations, translations = _ring(cameras)
    matrix = np.array([[1400.0, 0, 960], [0, 1400, 540], [0, 0, 1]])
    distortion = np.tile([-0.1, 0.02, 0.0005, -0.0005, 0.0], (cameras, 1))
    lens = Intrinsics(torch.from_numpy(matrix).expand(cameras, 3, 3), torch.from_numpy(distortion))
    in_cameras = np.einsum("cij,fpj->cfpi", rotations, points) + translations[:, None, None]
    keypoints = lens.project(torch.from_numpy(in_cameras)).numpy()
    if noise is not None:
        keypoints = _disturbed(keypoints, noise, rng)
    first = len(SPORTS_STICK_SYN_JOINTS)
    observations = Observations(
        keypoints,
        matrix,
        Stick(first, first + 1, CLUB_LENGTH_M),
        distortion=distortion,
        image_size=(1920, 1080),
        fps=(frames - 1) / _SWING_S[-1],
        point_names=[*SPORTS_STICK_SYN_JOINTS, "club_grip", "club_head"],
        camera_names=[f"cam{index + 1:02d}" for index in range(cameras)],
    )
    return observations, Truth(*(torch.from_numpy(v) for v in (rotations, translations, points)))


def _disturbed(keypoints: Array, noise: Noise, rng: np.random.Generator) -> Array:
    shape = keypoints.shape[:-1]
    disturbed = keypoints + noise.sigma_px * rng.standard_normal(keypoints.shape)
    gross = rng.random(shape) < noise.outliers
    disturbed[gross] += rng.uniform(-noise.outlier_px, noise.outlier_px, (int(gross.sum()), 2))
    disturbed[rng.random(shape) < noise.missing] = np.nan
    return disturbed


def _ring(count: int) -> tuple[Array, Array]:
    """Cameras around the athlete at alternating heights, looking at the middle of the swing."""
    target = np.array([0.0, 0.3, 0.95])
    rotations, translations = np.empty((count, 3, 3)), np.empty((count, 3))
    for index in range(count):
        angle = 2 * np.pi * index / count + 0.3
        centre = np.array([4.5 * np.cos(angle), 4.5 * np.sin(angle), 1.4 + 1.1 * (index % 2)])
        forward = _unit(target - centre)
        right = _unit(np.cross(forward, [0.0, 0.0, 1.0]))
        rotations[index] = np.stack([right, np.cross(forward, right), forward])
        translations[index] = -rotations[index] @ centre
    return rotations, translations


def _pose(time: float) -> Array:
    """The 19 joints and the club's two ends at a time of the swing, z up, the athlete facing +y."""
    arm, wrist, shoulder, hip = (np.deg2rad(_eased(time, angles)) for angles in (_ARM_DEG, _WRIST_DEG, _SHOULDER_DEG, _HIP_DEG))
    target, down = np.array([-1.0, 0.0, 0.0]), _unit(_BALL - _HUB)
    grip = _HUB + _HANDS_RADIUS_M * (np.cos(arm) * down + np.sin(arm) * target)
    club = np.cos(arm + wrist) * down + np.sin(arm + wrist) * target
    left_axis, hip_axis = (np.array([-np.cos(a), np.sin(a), 0.0]) for a in (-shoulder, -hip))
    pelvis = np.array([0.03 * np.sin(hip), -0.06, 0.92])
    neck = _HUB + np.array([0.0, 0.02, 0.10])
    points: dict[str, Array] = {
        "pelvis": pelvis,
        "spine": 0.45 * pelvis + 0.55 * _HUB + np.array([0.0, -0.05, 0.0]),
        "neck": neck,
        "head": neck + np.array([0.0, 0.05, 0.11]),
        "head_top": neck + np.array([0.0, 0.07, 0.24]),
        "club_grip": grip,
        "club_head": grip + CLUB_LENGTH_M * club,
    }
    for side, sign in (("left", 1.0), ("right", -1.0)):
        shoulder_at = _HUB + 0.18 * sign * left_axis
        hand_at = grip + (0.02 if side == "left" else 0.10) * club
        elbow, wrist_at = _two_bones(shoulder_at, hand_at - _HAND_M * club * 0.5, _UPPER_ARM_M, _FOREARM_M, -left_axis * sign)
        points[f"{side}_shoulder"], points[f"{side}_elbow"], points[f"{side}_wrist"] = shoulder_at, elbow, wrist_at
        points[f"{side}_hand"] = wrist_at + _HAND_M * _unit(hand_at - wrist_at)
        hip_at = pelvis + 0.12 * sign * hip_axis
        ankle_at = np.array([-0.24 * sign, 0.0, 0.09])
        knee, ankle = _two_bones(hip_at, ankle_at, _THIGH_M, _SHANK_M, np.array([0.0, 1.0, 0.0]))
        points[f"{side}_knee"], points[f"{side}_ankle"], points[f"{side}_shin"] = knee, ankle, (knee + ankle) / 2
    return np.stack([points[name] for name in (*SPORTS_STICK_SYN_JOINTS, "club_grip", "club_head")])


def _two_bones(root: Array, goal: Array, first: float, second: float, bend: Array) -> tuple[Array, Array]:
    """Middle and end of a two-bone limb that reaches from a root towards a goal, bent to one side."""
    distance = float(np.linalg.norm(goal - root))
    reach = min(distance, 0.999 * (first + second))
    along = (goal - root) / distance
    side = _unit(bend - (bend @ along) * along)
    cosine = (first**2 + reach**2 - second**2) / (2 * first * reach)
    middle = root + first * (cosine * along + np.sqrt(max(0.0, 1 - cosine**2)) * side)
    return middle, middle + second * _unit(root + reach * along - middle)


def _eased(time: float, angles: tuple[int, ...]) -> float:
    """Angles at the swing's key times, joined with smooth starts and stops; the downswing passes through impact."""
    segment = int(np.clip(np.searchsorted(_SWING_S, time, side="right") - 1, 0, len(_SWING_S) - 2))
    slopes = np.zeros(len(angles))
    for k in range(1, len(angles) - 1):
        before = (angles[k] - angles[k - 1]) / (_SWING_S[k] - _SWING_S[k - 1])
        after = (angles[k + 1] - angles[k]) / (_SWING_S[k + 1] - _SWING_S[k])
        slopes[k] = 2 * before * after / (before + after) if before * after > 0 else 0.0
    width = _SWING_S[segment + 1] - _SWING_S[segment]
    s = (time - _SWING_S[segment]) / width
    start, end = angles[segment], angles[segment + 1]
    return float(
        (2 * s**3 - 3 * s**2 + 1) * start
        + (s**3 - 2 * s**2 + s) * width * slopes[segment]
        + (3 * s**2 - 2 * s**3) * end
        + (s**3 - s**2) * width * slopes[segment + 1]
    )


def _unit(vector: Array) -> Array:
    return vector / np.linalg.norm(vector)
