"""The shaft of a stick without marks: a thin line that begins at the hands, and its far end, where the line stops.

What differs from the background and is thin is the shaft, a finger or an edge of clothes. The shaft is the longest straight
line of thin pixels that passes near the hands. Each place along it is shaft, something thick that may hide the shaft,
background, or a place at which the shaft would not be seen because the background has its colour. The end is sure where the
shaft is followed by background in front of which it would be seen. Otherwise no end is given.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from torchstickcal.video.frames import Image
from torchstickcal.video.tape import without_jumps

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

SHAFT_POINTS = ("shaft_hands", "shaft_end")
"""Names of the points: the place on the shaft nearest to the middle between the wrists, and the far end."""
_LEAST_CHANGE = 18.0
"""Difference from the background that is not noise, in steps of 256."""
_WIDTH = 0.03
"""Largest width of a shaft, as a share of the diagonal of the body's box."""
_REACH, _HANDS = 1.3, 0.09
"""How far the end can be from the hands, and how near to the middle between the wrists the shaft passes, as shares of it."""
_DIRECTIONS = 360
_LEAST_LENGTH = 0.08
"""Least length of shaft that must be seen, as a share of the diagonal."""
_LEAST_SEEN = 0.5
"""Share of the way from the hands to the end on which the shaft must be seen, where nothing thick is in front of it."""
_GAP_PX = 4
_BEYOND_PX = 8
"""Length of background that must follow the end."""
_BEFORE_PX = 40
"""Length before the end that says how well the shaft is seen."""
_FADED, _FADE_PX = 0.75, 5
"""Part of the usual share below which a shaft fades, and the largest length on which it may."""
_RIVAL = 0.6
"""Share of the pixels of the best line that makes another line a rival."""
_ROUNDS = 3
_VISIBLE = 1.5
"""Expected change by the shaft, over the least one, where it would surely be seen."""
_LEAST_SCORE = 0.05


class _Line(NamedTuple):
    """A line in an image: a point (2,) and a direction (2,) of length 1."""

    point: Array
    unit: Array


@dataclass(frozen=True, eq=False)
class _Scene:
    """What is seen around the hands, (h, w)."""

    image: NDArray[np.float32]
    behind: NDArray[np.float32]
    change: NDArray[np.float32]
    thin: Mask
    thick: Mask
    unknown: Mask
    corner: Array


def shaft_in(image: Image, background: NDArray[np.float32], hands: tuple[float, float], body_px: float) -> Array:
    """The points of :data:`SHAFT_POINTS` in a frame (2, 3): x and y in pixels, and a score; NaN, NaN, 0 where not sure.

    Args:
        image: the frame.
        background: (H, W, 3), without the athlete; NaN where it is not known.
        hands: the middle between the wrists, x and y.
        body_px: the diagonal of the body's box.
    """
    nothing = np.full((2, 3), [np.nan, np.nan, 0.0])
    width = max(3, round(_WIDTH * body_px))
    scene = _around(image, background, hands, _REACH * body_px, width)
    middle = np.array(hands) - scene.corner
    line = _sure_line(scene.thin, middle, _HANDS * body_px, width) if scene.thin.any() else None
    if line is None:
        return nothing
    found = _end_along(scene, line, width, body_px)
    if found is None:
        return nothing
    at, score = found
    return np.array([[*(line.point + scene.corner), score], [*(line.point + at * line.unit + scene.corner), score]])


def shaft_track(ends: Sequence[Array]) -> Array:
    """The shaft (F, 2, 3) over a video, by what :func:`shaft_in` found in each frame, without ends that do not follow from
    their neighbours."""
    track = np.stack(list(ends))
    track[np.isnan(without_jumps(track[:, 1, :2])).any(1)] = np.nan, np.nan, 0.0
    return track


