"""The motion of a stick: where its ends are, how fast, and in which plane it is swung."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from torchstickcal.analysis.interpolation import at

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class StickMotion:
    """A stick over time, smoothed; (N, T, ...) for the estimate and N - 1 draws of its errors."""

    start: Array
    """(N, T, 3), metres"""
    tip: Array
    """(N, T, 3), metres"""
    start_velocity: Array
    """(N, T, 3), metres per second"""
    tip_velocity: Array
    """(N, T, 3), metres per second"""
    turn_rate: Array
    """(N, T), how fast the stick's direction turns, radians per second"""

    @property
    def tip_speed(self) -> Array:
        """(N, T), metres per second."""
        return np.linalg.norm(self.tip_velocity, axis=-1)

    @property
    def whole_speed(self) -> Array:
        """(N, T), root mean square of the speeds of all points of the stick, metres per second."""
        first, last = self.start_velocity, self.tip_velocity
        return np.sqrt((np.square(first) + first * last + np.square(last)).sum(-1) / 3)

    def finer(self, times: Array, count: int) -> tuple[Array, StickMotion]:
        """Times (count * (T - 1) + 1,) and the motion at them, by cubic polynomials between the frames (T,)."""
        frames = np.arange(len(times))
        moments = np.interp(np.arange(count * (len(times) - 1) + 1) / count, frames, times)
        parts = (self.start, self.tip, self.start_velocity, self.tip_velocity)
        start, tip, start_velocity, tip_velocity = (
            np.moveaxis(at(times, np.moveaxis(part, 1, 0), moments), 0, 1) for part in parts
        )
        turn_rate = np.linalg.norm(tip_velocity - start_velocity, axis=-1) / np.linalg.norm(tip - start, axis=-1)
        return moments, StickMotion(start, tip, start_velocity, tip_velocity, turn_rate)
