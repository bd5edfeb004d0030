"""Smoothing by local polynomials, over as many frames as the motion allows.

Around each frame a cubic polynomial is fitted to the frames before and after it. A long window averages more noise, a short one
follows a fast swing. The window is the longest whose estimates, of position and velocity, agree with those of all shorter ones
within their standard deviations (intersection of confidence intervals: Goldenshluger and Nemirovski, 1997).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Neighbours = Callable[[Array, int], Array]
"""Values (..., T, S, D), and an offset in frames, to the values of those frames as they are averaged, (..., T, S, D)"""

HALF_WIDTHS = (2, 3, 4, 5, 6, 8, 10, 13, 16, 20, 25, 32, 40)
"""Frames before and after."""
_ORDER = 3
_AGREEMENT = 1.4
"""How many standard deviations, root mean square over the axes, estimates may differ by chance."""
_FARTHEST_FRAMES, _FARTHEST_S = 3, 0.025
"""How far from a frame in which a point is known it is still estimated; the larger of both."""
_LONGER_DRAWS = slice(1, None, 4)
"""Which draws, after the estimate, are smoothed over the next longer windows."""
_STEADY_FRAMES = 2
"""The window of a frame is the median over so many frames before and after it."""
_FARTHEST_TURN_RAD = 1.75
_LEAST_CONDITION = 1e-7
_CLEAR = 2.2
"""The same for the shortest window, which is noisy and is used only where a track clearly asks for it."""
_LARGEST_SLOPE_GAINS = {2: 1.5 * 130 / 144, 3: 1.5 * 1588 / 6048}
"""1.5 times the variance, per frame squared, of the slope in the middle of a cubic polynomial through five or seven frames with
errors of 1. Longer windows have the second one."""


def shifted(values: Array, offset: int) -> Array:
    """Values (..., T, S, D) of ``offset`` frames later; NaN where there is none.

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
    """The weights with which frames are averaged. The same weights smooth the estimate and the draws of its errors.

    Every fourth draw is smoothed over the next longer window. How much it differs shows how much smoothing itself bends a
    track.
    """

    weights: Array
    """(O, T, S, 2), of each offset, for the value and for its derivative by time; NaN where nothing can be estimated"""
    longer: Array
    """the same of the next longer windows"""
    neighbours: Neighbours

    def __call__(self, values: Array) -> tuple[Array, Array]:
        """Values (T, S, D), or an estimate and draws of it (N, T, S, D), smoothed, and their derivatives, per second."""
        smoothed = self._averaged(self.weights, values)
        if values.ndim == 4:
            for whole, part in zip(smoothed, self._averaged(self.longer, values[_LONGER_DRAWS]), strict=True):
                whole[_LONGER_DRAWS] = part
        return smoothed

    def _averaged(self, weights: Array, values: Array) -> tuple[Array, Array]:
        reach = len(weights) // 2
        value, slope = np.zeros_like(values), np.zeros_like(values)
        for offset, of_offset in zip(range(-reach, reach + 1), weights, strict=True):
            used = (of_offset != 0).any(-1)[..., None]
            if used.any():
                near = np.where(used, self.neighbours(values, offset), 0.0)
                value += of_offset[..., :1] * near
                slope += of_offset[..., 1:] * near
        return value, slope

    @property
    def gains(self) -> Array:
        """(T, S, 2), root of the sum of the squared weights: what becomes of independent errors of 1."""
        return np.sqrt(np.square(self.weights).sum(0))


def smoother(times: Array, values: Array, variances: Array, neighbours: Neighbours = shifted) -> Smoother:
    """Choose windows for tracks.

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
        >>> bool(smooth.gains[100, 0, 0] < 0.6)
        True
    """
    frames, count = values.shape[:2]
    reach = max(width for width in HALF_WIDTHS if width < max(frames, HALF_WIDTHS[0] + 1))
    step = float(np.median(np.diff(times))) if frames > 1 else 1.0
    offsets = range(-reach, reach + 1)
    at = [(shifted(times[:, None, None], offset) - times[:, None, None])[..., 0] / step for offset in offsets]
    near = [neighbours(values, offset) for offset in offsets]
    inverse = np.where(np.isfinite(values).all(-1) & np.isfinite(variances) & (variances > 0), 1 / variances, 0.0)
    information = [
        np.where(np.isfinite(seen).all(-1), np.nan_to_num(shifted(inverse[..., None], offset)[..., 0]), 0.0)
        for seen, offset in zip(near, offsets, strict=True)
    ]
    powers = [np.nan_to_num(a[..., None] ** np.arange(_ORDER + 1)) for a in at]

    moments = np.zeros((frames, count, _ORDER + 1, _ORDER + 1))
    sums = np.zeros((frames, count, _ORDER + 1, values.shape[-1]))
    tried: list[tuple[Array, Array, Array]] = []
    widths = [width for width in HALF_WIDTHS if width <= reach]
    with np.errstate(invalid="ignore", divide="ignore"):
        typical = np.nanmedian(np.where(inverse > 0, 1 / inverse, np.nan), axis=0, keepdims=True)
    before = -1
    for width in widths:
        for distance in range(before + 1, width + 1):
            for number in {reach - distance, reach + distance}:
                weighted = information[number][..., None] * powers[number]
                moments += weighted[..., :, None] * powers[number][..., None, :]
                sums += weighted[..., :, None] * np.nan_to_num(near[number])[..., None, :]
        before = width
        covariance = _sure(_inverse(moments), typical * _LARGEST_SLOPE_GAINS[min(width, max(_LARGEST_SLOPE_GAINS))])
        estimate = covariance[..., :2, :] @ sums
        tried.append((covariance[..., :2, :], estimate, np.diagonal(covariance, axis1=-2, axis2=-1)[..., :2]))
    determined = np.stack([np.isfinite(variance).all(-1) for _, _, variance in tried])
    chosen = _determined_from(_steady(_longest(tried, widths)), determined)
    rows_of = np.stack([rows for rows, _, _ in tried])
    near_a_value = _near_a_value(inverse > 0, max(_FARTHEST_FRAMES, round(_FARTHEST_S / step)))

    def weights_of(number: NDArray[np.intp]) -> Array:
        rows = np.take_along_axis(rows_of, number[None, ..., None, None], 0)[0]
        weights = np.zeros((len(offsets), frames, count, 2))
        for k, offset in enumerate(offsets):
            linear = (rows @ powers[k][..., None])[..., 0] * information[k][..., None]
            weights[k] = np.where((np.abs(offset) <= np.array(widths)[number])[..., None], linear / [1.0, step], 0.0)
        return np.where((np.isfinite(rows).all((-2, -1)) & near_a_value)[..., None], np.nan_to_num(weights), np.nan)

    return Smoother(
        weights_of(chosen), weights_of(_determined_from(np.minimum(chosen + 1, len(widths) - 1), determined)), neighbours
    )


