"""The centre of a ball of which the stick may hide a part: that of the disc whose outline fits what is seen of it.

What is seen is not centred on the ball. Where the stick points at the camera, its near half hides a part of the ball,
and compression blurs colours over two pixels, so that they are wrong beside the stick too. All of that takes no part. The rest
of the outline says where the disc is and how large. How large it is follows from the neighbouring frames too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from torchstickcal.video.patch import Patch

Array = NDArray[np.float64]

_SOFT_PX = 0.45
"""Softness of an outline: the share of the disc falls from 0.73 to 0.27 over twice this distance."""
_BLEED_PX = 2.5
"""How far from another thing the colours of a compressed video are wrong."""
_MARGIN_PX = 3
_STRIP = 0.4
"""Half the width of the strip along the stick in which another thing may be the stick, as a share of the radius"""
_HOLE = 0.35
"""Share that is missing where something hides the disc."""
_UNEXPLAINED = 0.12
"""Share of the disc in a pixel from which the pixel, if it has no share of the marker, is another thing's or unclear."""
_OUTLINE = 0.01, 0.05
"""Shares of the disc and of the marker from which a pixel takes part."""
_NOISE = 0.1
"""Standard deviation of a pixel's share"""
_STRENGTH_SIGMA = 0.045
"""Standard deviation of the share in pixels that the disc covers wholly; it is 1, but for shadows."""
_ROUNDS, _LOOKED_AT = 8, (2, 4, 6)
"""Steps of Gauss-Newton, and those before which it is looked at what is hidden."""
_MOST_SAMPLES = 12
"""Moments of an exposure that are drawn."""
_LARGEST_STEP_PX = 2.0
_LEAST_RADIUS_PX = 1.0
_LEAST_SIGMA_PX = 0.03
_MOST_MISFIT = 0.25
_MOST_SIGMA_PX = 0.6
_MOST_HIDDEN = 0.4
"""A stick hides less of a ball. What is larger than its disc is something else."""
_SIZES, _LONG = 1.4, 5
"""Ratio of the radius to the usual one in so many times more frames than those that determine the radius"""
_MOST_ASIDE = 0.7
"""How far from the centre of what is seen the centre of the disc can be, as a share of the radius."""


@dataclass(frozen=True, eq=False)
class Disc:
    """A ball in a frame."""

    centre: Array
    """(2,), x and y in the image"""
    radius_px: float
    sigma_px: float
    """standard deviation of the centre along the axis on which it is known least"""
    radius_sigma_px: float
    misfit: float
    """root mean square of the differences between what is seen and the disc, in shares"""


def disc_in(patch: Patch, axis: Array | None, streak: Array, radius: tuple[float, float] | None = None) -> Disc | None:
    """The disc whose outline fits a marker; None where too little of it is seen, or something else.

    Args:
        patch: pixels of the marker.
        axis: (2,), direction of the stick; None where it is not known.
        streak: (2,), motion during the exposure, pixels.
        radius: expected radius and its standard deviation, pixels; None where not known.
    """
    shares, masked, x, y = _pixels(patch, axis)
    seen = patch.centre
    guess = float(np.sqrt(shares.sum() / np.pi))
    found = np.array([*seen, guess if radius is None else radius[0], 1.0])
    prior = np.diag([0.0, 0.0, 0.0, (_NOISE / _STRENGTH_SIGMA) ** 2]) + 1e-6 * np.eye(4)
    expected = np.array([0.0, 0.0, 0.0 if radius is None else radius[0], 1.0])
    if radius is not None:
        prior[2, 2] += (_NOISE / max(radius[1], _LEAST_SIGMA_PX)) ** 2
    clear = used = ~masked
    normal, rest, disc = prior, shares, shares
    for number in range(_ROUNDS):
        disc, slopes = _drawn(x, y, found[:2], found[2], streak)
        rest = shares - found[3] * disc
        if number in _LOOKED_AT:
            hole = cv2.morphologyEx((rest < -_HOLE).astype(np.uint8), cv2.MORPH_OPEN, np.ones((2, 2), np.uint8))
            clear = ~masked & ~_grown(hole > 0, _BLEED_PX)
        used = clear & ((disc > _OUTLINE[0]) | (shares > _OUTLINE[1])) & ~((shares == 0) & (disc > _UNEXPLAINED))
        design = np.concatenate([found[3] * slopes[:, used], disc[None, used]])
        normal = design @ design.T + prior
        step = np.linalg.solve(normal, design @ rest[used] + prior @ (expected - found) * [0, 0, 1, 1])
        found = found + np.clip(step, -_LARGEST_STEP_PX, _LARGEST_STEP_PX)
        found[2:] = np.clip(found[2:], [_LEAST_RADIUS_PX, 0.3], [2 * guess + _LARGEST_STEP_PX, 1.5])
    if not used.any():
        return None
    covariance = _NOISE**2 * np.linalg.inv(normal)
    sigma_px = float(np.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[-1]))
    misfit = float(np.sqrt(np.square(rest[used]).mean()))
    aside = float(np.linalg.norm(found[:2] - seen))
    hidden = 1 - float(shares.sum() / disc.sum())
    is_part = aside > _MOST_ASIDE * found[2] or not 0 <= hidden <= _MOST_HIDDEN
    if is_part or sigma_px > _MOST_SIGMA_PX or misfit > _MOST_MISFIT:
        return None
    return Disc(found[:2], float(found[2]), sigma_px, float(np.sqrt(covariance[2, 2])), misfit)


