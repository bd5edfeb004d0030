"""Ends of a stick that are marked with coloured tape or balls, found in the frames of a camera that stands still.

A frame is compared with the background. Where a marker covers a share of a pixel's exposure, the pixel is the mixture of
marker and background by that share: the shares are found by linear unmixing. Their centre of mass is the centre of the marker,
and that of a streak of motion blur is where the marker was in the middle of the exposure. Their sum is the area of the marker
whatever the blur, so that a marker that is partly hidden is noticed. An end is left out rather than guessed.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from torchstickcal.errors import CalibrationError
from torchstickcal.registry import suggestion
from torchstickcal.video.frames import Image

Array = NDArray[np.float64]

HUES: dict[str, float] = {
    "red": 0.0, "orange": 22.0, "yellow": 55.0, "green": 120.0, "cyan": 185.0, "blue": 225.0, "magenta": 310.0,
}  # fmt: skip
"""Hues of the named colours, degrees"""
_HUE_TOLERANCE_DEG = 14.0
_LEAST_SATURATION, _LEAST_VALUE = 110, 90
_LEAST_SHARE = 0.12
"""Share of a pixel's exposure from which it belongs to a marker."""
_LEAST_CHANGE = 14.0
"""Difference from the background that is not noise, in steps of 256."""
_UNEXPLAINED = 0.35
"""Largest part of a pixel's change, as a share of it, that mixing with the marker's colour does not explain."""
_LEAST_AREA_PX = 6.0
_AREA_RANGE = (0.65, 1.5)
"""Areas of a marker relative to its usual one; others are partly hidden, or two things in one."""
_RIVAL = 0.4
"""A second thing of that colour, of this share of the area of the first one, makes a frame ambiguous."""
_NEIGHBOURS = 4
_JUMP_PX = 6.0
_JUMP_SHARE = 0.35
_SAMPLES = 21


@dataclass(frozen=True)
class Candidate:
    """Something of a marker's colour in one frame."""

    x: float
    y: float
    area_px: float
    streak_px: float
    """length of the streak"""


@dataclass(frozen=True, eq=False)
class Background:
    """What a camera sees without the athlete, and the markers' colours as it sees them."""

    image: NDArray[np.float32]
    """(H, W, 3)"""
    colours: dict[str, NDArray[np.float32] | None]
    """by name, blue, green, red; None where nothing of that colour moves"""


def check_colours(names: Sequence[str]) -> None:
    """Raise a CalibrationError for names that are no colours, or are given twice."""
    unknown = [name for name in names if name not in HUES]
    if unknown or len(set(names)) != len(names) or not names:
        raise CalibrationError(
            "unusable colours of tape",
            where="--tape",
            got=",".join(names),
            expected=f"different ones of {', '.join(HUES)}",
            remedy=suggestion(unknown[0], HUES) if unknown else "",
        )


def learned(frames: Iterable[Image], names: Sequence[str]) -> Background:
    """The background and the colours, from frames spread over a video: the median, and what moves in front of it.

    Args:
        frames: about 20 images of one size.
        names: of colours, keys of :data:`HUES`.
    """
    images = np.stack(list(frames))
    background = np.median(images, axis=0).astype(np.float32)
    colours: dict[str, NDArray[np.float32] | None] = dict.fromkeys(names)
    for name in names:
        pixels = [image[_of_hue(image, name) & _changed(image, background)] for image in images]
        found = np.concatenate(pixels)
        if len(found) >= _LEAST_AREA_PX:
            most = found.max(1).astype(float) - found.min(1)
            colours[name] = np.median(found[most >= np.percentile(most, 60)], axis=0).astype(np.float32)
    return Background(background, colours)


def sampled(count: int) -> list[int]:
    """Numbers of the frames of a video of ``count`` frames from which the background is learned."""
    return sorted(set(np.linspace(0, max(count - 1, 0), min(_SAMPLES, max(count, 1))).round().astype(int).tolist()))


