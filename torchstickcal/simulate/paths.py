"""Where the athlete goes: closed curves on the floor, and steps along them that leave no foot sliding."""

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
    """A closed curve, once around for each whole number of laps, smooth in all its derivatives.

    Circle, triangle and square are the trigonometric curves ``e^(ia) + k e^(-i(n-1)a)`` whose sides are as straight as two
    terms can make them, ``|k| = 1 / (n-1)^2``; the figure 8 is Gerono's lemniscate.

    Args:
        shape: one of :data:`PATHS`.
        radius_m: half its longest extent, about.
    """

    shape: str = "stay"
    radius_m: float = 0.5

    def __post_init__(self) -> None:
        if self.shape not in PATHS:
            raise CalibrationError("unknown path", where="path", got=repr(self.shape), expected=f"one of {', '.join(PATHS)}")

    def at(self, laps: Array) -> tuple[Array, Array]:
        """Positions (T, 2) and headings (T, 2), unit vectors, after a number of laps (T,); standing still, heading +y."""
        angle = 2 * np.pi * np.asarray(laps)
        if self.shape == "stay":
            return np.zeros((*angle.shape, 2)), np.stack([np.zeros_like(angle), np.ones_like(angle)], axis=-1)
        if self.shape == "figure8":
            place = np.stack([np.sin(angle), np.sin(2 * angle) / 2], axis=-1)
            slope = np.stack([np.cos(angle), np.cos(2 * angle)], axis=-1)
        else:
            turns = _CORNERS[self.shape] - 1
            share = (1 if self.shape == "triangle" else -1) / turns**2 if turns > 0 else 0.0
            place = _circle(angle) + share * _circle(-turns * angle)
            slope = _circle(angle + np.pi / 2) - turns * share * _circle(-turns * angle + np.pi / 2)
        return self.radius_m * place, slope / np.linalg.norm(slope, axis=-1, keepdims=True)


@dataclass(frozen=True)
class Walk:
    """Going a part of a path in every cycle of an action, between two times of the cycle, and standing otherwise.

    Args:
        path: the path.
        laps: how much of it in a cycle.
        start_s: when in the cycle the walk begins. end_s: when it ends. period_s: duration of a cycle.
    """

    path: Path
    laps: float
    start_s: float
    end_s: float
    period_s: float

    def body(self, times: Array) -> tuple[Array, Array]:
        """Position (T, 3) on the floor and rotation (T, 3, 3) of the athlete, whose forward axis y is the heading."""
        cycle, time = np.divmod(times, self.period_s)
        place, heading = self.path.at(self.laps * (cycle + smoothstep((time - self.start_s) / (self.end_s - self.start_s))))
        rotations = np.zeros((*times.shape, 3, 3))
        rotations[..., :2, 0] = np.stack([heading[..., 1], -heading[..., 0]], axis=-1)
        rotations[..., :2, 1] = heading
        rotations[..., 2, 2] = 1.0
        return np.concatenate([place, np.zeros((*times.shape, 1))], axis=-1), rotations

    def foot(self, times: Array, stance: Array, *, leads: bool) -> Array:
        """A foot (T, 3) whose place beside the standing body is ``stance`` (T, 3): planted, or on its way between plants.

        Of two feet one leads and the other follows by half a step.
        """
        begin = self.period_s * np.floor_divide(times, self.period_s)
        half = (self.end_s - self.start_s) / (2 * self._steps - 1 + 2 * _SWING_SHARE)

        def planted(after_s: float) -> Array:
            place, turned = self.body(begin + after_s)
            return place + (turned @ stance[..., None])[..., 0]

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
        """Steps of each foot in a cycle."""
        ends, _ = self.path.at(np.linspace(0, self.laps, 33))
        length = np.linalg.norm(np.diff(ends, axis=0), axis=-1).sum()
        return max(1, int(np.ceil(length / (2 * _STEP_M))))


def smoothstep(share: Array) -> Array:
    """From 0 to 1 over [0, 1], constant outside, with continuous second derivative."""
    s = np.clip(share, 0.0, 1.0)
    return s**3 * (10 - 15 * s + 6 * s**2)


def _bump(share: Array) -> Array:
    s = np.clip(share, 0.0, 1.0)
    return 64 * s**3 * (1 - s) ** 3


def _circle(angle: Array) -> Array:
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)
