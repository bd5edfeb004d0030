"""The athlete and the stick as a smooth function of time: key postures are interpolated, repeated, and moved along a path."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields

import numpy as np
from numpy.typing import NDArray

from torchstickcal.simulate.motions import Action, Posture
from torchstickcal.simulate.paths import Path, Walk
from torchstickcal.simulate.skeleton import JOINT_INDEX, SIDES, STANDING_HEIGHT_M, Skeleton, bend, rotation, unit

Array = NDArray[np.float64]

_ANGLE_VARIATION_DEG, _LENGTH_VARIATION_M, _TIME_VARIATION = 1.5, 0.01, 0.03
"""Standard deviations between repetitions; that of times is a share of the interval between key postures."""
_FULL_REACH = 0.985
"""Largest extension of an arm or leg, as a share of its length: knees and elbows never straighten completely."""
_HAND_TO_STICK = 0.4
_FREE_HAND = (0.05, 0.09, -0.30)
"""Position of a hand that holds nothing, relative to its shoulder: outward, forward, up; in body heights."""

_HIP = 0.05
"""Distance of a hip from the middle of the pelvis, in body heights."""

_CHANNELS = [f.name for f in fields(Posture)][:-2]
_FEET = slice(len(_CHANNELS), len(_CHANNELS) + 6)
_VARIATION = np.array([_LENGTH_VARIATION_M if name.endswith("_m") else _ANGLE_VARIATION_DEG for name in _CHANNELS] + [0.0] * 6)


@dataclass(frozen=True)
class Motion:
    """An athlete who repeats an action, each time a little differently, while walking along a path.

    Args:
        action: the action of a sport.
        skeleton: the athlete's bones.
        path: curve on the floor along which the athlete walks.
        laps: part of the path that is walked in each repetition, in rounds.
        tempo: speed of the action; 1 is the speed of competition.
        variation: factor on the random variation between repetitions; 1 is typical of an expert, 0 is none.
        seed: of the random variation.

    Example:
        >>> from torchstickcal.simulate import Motion, action
        >>> golf = Motion(action("golf"), seed=1)
        >>> points = golf.points(np.array([0.0, 0.5, 1.0]))
        >>> points.shape
        (3, 21, 3)
        >>> np.linalg.norm(points[:, 20] - points[:, 19], axis=1).round(6)  # length of the club, metres
        array([1., 1., 1.])
    """

    action: Action
    skeleton: Skeleton = field(default_factory=Skeleton)
    path: Path = field(default_factory=Path)
    laps: float = 0.25
    tempo: float = 1.0
    variation: float = 1.0
    seed: int = 0

    def points(self, times: Array) -> Array:
        """Positions of the 19 joints and of the stick's start and end, metres, z up.

        They have continuous second derivatives in time; the lengths of bones and stick are constant.

        Args:
            times: (T,) in seconds; any real numbers.

        Returns:
            (T, 21, 3): the joints in the order of :data:`~torchstickcal.simulate.skeleton.JOINTS`, then the stick.
        """
        times = self.tempo * np.asarray(times, dtype=np.float64)
        distinct, index = np.unique(times, return_inverse=True)
        return self._points(distinct)[index.reshape(times.shape)]

    def hips(self, times: Array) -> Array:
        """Positions of the left and the right hip joint, (T, 2, 3), metres, which are not among the points.

        They are at the sides of the pelvis and turn with it. Thighs begin between them, as in the skeleton.
        """
        points = self.points(times)
        times = self.tempo * np.asarray(times, dtype=np.float64)
        pose = dict(zip(_CHANNELS, _posture(self.action, times, self.variation, self.seed).T, strict=False))
        walk = Walk(self.path, self.laps, *self.action.walk_s, self.action.period_s)
        turned = walk.body(times)[1] @ _trunk_rotation(pose, "pelvis")
        aside = self.skeleton.height_m * _HIP * turned[..., 0]
        pelvis = points[:, JOINT_INDEX["pelvis"]]
        return np.stack([pelvis - aside, pelvis + aside], axis=1)

    @property
    def period_s(self) -> float:
        """Duration of a repetition, seconds."""
        return self.action.period_s / self.tempo

    def _points(self, times: Array) -> Array:
        action, scale = self.action, self.skeleton.height_m / STANDING_HEIGHT_M
        posture = _posture(action, times, self.variation, self.seed)
        pose = dict(zip(_CHANNELS, posture.T, strict=False))
        walk = Walk(self.path, self.laps, *action.walk_s, action.period_s)
        position, body = walk.body(times)

        feet = scale * posture[:, _FEET].reshape(-1, 2, 3) + [0, 0, self.skeleton.ankle_height_m]
        ankles = {side: walk.foot(times, feet[:, k], leads=side == "right") for k, side in enumerate(SIDES)}
        pelvis = position + _apply(body, scale * np.stack([pose["sway_m"], pose["forward_m"], pose["height_m"]], axis=-1))
        self._lower(pelvis, ankles)

        joints = self.skeleton.forward(pelvis, _trunk_rotations(pose, body))
        self._place_legs(joints, ankles, body[..., 1] + (body @ rotation(2, pose["pelvis_turn"]))[..., 1])
        start, stick = self._stick(pose, body, joints, scale)
        self._place_arms(joints, start, stick, body @ _trunk_rotation(pose, "chest"))
        ends = np.stack([start, start + action.stick_m * stick], axis=1)
        return np.concatenate([joints, ends], axis=1)

    def _lower(self, pelvis: Array, ankles: Mapping[str, Array]) -> None:
        """Lower the pelvis (T, 3), in place, until both legs reach their ankles."""
        up, leg_m = np.array([0.0, 0.0, 1.0]), _FULL_REACH * (self.skeleton.thigh_m + self.skeleton.shank_m)
        for ankle in ankles.values():
            pelvis[:, 2] = ankle[:, 2] + _reachable(pelvis[:, 2] - ankle[:, 2], pelvis - ankle, up, leg_m)

    def _place_legs(self, joints: Array, ankles: Mapping[str, Array], knee_direction: Array) -> None:
        """Set the joints of the legs (in place), with the knees bent towards a direction (T, 3)."""
        bones = self.skeleton
        for side, ankle in ankles.items():
            knee = bend(joints[:, JOINT_INDEX["pelvis"]], ankle, bones.thigh_m, bones.shank_m, knee_direction)
            shin = knee + bones.bone_m("right_shin") / bones.shank_m * (ankle - knee)
            for joint, point in (("knee", knee), ("shin", shin), ("ankle", ankle)):
                joints[:, JOINT_INDEX[f"{side}_{joint}"]] = point

    def _place_arms(self, joints: Array, start: Array, stick: Array, chest: Array) -> None:
        """Set the joints of the arms (in place): each hand on its grip, or hanging if it holds nothing.

        Args:
            joints: (T, 19, 3).
            start: of the stick, (T, 3). stick: its direction, (T, 3).
            chest: rotations (T, 3, 3), chest to world.
        """
        bones = self.skeleton
        for side in SIDES:
            shoulder = joints[:, JOINT_INDEX[f"{side}_shoulder"]]
            outward = 1.0 if side == "right" else -1.0
            if side in self.action.grips_m:
                hand = start + self.action.grips_m[side] * stick
                palm = unit(unit(hand - shoulder) + _HAND_TO_STICK * stick)
            else:
                hand = shoulder + chest @ (bones.height_m * np.array(_FREE_HAND) * [outward, 1, 1])
                palm = unit(hand - shoulder)
            wrist = hand - bones.hand_m * palm
            elbow = bend(shoulder, wrist, bones.upper_arm_m, bones.forearm_m, _elbow_direction(shoulder, wrist, chest, outward))
            for joint, point in (("elbow", elbow), ("wrist", wrist), ("hand", hand)):
                joints[:, JOINT_INDEX[f"{side}_{joint}"]] = point

    def _stick(self, pose: dict[str, Array], body: Array, joints: Array, scale: float) -> tuple[Array, Array]:
        """Start and direction of the stick, (T, 3) each, within reach of every hand that holds it."""
        action, bones = self.action, self.skeleton
        zero, plus = (np.array(axis) for axis in action.plane)
        axes = np.stack([zero, plus, np.cross(zero, plus)], axis=-1)
        arms = _apply(body @ axes, _polar(pose["arms_angle"], pose["arms_elevation"]))
        stick = _apply(body @ axes, _polar(pose["arms_angle"] + pose["stick_angle"], pose["stick_elevation"]))
        shoulders = {side: joints[:, JOINT_INDEX[f"{side}_shoulder"]] for side in SIDES}
        chest = (shoulders["left"] + shoulders["right"]) / 2
        middle_m = float(np.mean(list(action.grips_m.values())))
        to_wrist_m = _FULL_REACH * (bones.upper_arm_m + bones.forearm_m)
        aside_m = bones.hand_m * _HAND_TO_STICK
        arm_m = np.sqrt(bones.hand_m**2 - aside_m**2) + np.sqrt(to_wrist_m**2 - aside_m**2)
        reach = scale * pose["arms_reach_m"]
        for side, grip_m in action.grips_m.items():
            from_shoulder = chest + reach[:, None] * arms + (grip_m - middle_m) * stick - shoulders[side]
            reach = _reachable(reach, from_shoulder, arms, arm_m)
        return chest + reach[:, None] * arms - middle_m * stick, stick


def _posture(action: Action, times: Array, variation: float, seed: int) -> Array:
    """The interpolated posture at increasing times (T,), as (T, D): the fields of :class:`Posture` one after another.

    Each repetition has key postures of its own, drawn from a generator seeded with the number of the repetition.
    """
    key_times = np.array([time for time, _ in action.keys])
    values = np.array([np.hstack(list(vars(posture).values())) for _, posture in action.keys])
    gaps = np.diff(key_times, append=action.period_s)
    slack = np.minimum(gaps, np.roll(gaps, 1))
    first, last = (int(np.floor(time / action.period_s)) for time in (times[0], times[-1]))
    knots, levels = [], []
    for cycle in range(first - 2, last + 3):
        rng = np.random.default_rng((seed, cycle % 2**32))
        shift = np.clip(rng.standard_normal(len(key_times)), -3, 3) * _TIME_VARIATION * slack
        knots.append(cycle * action.period_s + key_times + variation * shift)
        levels.append(values + variation * _VARIATION * np.clip(rng.standard_normal(values.shape), -3, 3))
    return interpolate(np.concatenate(knots), np.concatenate(levels), times)


def interpolate(knots: Array, values: Array, times: Array) -> Array:
    """Interpolate by quintic polynomials, with continuous second derivatives and without overshoot.

    At a knot the second derivative is 0, and the slope is the harmonic mean of the slopes of the two adjacent chords, or 0
    if their signs differ. Between two equal values the curve is therefore constant.

    Args:
        knots: increasing times (K,).
        values: at the knots, (K, D).
        times: (T,), between the first and the last knot.

    Returns:
        Values (T, D).
    """
    widths = np.diff(knots)[:, None]
    chords = np.diff(values, axis=0) / widths
    before, after = chords[:-1], chords[1:]
    agree = before * after > 0
    slopes = np.zeros_like(values)
    slopes[1:-1][agree] = (2 * before * after)[agree] / (before + after)[agree]
    piece = np.clip(np.searchsorted(knots, times, side="right") - 1, 0, len(knots) - 2)
    width = widths[piece]
    s = (times[:, None] - knots[piece][:, None]) / width
    rise = s**3 * (10 - 15 * s + 6 * s**2)
    leave = s - s**3 * (6 - 8 * s + 3 * s**2)
    arrive = -(s**3) * (4 - 7 * s + 3 * s**2)
    start, end = values[piece], values[piece + 1]
    return start + rise * (end - start) + width * (leave * slopes[piece] + arrive * slopes[piece + 1])


def _trunk_rotations(pose: dict[str, Array], body: Array) -> Array:
    """Joint rotations (T, 19, 3, 3): those of pelvis, spine and neck; the identity for the limbs."""
    pelvis, chest = _trunk_rotation(pose, "pelvis"), _trunk_rotation(pose, "chest")
    head = rotation(2, pose["head_turn"]) @ rotation(0, -pose["head_nod"])
    rotations = np.tile(np.eye(3), (len(body), len(JOINT_INDEX), 1, 1))
    rotations[:, JOINT_INDEX["pelvis"]] = body @ pelvis
    rotations[:, JOINT_INDEX["spine"]] = pelvis.swapaxes(-1, -2) @ chest
    rotations[:, JOINT_INDEX["neck"]] = chest.swapaxes(-1, -2) @ head
    return rotations


def _trunk_rotation(pose: dict[str, Array], part: str) -> Array:
    """Rotations (T, 3, 3) of pelvis or chest, in body axes."""
    return rotation(0, -pose[f"{part}_lean"]) @ rotation(1, pose[f"{part}_side"]) @ rotation(2, pose[f"{part}_turn"])


def _elbow_direction(shoulder: Array, wrist: Array, chest: Array, outward: float) -> Array:
    """Direction (T, 3) in which an elbow points: outward, and backward if the arm hangs, downward if it is held forward."""
    right, up = chest[..., 0], chest[..., 2]
    return np.cross(unit(wrist - shoulder), right) + 0.3 * outward * right - 0.9 * up


def _reachable(along: Array, offset: Array, direction: Array, limit_m: float) -> Array:
    """Distances (T,) along a direction, reduced smoothly where a limb would be longer than its limit.

    Args:
        along: wanted distances (T,) from an origin along the direction.
        offset: vectors (T, 3) from the root of the limb to the point at that distance.
        direction: unit vectors (T, 3).
        limit_m: largest length of ``offset``.
    """
    parallel = (offset * direction).sum(-1)
    aside = (offset**2).sum(-1) - parallel**2
    largest = along - parallel + np.sqrt(np.maximum(limit_m**2 - aside, 0.0))
    share, linear = along / largest, 0.9
    eased = linear + (1 - linear) * np.tanh((share - linear) / (1 - linear))
    return largest * np.where(share > linear, eased, share)


def _polar(angle: Array, elevation: Array) -> Array:
    """Unit vectors (T, 3) of an angle in the plane and an elevation out of it, in the axes of the plane and its normal."""
    a, e = np.deg2rad(angle), np.deg2rad(elevation)
    return np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=-1)


def _apply(rotations: Array, vectors: Array) -> Array:
    """Vectors (T, 3) rotated by (T, 3, 3)."""
    return (rotations @ vectors[..., None])[..., 0]
