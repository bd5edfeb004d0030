"""Smoothing by Gaussian processes whose time scale and size follow the motion.

Around each frame a track is a straight line plus a random smooth motion (a Gaussian process with a Matern covariance of
smoothness 7/2, or of 5/2 where that is much more likely). How fast and how far this motion goes is what makes the values around
the frame most likely, given the noise of the keypoints. A stick at rest is averaged over all frames around, a fast one over
few. What smoothing leaves out has a known size too: it is drawn together with the errors of the keypoints.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Neighbours = Callable[[Array, int], Array]
"""Values (..., T, S, D), and an offset in frames, to the values of those frames as they are averaged, (..., T, S, D)"""

SCALES_S = 0.03 * 2 ** (np.arange(10) / 2)
"""Time scales of motions that are tried, seconds: within one, a motion changes its direction."""
SIZES = 10 ** np.arange(-1.0, 4.25, 0.5)
"""Sizes of motions that are tried, in standard deviations of the values."""
_REACH_S, _REACH_FRAMES = 0.135, (8, 24)
"""How far before and after a frame values are used, and the least and the largest number of frames."""
_FARTHEST_FRAMES, _FARTHEST_S = 3, 0.025
"""How far from a frame in which a point is known it is still estimated; the larger of both."""
_ROUGHER = 2.0
"""By how much the logarithm of the likelihood of a less smooth motion must be larger for this motion to be taken: 7 times."""
BESIDE = 2
"""So many values are known before and after a frame whose velocity is estimated."""
TREND = 2
"""Numbers of a straight line"""
_FARTHEST_TURN_RAD = 1.75
FREQUENCIES = np.geomspace(0.02, 60.0, 64)
"""Of the random motions, radians per time scale"""
_CHUNK = 2048


def shifted(values: Array, offset: int) -> Array:
    """Values (T, S, D) of ``offset`` frames later, also (..., T, S, D); NaN where there is none.

    Example:
        >>> shifted(np.arange(3.0).reshape(3, 1, 1), 1).ravel()
        array([ 1.,  2., nan])
    """
    out = np.full_like(values, np.nan)
    frames = values.shape[-3]
    if abs(offset) < frames:
        to, of = slice(max(0, -offset), frames - max(0, offset)), slice(max(0, offset), frames + min(0, offset))
        out[..., to, :, :] = values[..., of, :, :]
    return out


@dataclass(frozen=True, eq=False)
class Smoother:
    """The weights with which frames are averaged, and the motions for which they are best."""

    times: Array
    """(T,), seconds"""
    weights: Array
    """(O, T, S, 2), of each offset, for the value and for its derivative by time; NaN where nothing can be estimated"""
    scales_s: Array
    """(T, S), time scales of the motion, seconds"""
    sizes: Array
    """(T, S), standard deviations of the motion along an axis, in the unit of the values"""
    smooth: NDArray[np.bool_]
    """(T, S), whether the motion is very smooth: Matern of smoothness 7/2, else 5/2"""
    neighbours: Neighbours

    def __call__(self, values: Array, seed: int | tuple[int, ...] = 0) -> tuple[Array, Array]:
        """Values (T, S, D), or an estimate and draws of its errors (N, T, S, D), smoothed, and their derivatives, per second.

        To each draw is added what smoothing leaves out of a motion, which is drawn at random by ``seed``.
        """
        reach = len(self.weights) // 2
        value, slope = np.zeros_like(values), np.zeros_like(values)
        for offset, of_offset in zip(range(-reach, reach + 1), self.weights, strict=True):
            used = (np.nan_to_num(of_offset) != 0).any(-1)[..., None]
            near = np.where(used, self.neighbours(values, offset), 0.0)
            value += of_offset[..., :1] * near
            slope += of_offset[..., 1:] * near
        if values.ndim == 4:
            rng = np.random.default_rng(seed)
            for track in range(values.shape[2]):
                missed = self._left_out(track, len(values) - 1, values.shape[3], rng)
                value[1:, :, track] += missed[0]
                slope[1:, :, track] += missed[1]
        return value, slope

    def _left_out(self, track: int, count: int, axes: int, rng: np.random.Generator) -> tuple[Array, Array]:
        """What smoothing leaves out of random motions of a track, and of their derivatives, (N, T, D) each.

        A motion is a sum of waves, whose phases advance with the time over its scale. Smoothing multiplies a wave by the sum of
        the weights times the wave at the offsets.
        """
        coefficients = rng.standard_normal((2, len(FREQUENCIES), count * axes))
        waves = coefficients[0] + 1j * coefficients[1]
        scales, step = self.scales_s[:, track], np.diff(self.times, prepend=self.times[:1])
        phases = np.exp(1j * np.cumsum(step / scales)[:, None] * FREQUENCIES)
        kept = np.zeros((2, *phases.shape), dtype=complex)
        reach = len(self.weights) // 2
        for offset, of_offset in zip(range(-reach, reach + 1), self.weights[:, :, track], strict=True):
            wave = np.exp(1j * (offsets_s(self.times, offset) / scales)[:, None] * FREQUENCIES)
            kept += of_offset.T[:, :, None] * wave
        size = self.sizes[:, track, None] * np.where(self.smooth[:, track, None], heights(7), heights(5))
        missed = (size * phases * (1 - kept[0]), size * phases * (1j * FREQUENCIES / scales[:, None] - kept[1]))
        value, slope = ((part @ waves).real.reshape(len(scales), count, axes).swapaxes(0, 1) for part in missed)
        return value, slope


def smoother(times: Array, values: Array, variances: Array, neighbours: Neighbours = shifted) -> Smoother:
    """Choose the scale and the size of the motion of tracks, frame by frame, and the weights that are best for it.

    Args:
        times: (T,), seconds, ascending.
        values: (T, S, D), NaN where not known.
        variances: (T, S), of the values along each of the D axes.
        neighbours: how values of other frames are seen from a frame.

    Example:
        >>> times, rng = np.arange(200) / 100, np.random.default_rng(0)
        >>> track = np.sin(2 * np.pi * times)[:, None, None] + 0.01 * rng.standard_normal((200, 1, 1))
        >>> smooth = smoother(times, track, np.full((200, 1), 1e-4))
        >>> value, slope = smooth(track)
        >>> bool(np.abs(value[:, 0, 0] - np.sin(2 * np.pi * times))[5:-5].max() < 0.02)
        True
    """
    frames = len(times)
    step, reach, farthest = windows(times)
    offsets = range(-reach, reach + 1)
    known = np.isfinite(values).all(-1) & np.isfinite(variances) & (variances > 0)
    usable = np.where(known, variances, np.nan)
    typical = np.array([np.median(v[np.isfinite(v)]) if np.isfinite(v).any() else 1.0 for v in usable.T])
    near = np.stack([neighbours(np.where(known[..., None], values, np.nan), offset) for offset in offsets])
    scales, sizes, smooth = likeliest(near / np.sqrt(typical)[:, None], step)
    noise = np.stack([shifted(usable[..., None] / typical[:, None], offset)[..., 0] for offset in offsets])
    noise[~np.isfinite(near).all(-1)] = np.nan
    apart = np.stack([offsets_s(times, offset) for offset in offsets])
    weights = np.empty((*noise.shape, 2))
    for first in range(0, frames, max(1, _CHUNK // max(1, values.shape[1]))):
        part = slice(first, first + max(1, _CHUNK // max(1, values.shape[1])))
        weights[:, part] = _weights(apart[:, part], noise[:, part], scales[part], sizes[part], smooth[part])
    weights = np.where(estimable(known, np.isfinite(noise), farthest), weights, np.nan)
    return Smoother(times, weights, scales, sizes * np.sqrt(typical), smooth, neighbours)


def windows(times: Array) -> tuple[float, int, int]:
    """Seconds between frames at times (T,), how many frames before and after one are used, and how far from a frame in which
    something is known it is still estimated, in frames.
    """
    frames = len(times)
    step = float(np.median(np.diff(times))) if frames > 1 else 1.0
    reach = min(max(frames - 1, BESIDE), int(np.clip(round(_REACH_S / step), *_REACH_FRAMES)))
    return step, reach, max(_FARTHEST_FRAMES, round(_FARTHEST_S / step))


def estimable(known: NDArray[np.bool_], seen: NDArray[np.bool_], farthest: int) -> NDArray[np.bool_]:
    """Of which frames the value and its derivative can be estimated, (T, S, 2).

    Args:
        known: (T, S), where there is a value.
        seen: (O, T, S), where there is one of those that are averaged.
        farthest: frames from one with a value.
    """
    reach = len(seen) // 2
    value = _near_a_value(known, farthest) & (seen.sum(0) > TREND)
    return np.stack([value, value & (seen[:reach].sum(0) >= BESIDE) & (seen[reach + 1 :].sum(0) >= BESIDE)], axis=-1)


def offsets_s(times: Array, offset: int) -> Array:
    """(T,), seconds from each frame to the one ``offset`` frames later; 0 where there is none."""
    return np.nan_to_num((shifted(times[:, None, None], offset) - times[:, None, None])[:, 0, 0])


def covariance(apart: Array, smooth: NDArray[np.bool_] | bool) -> Array:
    """Of a motion of size 1 at times apart by so many time scales: Matern of smoothness 7/2 or 5/2."""
    z = np.where(smooth, np.sqrt(7.0), np.sqrt(5.0)) * np.abs(apart)
    return np.where(smooth, 1 + z + 0.4 * z**2 + z**3 / 15, 1 + z + z**2 / 3) * np.exp(-z)


def covariance_with_slope(apart: Array, smooth: NDArray[np.bool_] | bool) -> Array:
    """Of the derivative of such a motion at 0 with its values at times ``apart``."""
    z = np.where(smooth, np.sqrt(7.0), np.sqrt(5.0)) * np.abs(apart)
    return np.where(smooth, 1.4 * (1 + z + z**2 / 3), 5 / 3 * (1 + z)) * apart * np.exp(-z)


def heights(freedom: int) -> Array:
    """Of waves of :data:`FREQUENCIES` that make a motion of size 1 and smoothness ``freedom / 2``."""
    power = (1 + FREQUENCIES**2 / freedom) ** (-(freedom + 1) / 2) * np.gradient(FREQUENCIES)
    return np.sqrt(power / power.sum())


def likeliest(near: Array, step: float) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Scales in seconds, sizes and smoothness (T, S) that make the values (O, T, S, D) around each frame most likely.

    Args:
        near: values in standard deviations.
        step: seconds between two frames.
    """
    count, frames, tracks, axes = near.shape
    values = _bridged(near.reshape(count, frames * tracks, axes))
    seconds = step * (np.arange(count) - count // 2)
    best = np.full(frames * tracks, -np.inf)
    chosen = np.zeros((3, frames * tracks), dtype=np.intp)
    patterns, of_pattern = np.unique(np.isfinite(values).all(-1), axis=1, return_inverse=True)
    for number, pattern in enumerate(patterns.T):
        if pattern.sum() <= TREND:
            continue
        index = np.flatnonzero(of_pattern == number)
        at = seconds[pattern]
        free = np.linalg.qr(np.stack([np.ones_like(at), at], axis=-1), mode="complete")[0][:, TREND:]
        seen = free.T @ values[pattern][:, index].reshape(pattern.sum(), -1)
        for smooth, (of_scale, scale) in product((True, False), enumerate(SCALES_S)):
            spread, directions = np.linalg.eigh(free.T @ covariance((at[:, None] - at) / scale, smooth) @ free)
            squares = np.square(directions.T @ seen).reshape(len(spread), -1, axes).sum(-1)
            variances = 1 + SIZES[:, None] ** 2 * np.maximum(spread, 0.0)
            likelihood = -0.5 * ((1 / variances) @ squares + axes * np.log(variances).sum(-1, keepdims=True))
            of_size = likelihood.argmax(0)
            value = np.take_along_axis(likelihood, of_size[None], 0)[0] - (0.0 if smooth else _ROUGHER)
            better = value > best[index]
            best[index[better]] = value[better]
            chosen[:2, index[better]] = np.stack([np.full(better.sum(), of_scale), of_size[better]])
            chosen[2, index[better]] = smooth
    shape = frames, tracks
    return SCALES_S[chosen[0]].reshape(shape), SIZES[chosen[1]].reshape(shape), chosen[2].reshape(shape) > 0


def _bridged(values: Array) -> Array:
    """Values (O, M, D) with gaps of at most :data:`_FARTHEST_FRAMES` frames filled by straight lines."""
    number = np.arange(len(values))[:, None]
    known = np.isfinite(values).all(-1)
    before = np.maximum.accumulate(np.where(known, number, -1), axis=0)
    after = np.minimum.accumulate(np.where(known, number, len(values))[::-1], axis=0)[::-1]
    fill = ~known & (before >= 0) & (after < len(values)) & (after - before <= _FARTHEST_FRAMES + 1)
    first, last = (np.take_along_axis(values, np.clip(n, 0, len(values) - 1)[..., None], 0) for n in (before, after))
    share = ((number - before) / np.maximum(after - before, 1))[..., None]
    return np.where(fill[..., None], first + share * (last - first), values)


def _weights(apart: Array, noise: Array, scales: Array, sizes: Array, smooth: NDArray[np.bool_]) -> Array:
    """Best weights (O, T, S, 2) of the values around each frame, for the value there and for its derivative.

    Args:
        apart: (O, T), seconds from the frame.
        noise: (O, T, S), variances of the values, relative to those of which the sizes are multiples; NaN where not known.
        scales, sizes, smooth: (T, S), of the motion.
    """
    seen = np.isfinite(noise).transpose(1, 2, 0)
    at = apart.T[:, None] / scales[..., None]
    power = np.square(sizes)[..., None]
    both = seen[..., :, None] & seen[..., None, :]
    of_all = np.where(both, power[..., None] * covariance(at[..., :, None] - at[..., None, :], smooth[..., None, None]), 0.0)
    diagonal = np.arange(len(apart))
    of_all[..., diagonal, diagonal] += np.where(seen, noise.transpose(1, 2, 0), 1.0)
    motion = [
        power * covariance(at, smooth[..., None]),
        power * covariance_with_slope(at, smooth[..., None]) / scales[..., None],
    ]
    line = [np.ones_like(at), at]
    right = np.where(seen[..., None], np.stack([*motion, *line], axis=-1), 0.0)
    solved = np.linalg.solve(of_all, right)
    line_rows = right[..., TREND:].swapaxes(-1, -2)
    wanted = np.zeros((*scales.shape, TREND, 2))
    wanted[..., 0, 0], wanted[..., 1, 1] = 1.0, 1 / scales
    determined = seen.sum(-1) > TREND
    moments = np.where(determined[..., None, None], line_rows @ solved[..., TREND:], np.eye(TREND))
    return (solved[..., :2] + solved[..., TREND:] @ np.linalg.solve(moments, wanted - line_rows @ solved[..., :2])).transpose(
        2, 0, 1, 3
    )


def _near_a_value(known: NDArray[np.bool_], reach: int) -> NDArray[np.bool_]:
    """(T, S), whether a value is known at most ``reach`` frames away."""
    padded = np.pad(known, ((reach, reach), (0, 0)))
    return np.asarray(np.lib.stride_tricks.sliding_window_view(padded, 2 * reach + 1, axis=0).any(-1))


def on_sphere(base: Array) -> Neighbours:
    """Unit vectors (..., T, S, 3) of other frames as tangents of the sphere at each frame's ``base`` (T, S, 3).

    In these coordinates a direction that turns evenly is a straight line, which a polynomial follows without bending it. NaN
    for frames up to which it has turned by more than 100 degrees.
    """
    steps = np.nan_to_num(np.linalg.norm(np.diff(base, axis=0, prepend=base[:1]), axis=-1, keepdims=True))
    arc = np.cumsum(2 * np.arcsin(np.clip(steps / 2, 0.0, 1.0)), axis=0)

    def seen(directions: Array, offset: int) -> Array:
        turned = np.abs(shifted(arc, offset) - arc) > _FARTHEST_TURN_RAD
        there = np.where(turned, np.nan, shifted(directions, offset))
        cosine = np.clip((there * base).sum(-1, keepdims=True), -1.0, 1.0)
        aside = there - cosine * base
        sine = np.linalg.norm(aside, axis=-1, keepdims=True)
        return aside * np.arctan2(sine, cosine) / np.maximum(sine, 1e-12)

    return seen


def from_sphere(base: Array, tangents: Array, slopes: Array) -> tuple[Array, Array]:
    """Unit vectors and their derivatives, (..., T, S, 3), of tangents at ``base`` and the derivatives of these."""
    tangents, slopes = (part - (part * base).sum(-1, keepdims=True) * base for part in (tangents, slopes))
    angle = np.linalg.norm(tangents, axis=-1, keepdims=True)
    shrink = np.sinc(angle / np.pi)
    unit = np.cos(angle) * base + shrink * tangents
    return unit, shrink * (slopes - (tangents * slopes).sum(-1, keepdims=True) * base)