def discs_of(patches: Sequence[Patch | None], axes: Sequence[Array | None], streaks: Array, reach: int) -> list[Disc | None]:
    """The discs of one ball over a video. Its radius changes evenly with time.

    Args:
        patches, axes: of each frame, as of :func:`disc_in`; None without a marker.
        streaks: (F, 2). reach: how many frames before and after one say how large the disc is in it.
    """
    alone = [None if patch is None else disc_in(patch, axis, s) for patch, axis, s in zip(patches, axes, streaks, strict=True)]
    whole = [disc if _is_usual(disc, alone, frame, _LONG * reach) else None for frame, disc in enumerate(alone)]
    found: list[Disc | None] = []
    for frame, patch in enumerate(patches):
        if patch is None or whole[frame] is None:
            found.append(None)
        else:
            found.append(disc_in(patch, axes[frame], streaks[frame], _radius_at(whole, frame, reach)))
    return found


def _is_usual(disc: Disc | None, discs: Sequence[Disc | None], frame: int, reach: int) -> bool:
    """Whether a disc is not much smaller or larger than those of many frames around it: for long, a part may be hidden."""
    if disc is None:
        return False
    usual = float(np.median([d.radius_px for d in discs[max(0, frame - reach) : frame + reach + 1] if d is not None]))
    return usual / _SIZES < disc.radius_px < usual * _SIZES


def _radius_at(discs: Sequence[Disc | None], frame: int, reach: int) -> tuple[float, float] | None:
    """The radius in a frame and its standard deviation, by a straight line through those of the frames around it."""
    first = max(0, frame - reach)
    known = [(first + k - frame, d) for k, d in enumerate(discs[first : frame + reach + 1]) if d is not None]
    if len(known) < 4:
        return None
    at = np.array([offset for offset, _ in known], dtype=np.float64)
    radii = np.array([disc.radius_px for _, disc in known])
    weights = 1 / (np.array([disc.radius_sigma_px for _, disc in known]) ** 2 + _NOISE**2)
    design = np.stack([np.ones_like(at), at], axis=-1)
    normal = design.T @ (weights[:, None] * design) + np.diag([0.0, 1e-3])
    line = np.linalg.solve(normal, design.T @ (weights * radii))
    spread = float((weights * np.square(radii - design @ line)).sum() / weights.sum())
    return float(line[0]), float(np.sqrt(spread / max(1, len(known) - 2)))


def _pixels(patch: Patch, axis: Array | None) -> tuple[Array, NDArray[np.bool_], Array, Array]:
    """Of a marker and a margin around it, (h, w) each: shares, where another thing makes them wrong, x and y in the image."""
    shares = np.pad(patch.shares, _MARGIN_PX).astype(np.float64)
    other = np.pad(patch.other, _MARGIN_PX)
    places = np.indices(shares.shape, dtype=np.float64)
    x, y = places[1] + (patch.corner[0] - _MARGIN_PX), places[0] + (patch.corner[1] - _MARGIN_PX)
    if axis is not None:
        unit, centre = axis / np.linalg.norm(axis), patch.centre
        across = np.abs(unit[0] * (y - centre[1]) - unit[1] * (x - centre[0]))
        other = other & (across < _STRIP * np.sqrt(shares.sum() / np.pi))
    return shares, _grown(other, _BLEED_PX), x, y


def _grown(mask: NDArray[np.bool_], reach_px: float) -> NDArray[np.bool_]:
    steps = np.arange(-int(np.ceil(reach_px)), int(np.ceil(reach_px)) + 1)
    round_ = (np.hypot(*np.meshgrid(steps, steps)) <= reach_px).astype(np.uint8)
    return cv2.dilate(mask.astype(np.uint8), round_) > 0


def _drawn(x: Array, y: Array, centre: Array, radius: float, streak: Array) -> tuple[Array, Array]:
    """Shares (h, w) of a disc that moves during the exposure, and their derivatives (3, h, w) by centre and radius."""
    count = int(np.clip(np.ceil(np.linalg.norm(streak)), 1, _MOST_SAMPLES))
    moments = ((np.arange(count) + 0.5) / count - 0.5)[:, None, None]
    dx, dy = x - centre[0] - moments * streak[0], y - centre[1] - moments * streak[1]
    apart = np.hypot(dx, dy) + 1e-9
    share = 1 / (1 + np.exp(-np.clip((radius - apart) / _SOFT_PX, -30, 30)))
    edge = share * (1 - share) / _SOFT_PX
    return share.mean(0), np.stack([(edge * dx / apart).mean(0), (edge * dy / apart).mean(0), edge.mean(0)])
