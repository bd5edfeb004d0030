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
from torchstickcal.video.ball import discs_of
from torchstickcal.video.frames import Image
from torchstickcal.video.patch import Patch

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
_OTHER_CHANGE = 30.0
"""Difference from the background of another thing; compression leaves smaller ones around a marker."""
_UNEXPLAINED = 0.35
"""Largest part of a pixel's change, as a share of it, that mixing with the marker's colour does not explain."""
_LEAST_CONTRAST = 40.0
_PURITY = 0.7
_LEAST_AREA_PX = 6.0
_AREA_RANGE = (0.65, 1.5)
"""Areas of a marker relative to its usual one; others are partly hidden, or two things in one."""
_AREA_FRAMES = 6
"""The usual area is the median over so many frames before and after: a marker that turns changes its area."""
_LEAST_SCORE = 0.02
_RIVAL = 0.4
"""A second thing of that colour, of this share of the area of the first one, makes a frame ambiguous."""
_NO_DIRECTION_PX = 3.0
_NEIGHBOURS = 4
_JUMP_PX = 6.0
_JUMP_SHARE = 0.35
_SAMPLES = 21
_BODY_MARGIN = 0.1
"""Reach of limbs around the body's keypoints, as a share of the diagonal of their box."""
_LEAST_UNCOVERED = 3


@dataclass(frozen=True)
class Candidate:
    """Something of a marker's colour in one frame."""

    x: float
    y: float
    area_px: float
    streak_px: float
    """length of what is seen"""
    blur_px: float = 0.0
    """by how much it is longer than wide"""
    patch: Patch | None = None
    """its pixels"""


@dataclass(frozen=True, eq=False)
class Background:
    """What a camera sees without the athlete, and the markers' colours as it sees them."""

    image: NDArray[np.float32]
    """(H, W, 3)"""
    colours: dict[str, NDArray[np.float32] | None]
    """by name, blue, green, red; None where nothing of that colour moves"""


def check_colours(names: Sequence[str], option: str = "--tape") -> None:
    """Raise a CalibrationError for names that are no colours, or are given twice."""
    unknown = [name for name in names if name not in HUES]
    if unknown or len(set(names)) != len(names) or not names:
        raise CalibrationError(
            "unusable colours of marks",
            where=option,
            got=",".join(names),
            expected=f"different ones of {', '.join(HUES)}",
            remedy=suggestion(unknown[0], HUES) if unknown else "",
        )


def learned(frames: Iterable[Image], names: Sequence[str], people: Sequence[Array | None] = ()) -> Background:
    """The background and the colours, from frames spread over a video: the median, and what moves in front of it.

    An athlete who stands at one place for long would become part of the background. So pixels near the body do not count in a
    frame, and where nothing else was ever seen, the background is not known and no marker is found.

    Args:
        frames: about 20 images of one size.
        names: of colours, keys of :data:`HUES`.
        people: the body's keypoints (P, 3) in each of the frames; empty, or None in a frame, where they are not known.
    """
    images = np.stack(list(frames))
    background = np.median(images, axis=0).astype(np.float32)
    covered = [_body_mask(person, images.shape[1:3]) for person in people]
    nothing = np.zeros(images.shape[1:3], dtype=bool)
    masks = np.stack([nothing if mask is None else mask for mask in covered] or [nothing])
    if masks.any():
        rows, columns = (np.flatnonzero(masks.any((0, axis))) for axis in (2, 1))
        box = slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)
        background[box] = _median_of_uncovered(images[:, *box], masks[:, *box])
    colours: dict[str, NDArray[np.float32] | None] = dict.fromkeys(names)
    for name in names:
        pixels = [image[_of_hue(image, name) & _changed(image, background)] for image in images]
        found = np.concatenate(pixels)
        if len(found) >= _LEAST_AREA_PX:
            most = found.max(1).astype(float) - found.min(1)
            colours[name] = np.median(found[most >= np.percentile(most, 60)], axis=0).astype(np.float32)
    return Background(background, colours)