def _around(image: Image, background: NDArray[np.float32], hands: tuple[float, float], reach: float, width: int) -> _Scene:
    x, y = hands
    left, top = max(0, int(x - reach)), max(0, int(y - reach))
    right, bottom = min(image.shape[1], int(x + reach) + 1), min(image.shape[0], int(y + reach) + 1)
    part = image[top : max(bottom, top + 1), left : max(right, left + 1)].astype(np.float32)
    behind = background[top : max(bottom, top + 1), left : max(right, left + 1)]
    unknown = np.isnan(behind[..., 0])
    change = np.where(unknown, 0.0, np.abs(part - np.nan_to_num(behind)).max(-1)).astype(np.float32)
    seen = ((cv2.blur(change, (3, 3)) > _LEAST_CHANGE) | unknown).astype(np.uint8)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (width + 2, width + 2))
    thick = cv2.morphologyEx(seen, cv2.MORPH_OPEN, disc, borderType=cv2.BORDER_REPLICATE) > 0
    return _Scene(part, behind, change, (seen > 0) & ~thick, thick, unknown, np.array([left, top], dtype=np.float64))


def _sure_line(thin: Mask, middle: Array, near: float, width: int) -> _Line | None:
    """The line of most thin pixels that passes near the hands; None without one, or if another one is about as long."""
    rows, columns = np.nonzero(thin)
    offsets = np.stack([columns, rows], axis=-1) - middle
    line = _longest_line(offsets, near, width)
    if line is None:
        return None
    own = _beside(offsets, line) < 1.5 * width
    rival = _longest_line(offsets[~own], near, width)
    if rival is not None:
        others = offsets[~own]
        if (_beside(others, rival) < width).sum() > _RIVAL * own.sum():
            return None
    return _Line(middle + line.point, line.unit)


def _longest_line(offsets: Array, near: float, width: int) -> _Line | None:
    """The line of most of some pixels (n, 2), relative to the hands; None where no line has enough of them."""
    angles = np.arange(_DIRECTIONS) * (2 * np.pi / _DIRECTIONS)
    units = np.stack([np.cos(angles), np.sin(angles)])
    along, across = offsets @ units, offsets @ np.stack([-units[1], units[0]])
    bins = max(1, round(2 * near / width))
    number = np.floor((across + near) * bins / (2 * near)).astype(int)
    counted = (along > 0) & (number >= 0) & (number < bins)
    votes = np.bincount((number + bins * np.arange(_DIRECTIONS))[counted], minlength=bins * _DIRECTIONS)
    direction, side = divmod(int(votes.argmax()), bins)
    unit = units[:, direction]
    line = _Line(near * (2 * (side + 0.5) / bins - 1) * np.array([-unit[1], unit[0]]), unit)
    for _ in range(_ROUNDS):  # the pixels beside the line say where it is exactly
        own = offsets[_beside(offsets, line) < width]
        if len(own) < 2 * width:
            return None
        middle = own.mean(0)
        unit = np.linalg.svd(own - middle, full_matrices=False)[2][0]
        unit = unit if unit @ line.unit > 0 else -unit
        line = _Line(middle - (middle @ unit) * unit, unit)
    return line


def _beside(offsets: Array, line: _Line) -> Array:
    """Distances (n,) of pixels (n, 2) from a line; infinite on the other side of the hands."""
    relative = offsets - line.point
    aside = np.abs(relative @ np.array([-line.unit[1], line.unit[0]]))
    return np.where(relative @ line.unit > 0, aside, np.inf)


class _Profile(NamedTuple):
    """What is seen along a line, pixel after pixel from the hands on, (T,)."""

    shaft: Mask
    thick: Mask
    change: Array
    """differences from the background, in steps of 256"""
    contrast: Array
    """difference between the shaft's colour and the background; NaN where the background is not known"""

    def seen_if_there(self, share: float) -> Mask:
        """Where a shaft that covers this share of a pixel's exposure would be seen."""
        return ~self.thick & (np.nan_to_num(self.contrast) * share > _VISIBLE * _LEAST_CHANGE)