def _inverse(moments: Array) -> Array:
    """Inverses (..., n, n) of moments; NaN where a polynomial is not determined."""
    scale = np.sqrt(np.maximum(np.diagonal(moments, axis1=-2, axis2=-1), 1e-300))
    scaled = moments / scale[..., :, None] / scale[..., None, :]
    determined = np.linalg.eigvalsh(scaled)[..., 0] > _LEAST_CONDITION
    safe = np.where(determined[..., None, None], scaled, np.eye(moments.shape[-1]))
    inverse = np.linalg.inv(safe) / scale[..., :, None] / scale[..., None, :]
    return np.where(determined[..., None, None], inverse, np.nan)


def _sure(covariance: Array, largest: Array) -> Array:
    """Covariances (T, S, n, n), NaN where velocities are less sure than in the middle of a short window.

    At the ends of a recording and beside gaps, a polynomial through few frames on one side would say nothing of the velocity.

    Args:
        covariance: of the polynomials.
        largest: (1, S), variances that velocities may have.
    """
    sure = covariance[..., 1, 1] <= largest
    return np.where(sure[..., None, None], covariance, np.nan)


def _longest(tried: list[tuple[Array, Array, Array]], widths: list[int]) -> NDArray[np.intp]:
    """(T, S), number of the longest window that agrees with all shorter ones; the first one that is determined at least."""
    shape = tried[0][1].shape[:2]
    chosen = np.full(shape, -1)
    going_on = np.ones(shape, dtype=bool)
    for number, (_, estimate, variance) in enumerate(tried):
        determined = np.isfinite(variance).all(-1)
        agrees = np.ones(shape, dtype=bool)
        for (_, other, more), width in zip(tried[:number], widths, strict=False):
            ratio = np.square(estimate - other).mean(-1) / np.maximum(more - variance, 1e-9 * more)
            allowed = _CLEAR if width == HALF_WIDTHS[0] else _AGREEMENT
            agrees &= (_mean_around(ratio, width) <= allowed**2).all(-1)
        going_on &= agrees | ~determined
        chosen = np.where(determined & (going_on | (chosen < 0)), number, chosen)
    return np.maximum(chosen, 0)


def _determined_from(chosen: NDArray[np.intp], determined: NDArray[np.bool_]) -> NDArray[np.intp]:
    """The shortest determined windows that are not shorter than the chosen ones (T, S), else the chosen ones."""
    allowed = determined & (np.arange(len(determined))[:, None, None] >= chosen)
    return np.where(allowed.any(0), allowed.argmax(0), chosen)


def _mean_around(values: Array, reach: int) -> Array:
    """Means of values (T, S, 2) over the known ones of ``reach`` frames before and after; 0 where none is known."""
    known = np.isfinite(values)
    sums = np.stack([np.where(known, values, 0.0), known.astype(float)])
    padded = np.pad(sums.cumsum(1), ((0, 0), (reach + 1, reach), (0, 0), (0, 0)), mode="edge")
    padded[:, : reach + 1] = 0.0
    total, count = padded[:, 2 * reach + 1 :] - padded[:, : -2 * reach - 1]
    return total / np.maximum(count, 1.0)


def _steady(chosen: NDArray[np.intp]) -> NDArray[np.intp]:
    """The median of the windows over neighbouring frames."""
    padded = np.pad(chosen, ((_STEADY_FRAMES, _STEADY_FRAMES), (0, 0)), mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * _STEADY_FRAMES + 1, axis=0)
    return np.median(windows, axis=-1).astype(np.intp)


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
    angle = np.linalg.norm(tangents, axis=-1, keepdims=True)
    shrink = np.sinc(angle / np.pi)
    unit = np.cos(angle) * base + shrink * tangents
    return unit, shrink * (slopes - (tangents * slopes).sum(-1, keepdims=True) * base)