def _body_mask(person: Array | None, shape: tuple[int, ...]) -> NDArray[np.bool_] | None:
    """The pixels near a body with keypoints (P, 3); None where it was not seen."""
    if person is None:
        return None
    seen = person[(person[:, 2] > 0) & np.isfinite(person[:, :2]).all(-1), :2]
    if len(seen) < 3:
        return None
    mask = np.zeros(shape, np.uint8)
    cv2.fillConvexPoly(mask, cv2.convexHull(seen.round().astype(np.int32)), 1)
    reach = max(3, round(_BODY_MARGIN * float(np.linalg.norm(np.ptp(seen, axis=0)))))
    return cv2.dilate(mask, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)) > 0


def _median_of_uncovered(images: NDArray[np.uint8], masks: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Medians (h, w, 3) over the images (n, h, w, 3) in which a pixel is not covered; NaN where it is in nearly all."""
    values = np.where(masks[..., None], np.nan, images.astype(np.float32))
    values.sort(axis=0)  # NaN last
    count = (~masks).sum(0)
    low = np.maximum(count - 1, 0) // 2
    median = np.take_along_axis(values, low[None, ..., None], 0)[0]
    return np.where((count >= _LEAST_UNCOVERED)[..., None], median, np.nan).astype(np.float32)


def sampled(count: int) -> list[int]:
    """Numbers of the frames of a video of ``count`` frames from which the background is learned."""
    return sorted(set(np.linspace(0, max(count - 1, 0), min(_SAMPLES, max(count, 1))).round().astype(int).tolist()))


def candidates(
    image: Image, background: Background, name: str, near: tuple[float, float, float] | None = None
) -> list[Candidate]:
    """Everything in a frame that looks like the marker of a colour, the largest first.

    Args:
        image: the frame.
        background: of :func:`learned`.
        name: of the colour.
        near: x, y and radius, pixels, of where to look; None for everywhere.
    """
    colour = background.colours[name]
    if colour is None:
        return []
    shares, other, unknown, corner = _shares(image, background.image, colour, near)
    _, labels, boxes, _ = cv2.connectedComponentsWithStats((shares > _LEAST_SHARE).astype(np.uint8), connectivity=8)
    found = []
    for label, (left, top, width, height, pixels) in enumerate(boxes[1:].tolist(), 1):
        if pixels < _LEAST_AREA_PX / 2:
            continue
        part = slice(max(0, top - 3), top + height + 3), slice(max(0, left - 3), left + width + 3)
        own = np.where(labels[part] == label, shares[part], 0.0)
        found += _markers_in(own, other[part], unknown[part], (corner[0] + part[1].start, corner[1] + part[0].start))
    inside = [c for c in found if _is_inside(c, image.shape)]
    return sorted(inside, key=lambda candidate: -candidate.area_px)


def _shares(
    image: Image, background: NDArray[np.float32], colour: NDArray[np.float32], near: tuple[float, float, float] | None
) -> tuple[NDArray[np.float32], NDArray[np.bool_], NDArray[np.bool_], tuple[int, int]]:
    """Of a part of an image: shares of a marker in its pixels (h, w), 0 where another thing explains them; where another thing
    is seen, (h, w); where the background is not known, (h, w); and the corner of the part.
    """
    left, top, right, bottom = 0, 0, image.shape[1], image.shape[0]
    if near is not None:
        x, y, radius = near
        left, top = max(0, int(x - radius)), max(0, int(y - radius))
        right, bottom = min(right, int(x + radius) + 1), min(bottom, int(y + radius) + 1)
    if right - left < 3 or bottom - top < 3:
        return np.zeros((1, 1), np.float32), np.zeros((1, 1), bool), np.zeros((1, 1), bool), (0, 0)
    part, behind = image[top:bottom, left:right], background[top:bottom, left:right]
    apart = cv2.absdiff(part, np.nan_to_num(behind).round().astype(np.uint8)).max(-1)
    unknown = np.isnan(behind[..., 0])
    rows, columns = np.nonzero((cv2.blur(apart, (3, 3)) > 0.7 * _LEAST_CHANGE) & ~unknown)
    pixels, behind = part[rows, columns].astype(np.float32), behind[rows, columns]
    change, towards = pixels - behind, colour - behind
    size = np.square(towards).sum(-1)
    share = (change * towards).sum(-1) / np.maximum(size, 1.0)
    rest, length = np.linalg.norm(change - share[:, None] * towards, axis=-1), np.linalg.norm(change, axis=-1)
    fits = (length > _LEAST_CHANGE) & (rest < _UNEXPLAINED * length + _LEAST_CHANGE / 2) & (size > _LEAST_CONTRAST**2)
    shares = np.zeros(part.shape[:2], np.float32)
    shares[rows, columns] = np.where(fits, share, 0.0).clip(0, 1)
    other = unknown.copy()
    other[rows, columns] = (length > _OTHER_CHANGE) & ~fits
    things = cv2.morphologyEx(other.astype(np.uint8), cv2.MORPH_OPEN, np.ones((2, 2), np.uint8)) > 0
    return shares, things, unknown, (left, top)


def _markers_in(
    shares: NDArray[np.float32], other: NDArray[np.bool_], unknown: NDArray[np.bool_], corner: tuple[int, int]
) -> list[Candidate]:
    """Markers in connected pixels with shares (h, w): what is half as pure as the purest pixels belongs together.

    A marker at rest covers pixels wholly. One that is blurred covers each of them for a shorter time the longer its streak is.
    Something compact that is nowhere pure is another thing. What touches an unknown background may be only a part of a marker.
    """
    seen = shares[shares > 0]
    peak = float(np.percentile(seen, 95))
    count, labels = cv2.connectedComponents((shares > max(_LEAST_SHARE, 0.5 * peak)).astype(np.uint8), connectivity=8)
    found = []
    for label in range(1, count):
        own = cv2.dilate((labels == label).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        if (own & unknown).any():
            continue
        mine = np.where(own & ((labels == 0) | (labels == label)), shares, np.float32(0))
        rows, columns = np.nonzero(mine)
        weights = mine[rows, columns].astype(np.float64)
        area = float(weights.sum())
        if area < _LEAST_AREA_PX:
            continue
        x, y = float(columns @ weights / area), float(rows @ weights / area)
        spread = np.cov(np.stack([columns, rows]), aweights=weights)
        width, length = np.sqrt(12 * np.maximum(np.linalg.eigvalsh(spread), 0.0)) + 1e-9
        if peak >= _PURITY * min(1.0, width / max(length - width, 1e-9)):
            blur = float(np.sqrt(max(length**2 - width**2, 0.0)))
            found.append(Candidate(x + corner[0], y + corner[1], area, float(length), blur, Patch(mine, other, corner)))
    return found


@dataclass(eq=False)
class TapeTrack:
    """The candidates of one marker over a video, of which :meth:`chosen` selects those that are sure."""

    found: list[list[Candidate]] = field(default_factory=list)
    """of each frame"""
    near: list[tuple[float, float, float] | None] = field(default_factory=list)
    """x, y and radius of where the end can be, by the hands; None where that is not known"""

    def add(self, candidates: list[Candidate], near: tuple[float, float, float] | None = None) -> None:
        """Add a frame."""
        self.found.append(candidates)
        self.near.append(near)

    def chosen(self) -> list[Candidate | None]:
        """The one candidate in each frame that is the marker; None where that is not sure."""
        allowed = [[c for c in found if _within(c, near)] for found, near in zip(self.found, self.near, strict=True)]
        chosen: list[Candidate | None] = []
        for found, area in zip(allowed, _usual_areas(allowed), strict=True):
            fitting = [c for c in found if _AREA_RANGE[0] * area <= c.area_px <= _AREA_RANGE[1] * area]
            alone = len(fitting) == 1 and not any(c.area_px >= _RIVAL * area for c in found if c is not fitting[0])
            chosen.append(fitting[0] if alone else None)
        follow = without_jumps(np.array([(c.x, c.y) if c else (np.nan, np.nan) for c in chosen]).reshape(-1, 2))
        return [c if sure else None for c, sure in zip(chosen, np.isfinite(follow[:, 0]), strict=True)]


def ends_of(tracks: Sequence[TapeTrack], balls: bool = False) -> list[Array]:
    """Of the marker of each track (F, 3): x and y in pixels, and a score; NaN, NaN, 0 where no end is sure.

    The direction of the stick is that from one marker to the other, or from the hands to the last marker. Balls are fitted by
    discs, bands are centred by their symmetry. The score is lower where less of a marker is seen. It is least where the
    direction is not known, because the stick itself may hide a part.

    Args:
        tracks: of the markers on a stick.
        balls: whether the markers are balls.
    """
    chosen = [track.chosen() for track in tracks]
    return [
        _centres(number, chosen, track.near if number == len(tracks) - 1 else [None] * len(track.near), balls)
        for number, track in enumerate(tracks)
    ]


def _centres(
    number: int,
    chosen: Sequence[Sequence[Candidate | None]],
    hands: Sequence[tuple[float, float, float] | None],
    balls: bool,
) -> Array:
    """The ends (F, 3) of one of the markers; ``chosen`` has the candidates of all of them."""
    own = chosen[number]
    others = [[track[frame] for k, track in enumerate(chosen) if k != number] for frame in range(len(own))]
    axes = [None if c is None else _axis(c, seen, near) for c, seen, near in zip(own, others, hands, strict=True)]
    ends = _by_discs(own, axes) if balls else _by_symmetry(own, axes)
    unclear = np.array([axis is None for axis in axes]) & (len(chosen) > 1)
    ends[:, 2] = np.where(unclear, _LEAST_SCORE, np.clip(ends[:, 2], _LEAST_SCORE, 1.0))
    ends[np.isnan(ends[:, 0]), 2] = 0.0
    return ends


def _by_symmetry(own: Sequence[Candidate | None], axes: Sequence[Array | None]) -> Array:
    """Centres and scores (F, 3) of what is seen of a marker, along the stick of what is beside the stick."""
    areas = np.array([np.nan if c is None else c.area_px for c in own])
    whole = np.percentile(areas[np.isfinite(areas)], 90) if np.isfinite(areas).any() else np.nan
    ends = np.full((len(own), 3), np.nan)
    for frame, (candidate, axis) in enumerate(zip(own, axes, strict=True)):
        if candidate is None:
            continue
        centre: Array | None = np.array([candidate.x, candidate.y])
        if candidate.patch is not None and axis is not None:
            centre = candidate.patch.centre_on(axis)
        if centre is not None:
            ends[frame] = *centre, (candidate.area_px / whole) ** 2
    return ends


def _by_discs(own: Sequence[Candidate | None], axes: Sequence[Array | None]) -> Array:
    """Centres and scores (F, 3) of a ball: of the discs that fit its outline. The score is how well the outline determines the
    centre, as a variance relative to the best frames."""
    patches = [
        None if c is None or c.patch is None or (axis is not None and c.patch.is_covered(axis)) else c.patch
        for c, axis in zip(own, axes, strict=True)
    ]
    discs = discs_of(patches, axes, _streaks(own), _AREA_FRAMES)
    ends = np.array([(np.nan,) * 3 if disc is None else (*disc.centre, disc.sigma_px**-2) for disc in discs]).reshape(-1, 3)
    known = np.isfinite(ends[:, 2])
    if known.any():
        ends[:, 2] /= np.percentile(ends[known, 2], 90)
    return ends


def _streaks(own: Sequence[Candidate | None]) -> Array:
    """Motion (F, 2) of a marker during the exposures, pixels: a share of the way to the neighbouring frames.

    The share is the same in all frames: it is the median of those in which the marker is fast.
    """
    places = np.array([(c.x, c.y) if c else (np.nan, np.nan) for c in own]).reshape(-1, 2)
    motion = np.array([_motion(places, frame) for frame in range(len(own))]).reshape(-1, 2)
    speed = np.linalg.norm(motion, axis=-1)
    if not speed.any():
        return motion
    fast = speed > 0.5 * np.percentile(speed[speed > 0], 95)
    blur = np.array([c.blur_px if c else 0.0 for c in own])
    return motion * float(np.clip(np.median(blur[fast] / speed[fast]), 0.0, 1.0))


def _motion(places: Array, frame: int) -> Array:
    """Pixels (2,) from one frame to the next, by the parabola through the places (F, 2) around a frame; 0 where not known."""
    around = np.arange(max(0, frame - 2), min(len(places), frame + 3))
    around = around[np.isfinite(places[around, 0])]
    if len(around) < 2 or not np.isfinite(places[frame, 0]):
        return np.zeros(2)
    return np.polynomial.polynomial.polyfit(around - frame, places[around], min(2, len(around) - 1))[1]


def _axis(candidate: Candidate, others: Sequence[Candidate | None], hands: tuple[float, float, float] | None) -> Array | None:
    """The direction (2,) of the stick at a marker, by another marker or by the hands; None where neither is known."""
    places = [(other.x, other.y) for other in others if other is not None] + ([] if hands is None else [hands[:2]])
    for place in places:
        apart = np.array([candidate.x, candidate.y]) - place
        if np.linalg.norm(apart) > _NO_DIRECTION_PX:
            return apart
    return None


def _of_hue(image: Image, name: str) -> NDArray[np.bool_]:
    hsv = cv2.cvtColor(image, cv2.COLOR_BGR2HSV).astype(np.float32)
    apart = np.abs((2 * hsv[..., 0] - HUES[name] + 180) % 360 - 180)
    return np.asarray((apart < _HUE_TOLERANCE_DEG) & (hsv[..., 1] > _LEAST_SATURATION) & (hsv[..., 2] > _LEAST_VALUE))


def _changed(image: Image, background: NDArray[np.float32]) -> NDArray[np.bool_]:
    return np.asarray(np.abs(image.astype(np.float32) - background).max(-1) > 3 * _LEAST_CHANGE)


def _is_inside(candidate: Candidate, shape: tuple[int, ...]) -> bool:
    """Whether nothing of a candidate can be outside the image."""
    reach = candidate.streak_px / 2 + 2
    return reach < candidate.x < shape[1] - reach and reach < candidate.y < shape[0] - reach


def _within(candidate: Candidate, near: tuple[float, float, float] | None) -> bool:
    return near is None or np.hypot(candidate.x - near[0], candidate.y - near[1]) <= near[2]


def _usual_areas(found: list[list[Candidate]]) -> Array:
    """(F,), the usual area of the marker around each frame: the median of the largest candidates of many frames."""
    largest = np.array([max((c.area_px for c in frame), default=np.nan) for frame in found])
    usual = np.full(len(found), np.nan)
    overall = float(np.nanmedian(largest)) if np.isfinite(largest).any() else np.nan
    for frame in range(len(found)):
        around = largest[max(0, frame - _AREA_FRAMES) : frame + _AREA_FRAMES + 1]
        around = around[np.isfinite(around)]
        usual[frame] = np.median(around) if len(around) >= _AREA_FRAMES else overall
    return usual


def without_jumps(ends: Array) -> Array:
    """Ends (F, 2) without those that do not follow from their neighbours, the most surprising of neighbours first."""
    kept = ends.copy()
    surprise = np.array([_surprise(kept, frame) for frame in range(len(kept))])
    while (surprise > 1).any():
        around = [surprise[max(0, k - _NEIGHBOURS) : k + _NEIGHBOURS + 1].max() for k in range(len(kept))]
        worst = np.flatnonzero((surprise > 1) & (surprise == around))
        kept[worst] = np.nan
        for frame in {n for k in worst for n in range(max(0, k - _NEIGHBOURS), min(len(kept), k + _NEIGHBOURS + 1))}:
            surprise[frame] = _surprise(kept, frame)
    return kept


def _surprise(ends: Array, frame: int) -> float:
    """How far an end is from the parabola through its neighbours, over what is allowed; 2 where there are hardly any."""
    known = np.isfinite(ends[:, 0])
    if not known[frame]:
        return 0.0
    around = np.arange(max(0, frame - _NEIGHBOURS), min(len(ends), frame + _NEIGHBOURS + 1))
    around = around[known[around] & (around != frame)]
    if len(around) < 4 or not around.min() < frame < around.max():
        return 0.0 if len(around) >= 2 else 2.0
    fit = np.polynomial.polynomial.polyfit(around - frame, ends[around, :2], 2)
    allowed = _JUMP_PX + _JUMP_SHARE * float(np.linalg.norm(fit[1]))
    return float(np.linalg.norm(ends[frame, :2] - fit[0])) / allowed
