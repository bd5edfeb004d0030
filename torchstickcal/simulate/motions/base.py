"""A sport's action as a smooth function of continuous time: key postures, joined, repeated and carried along a path."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import astuple, dataclass, field, fields

import numpy as np
from numpy.typing import NDArray

from torchstickcal.simulate.paths import Path, Walk
from torchstickcal.simulate.skeleton import JOINT_INDEX, SIDES, STANDING_HEIGHT_M, Skeleton, bend, rotation, unit

Array = NDArray[np.float64]
Plane = tuple[tuple[float, float, float], tuple[float, float, float]]

_ANGLE_VARIATION_DEG, _LENGTH_VARIATION_M, _TIME_VARIATION = 1.5, 0.01, 0.03
_FULL_REACH = 0.985
_HAND_TO_STICK = 0.4
_FREE_HAND = (0.05, 0.09, -0.30)
"""Of a hand that holds nothing, from its shoulder: outward, forward, up; in body heights."""


@dataclass(frozen=True)
class Posture:
    """A key posture, in the body's axes (x right, y forward, z up): degrees, and metres for an athlete of 1.76 m.

    Turns are counter-clockwise seen from above (to the left), leans forward, sides to the right. Trunk angles are those of
    pelvis and chest against the upright body, a turn being about the leaning spine. The arms are given by the point
    between the hands, seen from the point between the shoulders, in polar coordinates of the action's swing plane; the
    stick by its angle from there in the plane, and its own elevation out of it.
    """

    sway_m: float = 0.0
    forward_m: float = -0.04
    height_m: float = 0.90
    pelvis_turn: float = 0.0
    pelvis_lean: float = 5.0
    pelvis_side: float = 0.0
    chest_turn: float = 0.0
    chest_lean: float = 10.0
    chest_side: float = 0.0
    head_turn: float = 0.0
    head_nod: float = 0.0
    arms_angle: float = 0.0
    arms_elevation: float = 0.0
    arms_reach_m: float = 0.5
    stick_angle: float = 0.0
    stick_elevation: float = 0.0
    left_foot: tuple[float, float, float] = (-0.16, 0.0, 0.0)
    right_foot: tuple[float, float, float] = (0.16, 0.0, 0.0)


_CHANNELS = [f.name for f in fields(Posture)][:-2]
_FEET = slice(len(_CHANNELS), len(_CHANNELS) + 6)
_VARIATION = np.array([_LENGTH_VARIATION_M if name.endswith("_m") else _ANGLE_VARIATION_DEG for name in _CHANNELS] + [0.0] * 6)


@dataclass(frozen=True)
class Action:
    """What is done in a sport, once.

    Args:
        stick_m: length of the stick.
        stick_names: of its start, where it is held, and its end.
        grips_m: where each hand that holds it does so, metres from its start.
        plane: the swing plane's axes, from which angles count and towards which they grow; unit vectors at a right angle.
        keys: postures at increasing times, seconds, the first at 0.
        period_s: when the first posture comes again.
        walk_s: from when to when the athlete may go elsewhere.
    """

    stick_m: float
    stick_names: tuple[str, str]
    grips_m: Mapping[str, float]
    plane: Plane
    keys: tuple[tuple[float, Posture], ...]
    period_s: float
    walk_s: tuple[float, float]


@dataclass(frozen=True)
class Motion:
    """An athlete who repeats an action, each time a little differently, while going along a path.

    Args:
        action: what is done.
        skeleton: by whom.
        path: where.
        laps: how much of the path is gone in each repetition.
        tempo: speed of the action; 1 is that of competition.
        variation: of the postures between repetitions; 1 is that of an expert, 0 none.
        seed: of the variation.
    """

    action: Action
    skeleton: Skeleton = field(default_factory=Skeleton)
    path: Path = field(default_factory=Path)
    laps: float = 0.25
    tempo: float = 1.0
    variation: float = 1.0
    seed: int = 0

    def points(self, times: Array) -> Array:
        """The 19 joints and the stick's start and end at times (T,) in seconds, any real numbers: (T, 21, 3), metres, z up.

        Positions have continuous second derivatives in time; bones and stick keep their lengths exactly.
        """
        times = self.tempo * np.asarray(times, dtype=np.float64)
        distinct, place = np.unique(times, return_inverse=True)
        return self._points(distinct)[place.reshape(times.shape)]

    @property
    def period_s(self) -> float:
        """Duration of a repetition."""
        return self.action.period_s / self.tempo

    def _points(self, times: Array) -> Array:
        action, scale = self.action, self.skeleton.height_m / STANDING_HEIGHT_M
        posture = _posture(action, times, self.variation, self.seed)
        pose = dict(zip(_CHANNELS, posture.T, strict=False))
        walk = Walk(self.path, self.laps, *action.walk_s, action.period_s)
        place, turned = walk.body(times)

        feet = scale * posture[:, _FEET].reshape(-1, 2, 3) + [0, 0, self.skeleton.ankle_height_m]
        ankles = {side: walk.foot(times, feet[:, k], leads=side == "right") for k, side in enumerate(SIDES)}
        pelvis = place + _apply(turned, scale * np.stack([pose["sway_m"], pose["forward_m"], pose["height_m"]], axis=-1))
        self._lower(pelvis, ankles)

        joints = self.skeleton.forward(pelvis, _trunk_rotations(pose, turned))
        self._place_legs(joints, ankles, turned[..., 1] + (turned @ rotation(2, pose["pelvis_turn"]))[..., 1])
        start, stick = self._stick(pose, turned, joints, scale)
        self._place_arms(joints, start, stick, turned @ _leaning_turn(pose, "chest"))
        ends = np.stack([start, start + action.stick_m * stick], axis=1)
        return np.concatenate([joints, ends], axis=1)

    def _lower(self, pelvis: Array, ankles: Mapping[str, Array]) -> None:
        """Lower a pelvis (T, 3) to where both legs reach their ankles."""
        up, leg_m = np.array([0.0, 0.0, 1.0]), _FULL_REACH * (self.skeleton.thigh_m + self.skeleton.shank_m)
        for ankle in ankles.values():
            pelvis[:, 2] = ankle[:, 2] + _reachable(pelvis[:, 2] - ankle[:, 2], pelvis - ankle, up, leg_m)

    def _place_legs(self, joints: Array, ankles: Mapping[str, Array], knees_to: Array) -> None:
        """Put the legs' joints between pelvis and ankles, the knees bent towards vectors (T, 3)."""
        body = self.skeleton
        for side, ankle in ankles.items():
            knee = bend(joints[:, JOINT_INDEX["pelvis"]], ankle, body.thigh_m, body.shank_m, knees_to)
            shin = knee + body.bone_m("right_shin") / body.shank_m * (ankle - knee)
            for joint, point in (("knee", knee), ("shin", shin), ("ankle", ankle)):
                joints[:, JOINT_INDEX[f"{side}_{joint}"]] = point

    def _place_arms(self, joints: Array, start: Array, stick: Array, chest: Array) -> None:
        """Put the arms' joints between shoulders and grips, or beside the body."""
        body = self.skeleton
        for side in SIDES:
            shoulder = joints[:, JOINT_INDEX[f"{side}_shoulder"]]
            outward = 1.0 if side == "right" else -1.0
            if side in self.action.grips_m:
                hand = start + self.action.grips_m[side] * stick
                palm = unit(unit(hand - shoulder) + _HAND_TO_STICK * stick)
            else:
                hand = shoulder + chest @ (body.height_m * np.array(_FREE_HAND) * [outward, 1, 1])
                palm = unit(hand - shoulder)
            wrist = hand - body.hand_m * palm
            elbow = bend(shoulder, wrist, body.upper_arm_m, body.forearm_m, _elbow_side(shoulder, wrist, chest, outward))
            for joint, point in (("elbow", elbow), ("wrist", wrist), ("hand", hand)):
                joints[:, JOINT_INDEX[f"{side}_{joint}"]] = point

    def _stick(self, pose: dict[str, Array], turned: Array, joints: Array, scale: float) -> tuple[Array, Array]:
        """The stick's start and direction, (T, 3) each, where every hand that holds it can reach it."""
        action, body = self.action, self.skeleton
        zero, plus = (np.array(axis) for axis in action.plane)
        axes = np.stack([zero, plus, np.cross(zero, plus)], axis=-1)
        towards = _apply(turned @ axes, _polar(pose["arms_angle"], pose["arms_elevation"]))
        stick = _apply(turned @ axes, _polar(pose["arms_angle"] + pose["stick_angle"], pose["stick_elevation"]))
        shoulders = {side: joints[:, JOINT_INDEX[f"{side}_shoulder"]] for side in SIDES}
        hub = (shoulders["left"] + shoulders["right"]) / 2
        middle_m = float(np.mean(list(action.grips_m.values())))
        to_wrist_m = _FULL_REACH * (body.upper_arm_m + body.forearm_m)
        aside_m = body.hand_m * _HAND_TO_STICK
        arm_m = np.sqrt(body.hand_m**2 - aside_m**2) + np.sqrt(to_wrist_m**2 - aside_m**2)
        reach = scale * pose["arms_reach_m"]
        for side, grip_m in action.grips_m.items():
            from_shoulder = hub + reach[:, None] * towards + (grip_m - middle_m) * stick - shoulders[side]
            reach = _reachable(reach, from_shoulder, towards, arm_m)
        return hub + reach[:, None] * towards - middle_m * stick, stick


