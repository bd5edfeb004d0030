"""The motion of a stick: where its ends are, how fast, and in which plane it is swung."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from torchstickcal.analysis.interpolation import at
from torchstickcal.analysis.smoothing import Smoother, from_sphere, on_sphere, smoother
from torchstickcal.analysis.tracks import Tracks

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


@dataclass(frozen=True, eq=False)
class StickSmoother:
    """A stick as its middle and its direction: the middle is smoothed in space, the direction on the sphere.

    The ends of a swung stick move on small circles, whose chords are shorter than their arcs. The direction turns evenly and
    can be averaged over more frames without bias. The length is the given one.
    """

    ends: tuple[int, int]
    middle: Smoother
    base: Array
    """(T, 1, 3), about the stick's direction in each frame"""
    direction: Smoother

    @classmethod
    def of(cls, tracks: Tracks, stick: int) -> StickSmoother:
        """Choose windows for a stick of the recording."""
        start, end, length_m, _ = tracks.sticks[stick]
        ends, variances = tracks.points[:, [start, end]], tracks.variances[:, [start, end]].sum(1, keepdims=True)
        along = _direction(ends)[:, None]
        base = _unit(smoother(tracks.times, along, variances / length_m**2)(along)[0])
        return cls(
            (start, end),
            smoother(tracks.times, ends.mean(1, keepdims=True), variances / 4),
            base,
            smoother(tracks.times, along, variances / length_m**2, on_sphere(base)),
        )

    def __call__(self, points: Array, lengths_m: Array, seed: int = 0) -> StickMotion:
        """The motion by points (N, T, P, 3), with sticks of lengths (N,); ``seed`` as of a smoother."""
        ends = points[:, :, list(self.ends)]
        middle, velocity = self.middle(ends.mean(2, keepdims=True), (seed, 2))
        direction, rate = from_sphere(self.base, *self.direction(_direction(ends)[:, :, None], (seed, 3)))
        half = 0.5 * lengths_m[:, None, None, None]
        parts = middle - half * direction, middle + half * direction, velocity - half * rate, velocity + half * rate
        start, tip, start_velocity, tip_velocity = (part[:, :, 0] for part in parts)
        return StickMotion(start, tip, start_velocity, tip_velocity, np.linalg.norm(rate[:, :, 0], axis=-1))


def _direction(ends: Array) -> Array:
    """Unit vectors (..., 3) from the start to the end of sticks (..., 2, 3)."""
    return _unit(ends[..., 1, :] - ends[..., 0, :])


def _unit(vectors: Array) -> Array:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)
