"""Smoothing of a stick as a rigid body: the place of a point near the hands, and the stick's direction, together.

The ends of a swung stick move on small circles, whose chords are shorter than their arcs. A direction that turns evenly is a
straight line on the sphere and can be averaged over more frames without bias. A point near the hands is slower than the middle
of the stick and is bent less. An error of an end is one of this point and of the direction: both are estimated together, from
all ends around a frame, each weighted by its own covariance. So an end that only two cameras see, or none, harms less.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from torchstickcal.analysis.smoothing import (
    FREQUENCIES,
    TREND,
    covariance,
    covariance_with_slope,
    estimable,
    from_sphere,
    heights,
    likeliest,
    offsets_s,
    on_sphere,
    shifted,
    smoother,
    windows,
)
from torchstickcal.analysis.stick import StickMotion
from torchstickcal.analysis.tracks import Tracks

Array = NDArray[np.float64]

_PIVOT = 0.25
"""Where the point near the hands is, as a share of the way from the first to the second end."""
_LEVERS = np.array([-_PIVOT, 1 - _PIVOT])
"""From this point to the ends, in lengths of the stick"""
_UNKNOWN_RAD = 1.0
"""Standard deviation of a direction of which nothing is known."""
_PLACE, _TURN = slice(0, 3), slice(3, 5)
"""Numbers of a stick: the place of the point, and the direction as a tangent of the sphere"""
_NUMBERS = 5
_CHUNK, _LONG_CHUNK = 48, 512


@dataclass(frozen=True, eq=False)
class _Motion:
    """A random motion around each frame, as of :class:`~torchstickcal.analysis.smoothing.Smoother`; all (T,)."""

    scales_s: Array
    sizes: Array
    smooth: NDArray[np.bool_]

    @classmethod
    def likeliest(cls, near: Array, variances: Array, step: float) -> _Motion:
        """Of values (O, T, D) around frames and their variances (O, T); NaN where a value is not known."""
        known = np.isfinite(variances)
        mean = np.where(known, variances, 0.0).sum(0) / np.maximum(known.sum(0), 1)
        typical = np.sqrt(np.where(mean > 0, mean, 1.0))
        scales, sizes, smooth = likeliest(near[:, :, None] / typical[:, None, None], step)
        return cls(scales[:, 0], sizes[:, 0] * typical, smooth[:, 0])

    def part(self, frames: slice) -> _Motion:
        return _Motion(self.scales_s[frames], self.sizes[frames], self.smooth[frames])


@dataclass(frozen=True, eq=False)
class _Alone:
    """How a stick of known length follows from its ends in one frame alone, by least squares."""

    base: Array
    """(T, 3), about its direction"""
    axes: Array
    """(T, 3, 2), of the tangents of the sphere there"""
    gains: Array
    """(T, 5, 2, 3), derivatives of its numbers by the ends"""
    covariances: Array
    """(T, 5, 5), of its numbers; NaN where no end is known"""

    @classmethod
    def of(cls, base: Array, covariances: Array, length_m: float) -> _Alone:
        """By covariances (T, 2, 3, 3) of the ends; NaN where one is not known."""
        axes = _tangent_axes(base)
        known = np.isfinite(covariances.sum((-2, -1)) + base.sum(-1, keepdims=True))
        precisions = np.linalg.inv(np.where(known[..., None, None], covariances, np.eye(3))) * known[..., None, None]
        design = np.zeros((*known.shape, 3, _NUMBERS))
        design[..., _PLACE] = np.eye(3)
        design[..., _TURN] = length_m * _LEVERS[:, None, None] * np.nan_to_num(axes)[:, None]
        weighted = np.swapaxes(design, -1, -2) @ precisions
        prior = np.diag([0.0] * 3 + [_UNKNOWN_RAD**-2] * 2)
        some = known.any(-1)[:, None, None]
        found = np.linalg.inv(np.where(some, (weighted @ design).sum(1) + prior, np.eye(_NUMBERS)))
        gains = (found[:, None] @ weighted).swapaxes(1, 2)
        return cls(base, axes, gains, np.where(some, found, np.nan))

    def __call__(self, ends: Array, lengths_m: Array) -> tuple[Array, Array]:
        """Places and directions (N, T, 3) of sticks with ends (N, T, 2, 3) and lengths (N,)."""
        rest = ends - lengths_m[:, None, None, None] * _LEVERS[:, None] * self.base[:, None]
        numbers = np.einsum("tijk,ntjk->nti", self.gains, np.nan_to_num(rest))
        turned = self.base + np.einsum("tij,ntj->nti", self.axes, numbers[..., _TURN])
        none = np.isnan(self.covariances[:, :1, 0])
        return np.where(none, np.nan, numbers[..., _PLACE]), np.where(none, np.nan, _unit(turned))


@dataclass(frozen=True, eq=False)
class StickSmoother:
    """The weights with which the sticks of frames around a frame are averaged."""

    ends: tuple[int, int]
    times: Array
    """(T,), seconds"""
    alone: _Alone
    weights: Array
    """(O, T, 2, 5, 5), of the numbers at each offset, for the numbers and their derivatives by time; NaN where nothing can be
    estimated"""
    motions: tuple[_Motion, _Motion]
    """of the place and of the direction"""

    @classmethod
    def of(cls, tracks: Tracks, stick: int) -> StickSmoother:
        """Choose how to smooth a stick of the recording."""
        start, end, length_m, _ = tracks.sticks[stick]
        ends, roots = tracks.points[:, [start, end]], tracks.roots[:, [start, end]]
        variances = tracks.variances[:, [start, end]].sum(1, keepdims=True) / length_m**2
        along = _direction(ends)[:, None]
        base = _unit(smoother(tracks.times, along, variances)(along)[0])[:, 0]
        alone = _Alone.of(base, roots @ np.swapaxes(roots, -1, -2), length_m)
        whole = np.isfinite(variances[:, 0]) & np.isfinite(alone.covariances[:, 0, 0])
        step, reach, farthest = windows(tracks.times)
        offsets = range(-reach, reach + 1)
        near = np.stack([_seen_from(alone, *alone(ends[None], np.array([length_m])), offset)[0] for offset in offsets])
        noise = np.stack([_noise_from(alone, offset) for offset in offsets])
        noise[~np.isfinite(near).all(-1)] = np.nan
        whole_there = np.stack([shifted(whole[:, None, None] * 1.0, offset)[:, 0, 0] for offset in offsets]) == 1
        near[~whole_there] = np.nan
        own = np.where(np.isfinite(near), np.diagonal(noise, axis1=2, axis2=3), np.nan)
        motions = [_Motion.likeliest(near[..., part], own[..., part].mean(-1), step) for part in (_PLACE, _TURN)]
        apart = np.stack([offsets_s(tracks.times, offset) for offset in offsets])
        weights = np.empty((len(near), len(base), 2, _NUMBERS, _NUMBERS))
        for first in range(0, len(base), _CHUNK):
            frames = slice(first, first + _CHUNK)
            weights[:, frames] = _weights(apart[:, frames], noise[:, frames], [motion.part(frames) for motion in motions])
        possible = estimable(whole[:, None], np.isfinite(near.sum(-1, keepdims=True)), farthest)[:, 0]
        weights = np.where(possible[..., None, None], weights, np.nan)
        return cls((start, end), tracks.times, alone, weights, (motions[0], motions[1]))

    def __call__(self, points: Array, lengths_m: Array, seed: int = 0) -> StickMotion:
        """The motion by points (N, T, P, 3), with sticks of lengths (N,): of an estimate and N - 1 draws of its errors.

        To each draw is added what smoothing leaves out of a motion, which is drawn at random by ``seed``.
        """
        place, direction = self.alone(points[:, :, list(self.ends)], lengths_m)
        reach = len(self.weights) // 2
        found = np.zeros((2, *place.shape[:2], _NUMBERS))
        for offset, weights in zip(range(-reach, reach + 1), self.weights, strict=True):
            used = (np.nan_to_num(weights) != 0).any((1, 2, 3))[:, None]
            near = np.where(used, _seen_from(self.alone, place, direction, offset), 0.0)
            found += np.einsum("tkij,ntj->knti", weights, near, optimize=True)
        found[:, 1:] += self._left_out(len(points) - 1, np.random.default_rng((seed, 2)))
        turn = (self.alone.axes @ found[..., _TURN, None])[..., 0][:, :, :, None]
        direction, rate = (part[:, :, 0] for part in from_sphere(self.alone.base[:, None], *turn))
        levers = lengths_m[:, None, None] * _LEVERS[:, None, None, None]
        start, tip = found[0, ..., _PLACE] + levers * direction
        start_velocity, tip_velocity = found[1, ..., _PLACE] + levers * rate
        return StickMotion(start, tip, start_velocity, tip_velocity, np.linalg.norm(rate, axis=-1))

    def _left_out(self, count: int, rng: np.random.Generator) -> Array:
        """What smoothing leaves out of random motions and of their derivatives, (2, N, T, 5).

        A motion is a sum of waves, whose phases advance with the time over its scale. Smoothing multiplies a wave by the sum of
        the weights times the wave at the offsets.
        """
        frames, step = len(self.times), np.diff(self.times, prepend=self.times[:1])
        missed = np.zeros((2, count, frames, _NUMBERS))
        for part, motion in zip((_PLACE, _TURN), self.motions, strict=True):
            phases = np.exp(1j * np.cumsum(step / motion.scales_s)[:, None] * FREQUENCIES)
            waves = motion.sizes[:, None] * np.where(motion.smooth[:, None], heights(7), heights(5)) * phases
            coefficients = rng.standard_normal((2, (part.stop - part.start) * len(FREQUENCIES), count))
            for first in range(0, frames, _LONG_CHUNK):
                near = slice(first, first + _LONG_CHUNK)
                lost = self._lost(part, motion, near) * waves[near, None, None, None]
                parts = np.stack([lost.real, -lost.imag]).reshape(2, -1, coefficients.shape[1])
                drawn = (parts @ coefficients).sum(0).reshape(len(lost), 2, _NUMBERS, count)
                missed[:, :, near] += drawn.transpose(1, 3, 0, 2)
        return missed

    def _lost(self, part: slice, motion: _Motion, near: slice) -> NDArray[np.complex128]:
        """What smoothed numbers and derivatives lack of the waves of some numbers in some frames, (T, 2, 5, numbers, waves)."""
        scales, reach = motion.scales_s[near], len(self.weights) // 2
        lost = np.zeros((len(scales), 2, _NUMBERS, part.stop - part.start, len(FREQUENCIES)), dtype=complex)
        for offset, weights in zip(range(-reach, reach + 1), self.weights[:, near, ..., part], strict=True):
            wave = np.exp(1j * (offsets_s(self.times, offset)[near] / scales)[:, None] * FREQUENCIES)
            lost -= weights[..., None] * wave[:, None, None, None]
        for axis, number in enumerate(range(part.start, part.stop)):
            lost[:, 0, number, axis] += 1
            lost[:, 1, number, axis] += 1j * FREQUENCIES / scales[:, None]
        return lost


def _seen_from(alone: _Alone, place: Array, direction: Array, offset: int) -> Array:
    """Numbers (N, T, 5) of the sticks of ``offset`` frames later, with their directions as tangents at each frame."""
    there = on_sphere(alone.base[:, None])(direction[:, :, None], offset)[:, :, 0]
    turn = np.einsum("tij,nti->ntj", alone.axes, there)
    return np.concatenate([shifted(place[:, :, None], offset)[:, :, 0], turn], axis=-1)


def _noise_from(alone: _Alone, offset: int) -> Array:
    """Covariances (T, 5, 5) of these numbers."""
    base, axes, covariances = (
        shifted(part.reshape(len(part), 1, -1), offset).reshape(part.shape)
        for part in (alone.base, alone.axes, alone.covariances)
    )
    change = np.zeros((len(base), _NUMBERS, _NUMBERS))
    change[:, _PLACE, _PLACE] = np.eye(3)
    change[:, _TURN, _TURN] = np.swapaxes(alone.axes, -1, -2) @ _tangents_derivative(alone.base, base) @ axes
    return change @ covariances @ np.swapaxes(change, -1, -2)


def _tangents_derivative(base: Array, direction: Array) -> Array:
    """Derivatives (T, 3, 3) of the tangents at ``base`` (T, 3), as of :func:`on_sphere`, by the directions (T, 3)."""
    cosine = np.clip((base * direction).sum(-1, keepdims=True), -1.0, 1.0)
    aside = direction - cosine * base
    sine = np.linalg.norm(aside, axis=-1, keepdims=True)
    away = np.where(sine > 1e-9, aside / np.maximum(sine, 1e-9), _tangent_axes(base)[..., 0])
    beside = np.cross(base, away)
    stretch = np.where(sine > 1e-9, np.arctan2(sine, cosine) / np.maximum(sine, 1e-9), 1.0)
    along = cosine * away - sine * base
    return away[:, :, None] * along[:, None] + (stretch * beside)[:, :, None] * beside[:, None]


def _tangent_axes(base: Array) -> Array:
    """Two unit vectors (T, 3, 2) perpendicular to unit vectors (T, 3) and to each other."""
    other = np.eye(3)[np.abs(np.nan_to_num(base)).argmin(-1)]
    first = _unit(np.cross(base, other))
    return np.stack([first, np.cross(base, first)], axis=-1)


def _weights(apart: Array, noise: Array, motions: list[_Motion]) -> Array:
    """Best weights (O, T, 2, 5, 5) of the numbers around each frame, for those there and for their derivatives.

    Args:
        apart: (O, T), seconds from the frame.
        noise: (O, T, 5, 5), covariances of the numbers; NaN where not known.
        motions: of the place and of the direction.
    """
    count, frames = apart.shape
    seen = np.isfinite(noise[..., 0, 0]).T
    both = seen[:, :, None] & seen[:, None]
    of_all = np.zeros((frames, _NUMBERS, count, _NUMBERS, count))
    right = np.zeros((frames, _NUMBERS, count, 2, 2, _NUMBERS))  # motion and line; value and slope
    for part, motion in zip((_PLACE, _TURN), motions, strict=True):
        at, smooth, power = apart.T / motion.scales_s[:, None], motion.smooth[:, None], np.square(motion.sizes)[:, None]
        alike = np.where(both, power[..., None] * covariance(at[:, :, None] - at[:, None], smooth[..., None]), 0.0)
        with_slope = power * covariance_with_slope(at, smooth) / motion.scales_s[:, None]
        columns = np.array([[power * covariance(at, smooth), with_slope], [np.ones_like(at), apart.T]])
        for number in range(part.start, part.stop):
            of_all[:, number, :, number] = alike
            right[:, number, ..., number] = np.where(seen[..., None, None], np.moveaxis(columns, (0, 1), (2, 3)), 0.0)
    diagonal = np.arange(count)
    of_all[:, :, diagonal, :, diagonal] += np.where(seen.T[..., None, None], noise, np.eye(_NUMBERS))
    size = _NUMBERS * count
    right = right.reshape(frames, size, 2, 2 * _NUMBERS)
    solved = np.linalg.solve(of_all.reshape(frames, size, size), right.reshape(frames, size, -1)).reshape(right.shape)
    line = right[:, :, 1].swapaxes(1, 2)
    determined = (seen.sum(-1) > TREND)[:, None, None]
    moments = np.where(determined, line @ solved[:, :, 1], np.eye(2 * _NUMBERS))
    wanted = np.eye(2 * _NUMBERS) - line @ solved[:, :, 0]
    best = solved[:, :, 0] + solved[:, :, 1] @ np.linalg.solve(moments, wanted)
    return best.reshape(frames, _NUMBERS, count, 2, _NUMBERS).transpose(2, 0, 3, 4, 1)


def _direction(ends: Array) -> Array:
    """Unit vectors (..., 3) from the start to the end of sticks (..., 2, 3)."""
    return _unit(ends[..., 1, :] - ends[..., 0, :])


def _unit(vectors: Array) -> Array:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)