def _posture(action: Action, times: Array, variation: float, seed: int) -> Array:
    """Channels (T, D) of the key postures of the repetitions around the given times, in ascending order, joined smoothly."""
    key_times = np.array([time for time, _ in action.keys])
    values = np.array([[*astuple(posture)[:-2], *posture.left_foot, *posture.right_foot] for _, posture in action.keys])
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


def tilted_plane(tilt: float) -> Plane:
    """The plane of a swing to the left, whose lowest direction is ``tilt`` degrees from straight down towards forward."""
    angle = np.deg2rad(tilt)
    return (0.0, float(np.sin(angle)), -float(np.cos(angle))), (-1.0, 0.0, 0.0)


def interpolate(knots: Array, values: Array, times: Array) -> Array:
    """Values (T, D) at times (T,) between knots (K,) with values (K, D): quintic pieces with continuous second derivative.

    At a knot the slope is the harmonic mean of its neighbours', or 0 where they differ in sign, and the curvature is 0:
    between two equal values nothing moves, and nothing overshoots.
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


def _trunk_rotations(pose: dict[str, Array], turned: Array) -> Array:
    """Joint rotations (T, 19, 3, 3) of pelvis, spine and neck; the limbs' are left at rest."""
    pelvis, chest = _leaning_turn(pose, "pelvis"), _leaning_turn(pose, "chest")
    head = rotation(2, pose["head_turn"]) @ rotation(0, -pose["head_nod"])
    rotations = np.tile(np.eye(3), (len(turned), len(JOINT_INDEX), 1, 1))
    rotations[:, JOINT_INDEX["pelvis"]] = turned @ pelvis
    rotations[:, JOINT_INDEX["spine"]] = pelvis.swapaxes(-1, -2) @ chest
    rotations[:, JOINT_INDEX["neck"]] = chest.swapaxes(-1, -2) @ head
    return rotations


