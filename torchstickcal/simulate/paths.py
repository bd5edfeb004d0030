"""Paths of the athlete on the floor: closed curves, and steps along them in which no planted foot slides."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from torchstickcal.errors import CalibrationError

Array = NDArray[np.float64]

_CORNERS = {"circle": 0, "square": 4, "triangle": 3}
PATHS = ("stay", *_CORNERS, "figure8")
_STEP_M = 0.3
_SWING_SHARE = 0.65
_LIFT_M = 0.10


@dataclass(frozen=True)
class Path:
    """A smooth closed curve on the floor around the origin.

    Circle, triangle and square are the curves ``e^(ia) + k e^(-i(n-1)a)`` with ``|k| = 1 / (n-1)^2``: rounded polygons of n
    corners. The figure 8 is the lemniscate of Gerono.

    Args:
        shape: one of :data:`PATHS`; ``stay`` is the origin itself.
        radius_m: about half the extent of the curve, metres.

    Raises:
        CalibrationError: for an unknown shape.
    """

    shape: str = "stay"
    radius_m: float = 0.5

    def __post_init__(self) -> None:
        if self.shape not in PATHS:
            raise CalibrationError("unknown path", where="path", got=repr(self.shape), expected=f"one of {', '.join(PATHS)}")

    def at(self, laps: Array) -> tuple[Array, Array]:
        """Position on the curve and direction of the curve.

        Args:
            laps: (T,), rounds since the start of the curve.

        Returns:
            Positions (T, 2) in metres and headings (T, 2), unit vectors; the heading of ``stay`` is +y.
        """
        angle = 2 * np.pi * np.asarray(laps)
        if self.shape == "stay":
            return np.zeros((*angle.shape, 2)), np.stack([np.zeros_like(angle), np.ones_like(angle)], axis=-1)
        if self.shape == "figure8":
            position = np.stack([np.sin(angle), np.sin(2 * angle) / 2], axis=-1)
            slope = np.stack([np.cos(angle), np.cos(2 * angle)], axis=-1)
        else:
            turns = _CORNERS[self.shape] - 1
            share = (1 if self.shape == "triangle" else -1) / turns**2 if turns > 0 else 0.0
            position = _circle(angle) + share * _circle(-turns * angle)
            slope = _circle(angle + np.pi / 2) - turns * share * _circle(-turns * angle + np.pi / 2)
        return self.radius_m * position, slope / np.linalg.norm(slope, axis=-1, keepdims=True)


@dataclass(frozen=True)
class Walk:
    """A walk along a part of a path in every repetition of an action, between two times of the repetition.

    Args:
        path: the path.
        laps: part of it that is walked in each repetition, in rounds.
        start_s: time within the repetition at which the walk starts, seconds. end_s: at which it ends.
        period_s: duration of a repetition, seconds.
    """

    path: Path
    laps: float
    start_s: float
    end_s: float
    period_s: float

    def body(self, times: Array) -> tuple[Array, Array]:
        """Position of the athlete on the floor (T, 3), metres, and rotation (T, 3, 3) from body axes to the world.

        The forward axis of the body, y, is the heading.
        """
        cycle, time = np.divmod(times, self.period_s)
        position, heading = self.path.at(self.laps * (cycle + smoothstep((time - self.start_s) / (self.end_s - self.start_s))))
        rotations = np.zeros((*times.shape, 3, 3))
        rotations[..., :2, 0] = np.stack([heading[..., 1], -heading[..., 0]], axis=-1)
        rotations[..., :2, 1] = heading
        rotations[..., 2, 2] = 1.0
        return np.concatenate([position, np.zeros((*times.shape, 1))], axis=-1), rotations

    def foot(self, times: Array, stance: Array, *, leads: bool) -> Array:
        """Positions of a foot (T, 3), metres: planted, or swinging from one planted position to the next.

        Args:
            times: (T,), seconds.
            stance: position of the foot relative to the athlete's position while standing, in body axes, (T, 3).
            leads: whether this foot steps first; the other one follows half a step later.
        """
        begin = self.period_s * np.floor_divide(times, self.period_s)
        half = (self.end_s - self.start_s) / (2 * self._steps - 1 + 2 * _SWING_SHARE)

        def planted(after_s: float) -> Array:
            position, rotation = self.body(begin + after_s)
            return position + (rotation @ stance[..., None])[..., 0]

        foot = before = planted(self.start_s)
        for step in range(self._steps):
            lifted_s = self.start_s + (2 * step + (0 if leads else 1)) * half
            after = planted(self.end_s if step == self._steps - 1 else lifted_s + (1 + _SWING_SHARE) * half)
            share = (times - begin - lifted_s) / (2 * _SWING_SHARE * half)
            height = np.minimum(_LIFT_M, 0.3 * np.linalg.norm(after - before, axis=-1)) * _bump(share)
            foot = foot + smoothstep(share)[..., None] * (after - before)
            foot[..., 2] += height
            before = after
        return foot

    @property
    def _steps(self) -> int:
        """Number of steps of each foot in a repetition."""
        ends, _ = self.path.at(np.linspace(0, self.laps, 33))
        length = np.linalg.norm(np.diff(ends, axis=0), axis=-1).sum()
        return max(1, int(np.ceil(length / (2 * _STEP_M))))


def smoothstep(share: Array) -> Array:
    """A transition from 0 to 1 over [0, 1], constant outside, with continuous second derivative."""
    s = np.clip(share, 0.0, 1.0)
    return s**3 * (10 - 15 * s + 6 * s**2)


def _bump(share: Array) -> Array:
    """From 0 up to 1 at 0.5 and back to 0 at 1, with continuous second derivative."""
    s = np.clip(share, 0.0, 1.0)
    return 64 * s**3 * (1 - s) ** 3


def _circle(angle: Array) -> Array:
    """Points (T, 2) of the unit circle at angles (T,), radians."""
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)