def candidates(image: Image, background: Background, name: str) -> list[Candidate]:
    """Everything in a frame that looks like the marker of a colour, the largest first."""
    colour = background.colours[name]
    if colour is None:
        return []
    box = _changed_box(image, background.image)
    if box is None:
        return []
    behind = background.image[box]
    change = image[box].astype(np.float32) - behind
    towards = colour - behind
    size = np.maximum(np.einsum("hwc,hwc->hw", towards, towards), 1.0)
    share = np.einsum("hwc,hwc->hw", change, towards) / size
    rest = np.linalg.norm(change - share[..., None] * towards, axis=-1)
    length = np.linalg.norm(change, axis=-1)
    fits = (share > _LEAST_SHARE) & (length > _LEAST_CHANGE) & (rest < _UNEXPLAINED * length + 8.0) & (size > 40.0**2)
    count, labels, boxes, _ = cv2.connectedComponentsWithStats(fits.astype(np.uint8), connectivity=8)
    found = []
    for label in range(1, count):
        left, top, width, height, pixels = (int(v) for v in boxes[label])
        if pixels < _LEAST_AREA_PX / 2:
            continue
        grown = slice(max(0, top - 2), top + height + 2), slice(max(0, left - 2), left + width + 2)
        inside = cv2.dilate((labels[grown] == label).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        other = (labels[grown] != label) & (labels[grown] != 0)
        weights = np.where(inside & ~other & (rest[grown] < _UNEXPLAINED * length[grown] + 12.0), share[grown], 0.0).clip(
            0, 1.1
        )
        area = float(weights.sum())
        whole = left + box[1].start, top + box[0].start
        if area < _LEAST_AREA_PX or _touches_border(*whole, width, height, image.shape):
            continue
        ys, xs = np.mgrid[grown]
        x, y = float((weights * xs).sum() / area), float((weights * ys).sum() / area)
        spread = np.cov(np.stack([xs.ravel(), ys.ravel()]), aweights=weights.ravel() + 1e-12)
        streak = float(np.sqrt(12 * np.linalg.eigvalsh(spread)[-1]))
        found.append(Candidate(x + box[1].start, y + box[0].start, area, streak))
    return sorted(found, key=lambda candidate: -candidate.area_px)


@dataclass(eq=False)
class TapeTrack:
    """The candidates of one marker over a video, of which :meth:`ends` selects those that are sure."""

    found: list[list[Candidate]] = field(default_factory=list)
    """of each frame"""
    near: list[tuple[float, float, float] | None] = field(default_factory=list)
    """x, y and radius of where the end can be, by the hands; None where that is not known"""

    def add(self, candidates: list[Candidate], near: tuple[float, float, float] | None = None) -> None:
        """Add a frame."""
        self.found.append(candidates)
        self.near.append(near)

    def ends(self) -> Array:
        """(F, 3): x and y in pixels, and a score; NaN, NaN, 0 where no end is sure."""
        allowed = [[c for c in found if _within(c, near)] for found, near in zip(self.found, self.near, strict=True)]
        usual = _usual_areas(allowed)
        ends = np.full((len(allowed), 3), [np.nan, np.nan, 0.0])
        for frame, (found, area) in enumerate(zip(allowed, usual, strict=True)):
            fitting = [c for c in found if _AREA_RANGE[0] * area <= c.area_px <= _AREA_RANGE[1] * area]
            if len(fitting) == 1 and not any(c.area_px >= _RIVAL * area for c in found if c is not fitting[0]):
                ends[frame] = fitting[0].x, fitting[0].y, 1.0
        return _without_jumps(ends)


def _of_hue(image: Image, name: str) -> NDArray[np.bool_]:
    hsv = cv2.cvtColor(image, cv2.COLOR_BGR2HSV).astype(np.float32)
    apart = np.abs((2 * hsv[..., 0] - HUES[name] + 180) % 360 - 180)
    return np.asarray((apart < _HUE_TOLERANCE_DEG) & (hsv[..., 1] > _LEAST_SATURATION) & (hsv[..., 2] > _LEAST_VALUE))


def _changed(image: Image, background: NDArray[np.float32]) -> NDArray[np.bool_]:
    return np.asarray(np.abs(image.astype(np.float32) - background).max(-1) > 3 * _LEAST_CHANGE)


def _changed_box(image: Image, background: NDArray[np.float32]) -> tuple[slice, slice] | None:
    """Rows and columns that hold everything that differs from the background; None if nothing does."""
    apart = cv2.absdiff(image, background.round().clip(0, 255).astype(np.uint8)).max(-1)
    changed = cv2.blur(apart, (3, 3)) > 0.5 * _LEAST_CHANGE
    rows, columns = (np.flatnonzero(changed.any(axis)) for axis in (1, 0))
    if not len(rows):
        return None
    margin = 4
    return (
        slice(max(0, int(rows[0]) - margin), int(rows[-1]) + margin + 1),
        slice(max(0, int(columns[0]) - margin), int(columns[-1]) + margin + 1),
    )


def _touches_border(left: int, top: int, width: int, height: int, shape: tuple[int, ...]) -> bool:
    return left <= 1 or top <= 1 or left + width >= shape[1] - 1 or top + height >= shape[0] - 1


def _within(candidate: Candidate, near: tuple[float, float, float] | None) -> bool:
    return near is None or np.hypot(candidate.x - near[0], candidate.y - near[1]) <= near[2]


def _usual_areas(found: list[list[Candidate]]) -> Array:
    """(F,), the usual area of the marker around each frame: the median of the largest candidates of many frames."""
    largest = np.array([max((c.area_px for c in frame), default=np.nan) for frame in found])
    reach, usual = 20, np.full(len(found), np.nan)
    overall = float(np.nanmedian(largest)) if np.isfinite(largest).any() else np.nan
    for frame in range(len(found)):
        around = largest[max(0, frame - reach) : frame + reach + 1]
        around = around[np.isfinite(around) & (around > 0.4 * overall) & (around < 2.5 * overall)]
        usual[frame] = np.median(around) if len(around) >= 5 else overall
    return usual


def _without_jumps(ends: Array) -> Array:
    """Ends (F, 3) without those that do not follow from their neighbours: a parabola through them predicts each one."""
    kept = ends.copy()
    known = np.isfinite(ends[:, 0])
    for frame in np.flatnonzero(known):
        around = np.arange(max(0, frame - _NEIGHBOURS), min(len(ends), frame + _NEIGHBOURS + 1))
        around = around[known[around] & (around != frame)]
        if len(around) < 4 or not (around.min() < frame < around.max()):
            if len(around) < 2:
                kept[frame] = np.nan, np.nan, 0.0
            continue
        fit = np.polynomial.polynomial.polyfit(around - frame, ends[around, :2], 2)
        speed = float(np.linalg.norm(fit[1]))
        if np.linalg.norm(ends[frame, :2] - fit[0]) > _JUMP_PX + _JUMP_SHARE * speed:
            kept[frame] = np.nan, np.nan, 0.0
    return kept