def _end_along(scene: _Scene, line: _Line, width: int, body_px: float) -> tuple[float, float] | None:
    """How far along a line the shaft ends, and a score; None where that is not sure."""
    profile = _profile(scene, line, width)
    if profile is None:
        return None
    places = np.flatnonzero(profile.shaft)
    shares = profile.change[places] / np.maximum(profile.contrast[places], 1.0)
    visible = profile.seen_if_there(float(np.nanmedian(shares).clip(0.0, 1.0)))
    empty = visible & ~profile.shaft
    end, gap = int(places[0]), 0
    if empty[:end].sum() > _HANDS * body_px:
        return None
    for place in range(end, len(empty)):
        gap = 0 if profile.shaft[place] else gap + int(empty[place])
        if gap > _GAP_PX:
            break
        end = place if profile.shaft[place] else end
    own = places[places <= end]
    share = float(np.nanmedian(profile.change[own[-_BEYOND_PX:]] / np.maximum(profile.contrast[own[-_BEYOND_PX:]], 1.0)))
    beyond = slice(end + 1, end + 1 + _BEYOND_PX)
    empty = profile.seen_if_there(min(share, 1.0)) & ~profile.shaft
    seen = len(own) / (len(own) + int(empty[own[0] : end].sum()))
    covered = float(profile.thick[own[0] : end + 1].mean())
    if len(empty[beyond]) < _BEYOND_PX or not empty[beyond].all() or seen < _LEAST_SEEN or len(own) < _LEAST_LENGTH * body_px:
        return None
    level = _sharp_level(profile, own)
    if level is None:
        return None
    score = seen * (1 - covered) * min(1.0, 2 * level / (3 * _LEAST_CHANGE))
    return _falling_through(profile.change, end, level), float(np.clip(score, _LEAST_SCORE, 1.0))


def _profile(scene: _Scene, line: _Line, width: int) -> _Profile | None:
    steps = np.arange(int(np.hypot(*scene.thin.shape)))
    lateral = np.arange(-(width // 2) - 1, width // 2 + 2)
    across = np.array([-line.unit[1], line.unit[0]])
    places = line.point + steps[:, None, None] * line.unit + lateral[:, None] * across
    columns, rows = places.round().astype(int).transpose(2, 0, 1)
    height, length = scene.thin.shape
    inside = ((columns >= 0) & (columns < length) & (rows >= 0) & (rows < height)).all(1)
    count = int(inside.argmin()) if not inside.all() else len(inside)
    if count < _BEYOND_PX or not inside[0]:
        return None
    rows, columns = rows[:count], columns[:count]
    core = np.abs(lateral) <= 1
    shaft = np.asarray(scene.thin[rows, columns].any(1) & ~scene.unknown[rows, columns].any(1))
    if not shaft.any():
        return None
    change = scene.change[rows, columns]
    strongest = change[shaft][:, core].max(1) >= np.percentile(change[shaft][:, core].max(1), 50)
    pixels = scene.image[rows, columns][shaft][:, core][strongest].reshape(-1, 3)
    colour = np.median(pixels, axis=0)
    contrast = np.abs(scene.behind[rows, columns][:, core].mean(1) - colour).max(-1)
    thick = np.asarray(scene.thick[rows, columns][:, core].any(1))
    return _Profile(shaft, thick, change[:, core].mean(1).astype(np.float64), contrast)


def _sharp_level(profile: _Profile, own: NDArray[np.intp]) -> float | None:
    """Half of the change from the background before the end of a shaft; None if it fades over a long way towards the end.

    It fades where the end moves along the line during the exposure: only a part of the exposure sees the shaft there, and where
    the end was in the middle of it is not known.
    """
    shares = profile.change / np.maximum(profile.contrast, 1.0)
    usual = float(np.nanmedian(shares[own[-_BEFORE_PX:-_BEYOND_PX]])) if len(own) > 2 * _BEYOND_PX else np.nan
    full = own[shares[own] > _FADED * usual]
    if not len(full) or own[-1] - full[-1] > _FADE_PX:
        return None
    return 0.5 * usual * float(np.nanmedian(profile.contrast[own[-_BEYOND_PX:]]))


def _falling_through(values: Array, end: int, level: float) -> float:
    """The place near the end of a line at which values (T,) fall through a level, between pixels."""
    for place in range(max(0, end - _GAP_PX), min(end + _GAP_PX, len(values) - 1)):
        if values[place] >= level > values[place + 1]:
            return place + float((values[place] - level) / (values[place] - values[place + 1]))
    return float(end)