def _leaning_turn(pose: dict[str, Array], part: str) -> Array:
    return rotation(0, -pose[f"{part}_lean"]) @ rotation(1, pose[f"{part}_side"]) @ rotation(2, pose[f"{part}_turn"])


def _elbow_side(shoulder: Array, wrist: Array, chest: Array, outward: float) -> Array:
    """Where an elbow points: back from a hanging arm, down from a stretched one, forward from a raised one; and outward."""
    right, up = chest[..., 0], chest[..., 2]
    return np.cross(unit(wrist - shoulder), right) + 0.3 * outward * right - 0.9 * up


def _reachable(along: Array, offset: Array, direction: Array, limit_m: float) -> Array:
    """Coordinates (T,) along a direction (T, 3), reduced smoothly where ``offset`` (T, 3) there would exceed a length."""
    part = (offset * direction).sum(-1)
    aside = (offset**2).sum(-1) - part**2
    most = along - part + np.sqrt(np.maximum(limit_m**2 - aside, 0.0))
    share, knee = along / most, 0.9
    eased = knee + (1 - knee) * np.tanh((share - knee) / (1 - knee))
    return most * np.where(share > knee, eased, share)


def _polar(angle: Array, elevation: Array) -> Array:
    """Unit vectors (T, 3): in the plane's axes, then along its normal."""
    a, e = np.deg2rad(angle), np.deg2rad(elevation)
    return np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=-1)


def _apply(rotations: Array, vectors: Array) -> Array:
    return (rotations @ vectors[..., None])[..., 0]
