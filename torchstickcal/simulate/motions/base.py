"""What defines a sport: its stick, and the key postures of its action. The registry of sports."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from torchstickcal.errors import ConfigError
from torchstickcal.registry import Registry

Plane = tuple[tuple[float, float, float], tuple[float, float, float]]


@dataclass(frozen=True)
class Posture:
    """A key posture of the athlete.

    Body axes: x to the athlete's right, y forward, z up. Angles are in degrees, lengths in metres for an athlete of 1.76 m;
    they are scaled for other heights. Positive turns are to the left (counter-clockwise seen from above), positive leans are
    forward, positive side bends are to the right.

    Args:
        sway_m: position of the pelvis to the right of the athlete's position on the floor.
        forward_m: position of the pelvis in front of it.
        height_m: height of the pelvis above the floor.
        pelvis_turn: of the pelvis relative to the athlete's heading, about the spine. pelvis_lean, pelvis_side: likewise.
        chest_turn: of the chest relative to the athlete's heading, about the spine. chest_lean, chest_side: likewise.
        head_turn: of the head relative to the athlete's heading. head_nod: likewise, positive forward.
        arms_angle: direction from the midpoint of the shoulders to the midpoint of the grips, as an angle in the action's
            swing plane: 0 is the lowest direction of the plane, 90 to the left, -90 to the right, 180 overhead.
            arms_elevation: of that direction out of the swing plane. arms_reach_m: the distance.
        stick_angle: angle in the swing plane from the direction of the arms to that of the stick.
        stick_elevation: of the stick out of the swing plane.
        left_foot: position of the left sole (below the ankle) relative to the athlete's position on the floor, metres.
        right_foot: of the right sole.
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


@dataclass(frozen=True)
class Action:
    """The action of a sport: one repetition, described by key postures.

    Args:
        stick_m: length of the stick, metres.
        stick_names: names of the stick's two points: its start, near the hands, and its end.
        grips_m: by side (``"left"``, ``"right"``), the distance from the stick's start at which that hand holds it, metres.
            A side that is left out holds nothing.
        plane: the swing plane in body axes, as two orthogonal unit vectors: the direction of angle 0 and that of 90 degrees.
        keys: times in seconds, increasing from 0, each with its posture.
        period_s: duration of a repetition, seconds; after it the first posture comes again.
        walk_s: interval within the repetition, seconds, in which the athlete may walk.

    Raises:
        ConfigError: for times that do not increase from 0 within the period, and for grips that are not on the stick.

    Example:
        >>> from torchstickcal.simulate import Action, Posture, tilted_plane
        >>> ready, hit = Posture(arms_angle=-60), Posture(arms_angle=60)
        >>> tennis = Action(
        ...     stick_m=0.69,
        ...     stick_names=("racket_butt", "racket_tip"),
        ...     grips_m={"right": 0.08},
        ...     plane=tilted_plane(80),
        ...     keys=((0.0, ready), (0.6, hit)),
        ...     period_s=2.0,
        ...     walk_s=(1.0, 1.9),
        ... )
        >>> tennis.keys[1][1].arms_angle
        60
    """

    stick_m: float
    stick_names: tuple[str, str]
    grips_m: Mapping[str, float]
    plane: Plane
    keys: tuple[tuple[float, Posture], ...]
    period_s: float
    walk_s: tuple[float, float]

    def __post_init__(self) -> None:
        times = [time for time, _ in self.keys]
        if not times or times[0] != 0 or any(late <= early for early, late in pairwise([*times, self.period_s])):
            got = f"{times}, period_s = {self.period_s}"
            raise ConfigError(
                "unusable times", where="Action.keys", got=got, expected="0, and then increasing up to the period"
            )
        if not 0 <= self.walk_s[0] < self.walk_s[1] <= self.period_s:
            expected = f"start and end between 0 and {self.period_s}"
            raise ConfigError("unusable interval", where="Action.walk_s", got=self.walk_s, expected=expected)
        if not self.grips_m or not set(self.grips_m) <= {"left", "right"}:
            raise ConfigError(
                "unknown hand", where="Action.grips_m", got=list(self.grips_m), expected="'left', 'right' or both"
            )
        if not all(0 <= grip_m <= self.stick_m for grip_m in self.grips_m.values()):
            expected = f"distances from 0 to {self.stick_m}, the length of the stick"
            raise ConfigError("a hand beside the stick", where="Action.grips_m", got=dict(self.grips_m), expected=expected)


SPORTS: Registry[Action] = Registry("sport", "torchstickcal.simulate.motions")
"""The action of each sport, by name.

A module of this folder, or one of your own, adds a sport with ``SPORTS.register("tennis", Action(...))``.
"""


def action(sport: str) -> Action:
    """The action of a registered sport.

    Args:
        sport: name of the sport.

    Raises:
        ConfigError: if no sport of that name is registered; the message lists those that are.

    Example:
        >>> action("golf").stick_m
        1.0
    """
    return SPORTS[sport]


def tilted_plane(tilt_deg: float) -> Plane:
    """The plane of a swing to the left.

    Args:
        tilt_deg: angle from straight down to the lowest direction of the plane, towards forward; 90 is a horizontal plane.

    Returns:
        Two orthogonal unit vectors in body axes: the lowest direction of the plane (angle 0), and left (angle 90 degrees).
    """
    angle = np.deg2rad(tilt_deg)
    return (0.0, float(np.sin(angle)), -float(np.cos(angle))), (-1.0, 0.0, 0.0)
