"""Several people in view: which detections are the same person, in time and across cameras, and who of them is the athlete.

Detections that clearly follow each other in one camera form a tracklet; where two people come close, tracklets end. Each pair
of cameras has one essential matrix, whoever is seen: the one that explains most detections. By it, tracklets of different
cameras are the same person or not, and by all cameras together the parts before and after a crossing belong to each other.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchstickcal.errors import CalibrationError
from torchstickcal.geometry.cameras import Intrinsics
from torchstickcal.io.recording import View

AUTOMATIC = "auto"
_LONGEST_GAP = 15
"""Frames for which a person may be lost within a tracklet."""
_FARTHEST_STEP = 0.3
"""How far a person may be from where it was expected, in lengths of its diagonal."""
_AMBIGUOUS = 0.4
"""A tracklet ends where the best detection is not closer than this share of the distance of the second best."""
_COMMON_POINTS = 3
_MOST_TRACKLETS = 240
_TRIED_TRACKLETS = 4
"""Number of the longest tracklets of a camera from which essential matrices are estimated."""
_MOST_FRAMES = 150
"""Number of frames, evenly spaced, in which two tracklets are compared."""
_MOST_POINTS = 400
_LEAST_POINTS = 20
_RANSAC_SHARE = 0.008
"""Largest distance of an inlier from its epipolar line, in focal lengths."""
_CONSISTENT_SPREADS = 3.0
_LEAST_TOLERANCE = 0.002
_CONTINUITY = 4.0
"""How much it counts, in frames of agreement between two cameras, that one tracklet begins where another ended."""
_REACH = 0.25
"""How far from the stick its holder's hands are, in lengths of the holder's diagonal."""
_NEAR = 0.5
"""How much of the athlete's nearness to the stick somebody has who is taken for the athlete in a camera with another clock."""
_AGREEING = 0.7
"""Least share of the frames in which cameras agree on the athlete, for the choice to be sure."""
_CLEAR = 0.15
"""Least lead of the athlete over the next person, as a share of the athlete's measure."""

Rows = NDArray[np.intp]
Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Athlete:
    """The detections of the athlete."""

    rows: tuple[Rows, ...]
    """for each camera, the rows of its view; at most one in each frame"""
    notes: tuple[str, ...] = ()
    """who was chosen, and how sure that is"""


def athlete_of(
    views: Sequence[View],
    shifts: Sequence[int],
    how: str,
    names: Sequence[str] | None,
    cameras: Intrinsics | None,
    image_size: Tensor | None,
    stick: Sequence[View] | None,
) -> Athlete:
    """The detections of the athlete in each camera.

    Args:
        views: of the C cameras.
        shifts: for each camera, the number at which its frames begin.
        how: as ``person`` of :class:`~torchstickcal.io.Given`.
        names: of the points.
        cameras: intrinsics, if they are known.
        image_size: (C, 2), if it is known.
        stick: views of the stick's ends, where they come from files of their own.

    Raises:
        CalibrationError: if there is no such person, or no such way to choose.
    """
    if how == AUTOMATIC:
        how = "largest" if stick is None else "stick"
    if how.lstrip("-").isdecimal():
        return _numbered(views, int(how))
    if how not in _MEASURES or (how == "stick" and stick is None):
        raise CalibrationError(
            "no way to choose the athlete",
            where="person",
            got=repr(how) + (", without a stick in files of its own" if how == "stick" else ""),
            expected=f"one of {', '.join(_MEASURES)}, auto, or the number that the tracker gave",
        )
    if all(len(np.unique(view.frames)) == len(view.frames) for view in views):
        return Athlete(tuple(np.arange(len(view.frames)) for view in views))
    size = _sizes(views, cameras, image_size)
    people = _People(views, shifts, _rays(views, cameras, size))
    measure, hands, sticks = _MEASURES[how], _hands(names), stick or [None] * len(views)

    def score(camera: int, rows: Rows) -> float:
        return measure(views[camera], rows, size[camera], hands, sticks[camera]) if len(rows) else 0.0

    scores = np.array([[score(camera, rows) for camera, rows in enumerate(person)] for person in people.rows])
    total = scores.sum(1)
    order = np.argsort(-total, kind="stable").tolist()
    near = scores > _NEAR * scores[order[0]].max() if how == "stick" else np.zeros_like(scores, dtype=bool)
    chosen, agreed = people.completed(order, near)
    lead = 1 - (total[order[1]] / total[order[0]] if len(order) > 1 else 0.0) if total[order[0]] > 0 else 0.0
    return Athlete(chosen, _said(views, chosen, how, lead if agreed else 0.0, people.agreement(order[0])))


def _said(views: Sequence[View], chosen: Sequence[Rows], how: str, lead: float, share: float | None) -> tuple[str, ...]:
    seen = ", ".join(
        f"{view.name} {len(rows)} of {len(np.unique(view.frames))}" for view, rows in zip(views, chosen, strict=True)
    )
    known = "" if share is None else f" In {100 * share:.0f} % of the frames, the cameras agree on who it is."
    said = (
        f"Several people are in view. The athlete is taken to be the one {_WHO[how]}; frames with the athlete: {seen}.{known}"
    )
    if lead >= _CLEAR and (share is None or share > _AGREEING):
        return (said,)
    return (f"{said} This is not sure; --person chooses another.",)


class _People:
    """Everybody in view: tracklets, grouped into people."""

    def __init__(self, views: Sequence[View], shifts: Sequence[int], rays: Sequence[Array]) -> None:
        self._rays = rays
        self._frames = [view.frames - shift for view, shift in zip(views, shifts, strict=True)]
        tracklets = [(camera, rows) for camera, view in enumerate(views) for rows in _tracklets(view)]
        tracklets.sort(key=lambda tracklet: (-len(tracklet[1]), tracklet[0], tracklet[1][0]))
        self._tracklets = tracklets[:_MOST_TRACKLETS]
        count = len(self._tracklets)
        self._compared, self._agreed = np.zeros((count, count)), np.zeros((count, count))
        self._groups = _grouped(self._affinities(views))
        self.rows = [tuple(self._joined(group, camera) for camera in range(len(views))) for group in self._groups]

    def completed(self, order: Sequence[int], near: NDArray[np.bool_]) -> tuple[tuple[Rows, ...], bool]:
        """The rows of the first of some people, in order of preference; and whether this person is in every camera.

        Where a camera does not have the person, the next one in the order is taken of whom it saw, if the camera could not be
        compared with the others, or if ``near`` (people, cameras) says that this one has the stick.
        """
        rows = list(self.rows[order[0]])
        absent = [camera for camera, own in enumerate(rows) if not len(own)]
        for camera in absent:
            for person in order[1:]:
                linked = self._compared[np.ix_(self._groups[order[0]], self._groups[person])].any()
                if len(self.rows[person][camera]) and (near[person, camera] or not linked):
                    rows[camera] = self.rows[person][camera]
                    break
        return tuple(rows), not absent

    def agreement(self, person: int) -> float | None:
        """Share of the frames, seen by two cameras, in which these agree on a person; None if none was compared."""
        group = np.array(self._groups[person])
        compared = self._compared[np.ix_(group, group)].sum()
        if not compared:
            return None
        return float(self._agreed[np.ix_(group, group)].sum() / compared)

    def _joined(self, group: Sequence[int], camera: int) -> Rows:
        rows = [rows for own, rows in (self._tracklets[index] for index in group) if own == camera]
        return np.sort(np.concatenate(rows)) if rows else np.zeros(0, dtype=np.intp)

    def _affinities(self, views: Sequence[View]) -> Array:
        """How much speaks for two tracklets being one person (T, T), in frames; counts those in which they are compared."""
        affinity = np.zeros_like(self._compared)
        by_camera = [[index for index, (own, _) in enumerate(self._tracklets) if own == camera] for camera in range(len(views))]
        for camera, own in enumerate(by_camera):
            for first, second in ((a, b) for a in own for b in own if a < b):
                affinity[first, second] = self._continuity(views[camera], first, second)
            for other in range(camera + 1, len(views)):
                self._compare(own, by_camera[other], affinity)
        self._compared += self._compared.T
        self._agreed += self._agreed.T
        return affinity + affinity.T

    def _continuity(self, view: View, first: int, second: int) -> float:
        """What speaks for two tracklets of one camera being one person: minus infinity if they overlap."""
        a, b = self._tracklets[first][1], self._tracklets[second][1]
        if np.intersect1d(view.frames[a], view.frames[b]).size:
            return -np.inf
        earlier, later = (a, b) if view.frames[a[-1]] < view.frames[b[0]] else (b, a)
        gap = view.frames[later[0]] - view.frames[earlier[-1]]
        if gap <= 0 or gap > _LONGEST_GAP:
            return 0.0
        expected = _expected(view, list(earlier), int(view.frames[later[0]]))
        distance = float(_distances(expected[None], view.keypoints[later[:1]])[0, 0])
        return float(_CONTINUITY * max(0.0, 1 - distance / _FARTHEST_STEP) / gap)

    def _compare(self, own: Sequence[int], others: Sequence[int], affinity: Array) -> None:
        """Compare the tracklets of two cameras by the essential matrix that explains most of them."""
        pairs = {(a, b): pair for a in own for b in others if (pair := self._common(a, b)) is not None}
        longest = [(a, b) for a in own[:_TRIED_TRACKLETS] for b in others[:_TRIED_TRACKLETS] if (a, b) in pairs]
        best: tuple[float, Array, float] | None = None
        for key in longest:
            essential = _essential(*pairs[key])
            if essential is None:
                continue
            residuals = {other: _residuals(essential, *pairs[other]) for other in longest}
            tolerance = max(_LEAST_TOLERANCE, _CONSISTENT_SPREADS * float(np.median(residuals[key])))
            support = sum(float(np.maximum(0, 1 - r / tolerance).sum()) for r in residuals.values()) / tolerance**0.5
            if best is None or support > best[0]:
                best = support, essential, tolerance
        if best is None:
            return
        for (a, b), pair in pairs.items():
            residual = _residuals(best[1], *pair)
            affinity[a, b] = float(np.clip(1 - residual / best[2], -1, 1).sum())
            self._compared[a, b] = len(residual)
            self._agreed[a, b] = (residual < best[2]).sum()

    def _common(self, first: int, second: int) -> tuple[Array, Array] | None:
        """The rays (n, P, 2) of two tracklets in the frames that they have in common; None if there are too few."""
        (camera, a), (other, b) = self._tracklets[first], self._tracklets[second]
        _, in_a, in_b = np.intersect1d(self._frames[camera][a], self._frames[other][b], return_indices=True)
        if len(in_a) == 0:
            return None
        spaced = np.unique(np.linspace(0, len(in_a) - 1, _MOST_FRAMES).round().astype(int))
        rays = self._rays[camera][a[in_a[spaced]]], self._rays[other][b[in_b[spaced]]]
        known = np.isfinite(rays[0]).all(-1) & np.isfinite(rays[1]).all(-1)
        enough = known.sum(axis=1) > 0
        return (rays[0][enough], rays[1][enough]) if len(rays[0]) and enough.any() else None


def _tracklets(view: View) -> list[Rows]:
    """Rows of a view that are surely one person: those of one number of a tracker, else those that follow each other."""
    if (view.persons >= 0).all():
        by_number = [np.flatnonzero(view.persons == person) for person in np.unique(view.persons)]
        if all(len(np.unique(view.frames[rows])) == len(rows) for rows in by_number):
            return by_number
    finished: list[list[int]] = []
    active: list[list[int]] = []
    starts = np.flatnonzero(np.diff(view.frames, prepend=view.frames[0] - 1))
    for rows in np.split(np.arange(len(view.frames)), starts[1:]):
        frame = int(view.frames[rows[0]])
        lost = [tracklet for tracklet in active if frame - view.frames[tracklet[-1]] > _LONGEST_GAP]
        finished += lost
        active = [tracklet for tracklet in active if tracklet not in lost]
        expected = np.stack([_expected(view, tracklet, frame) for tracklet in active]) if active else view.keypoints[:0]
        distances = _distances(expected, view.keypoints[rows])
        following, ambiguous = _followed(distances)
        finished += [active[index] for index in ambiguous]
        for index, column in following.items():
            active[index].append(int(rows[column]))
        active = [tracklet for index, tracklet in enumerate(active) if index not in ambiguous]
        active += [[int(row)] for column, row in enumerate(rows) if column not in following.values()]
    return [np.array(tracklet) for tracklet in finished + active]


def _followed(distances: Array) -> tuple[dict[int, int], set[int]]:
    """Which detection (column) follows which tracklet (row); and the tracklets for which two detections come into question."""
    following: dict[int, int] = {}
    ambiguous: set[int] = set()
    for row, column in sorted(np.argwhere(distances < _FARTHEST_STEP).tolist(), key=lambda pair: distances[pair[0], pair[1]]):
        if row in following or row in ambiguous or column in following.values():
            continue
        rivals = np.concatenate([np.delete(distances[row], column), np.delete(distances[:, column], row)])
        if len(rivals) and distances[row, column] > _AMBIGUOUS * rivals.min():
            ambiguous.add(row)
        else:
            following[row] = column
    return following, ambiguous


def _expected(view: View, tracklet: Sequence[int], frame: int) -> Array:
    """Where a tracklet's keypoints (P, 3) are expected in a later frame, if they move on as in its last two."""
    last = view.keypoints[tracklet[-1]]
    if len(tracklet) < 2:
        return last
    elapsed = int(view.frames[tracklet[-1]] - view.frames[tracklet[-2]])
    before = view.keypoints[tracklet[-2]]
    common = _both(last, before)
    step = np.median(last[common, :2] - before[common, :2], axis=0) if common.any() else np.zeros(2)
    moved = last.copy()
    moved[:, :2] += step * min(1.0, (frame - int(view.frames[tracklet[-1]])) / elapsed)
    return moved


def _distances(a: Array, b: Array) -> Array:
    """The median distances (A, B) of the points of detections (A, P, 3) and (B, P, 3), in lengths of the larger's diagonal.

    Infinity for two detections with few common points.
    """
    between = np.linalg.norm(a[:, None, :, :2] - b[None, :, :, :2], axis=-1)
    enough = np.isfinite(between).sum(-1) >= min(_COMMON_POINTS, a.shape[1])
    sizes = np.maximum(np.maximum(_diagonal(a)[:, None], _diagonal(b)), 1.0)
    return np.where(enough, _median(between), np.inf) / sizes


def _median(values: Array) -> Array:
    """The lower median (...) of those of some values (..., n) that are not NaN; NaN where there is none."""
    middle = np.maximum(np.isfinite(values).sum(-1, keepdims=True) - 1, 0) // 2
    return np.take_along_axis(np.sort(values, axis=-1), middle, axis=-1)[..., 0]


def _both(a: Array, b: Array) -> NDArray[np.bool_]:
    return np.isfinite(a[:, 0]) & np.isfinite(b[:, 0])


def _diagonal(keypoints: Array) -> Array:
    """The diagonals (n,) of the smallest rectangles around detections (n, P, 3), pixels; 0 without points."""
    seen = np.isfinite(keypoints[..., :1])
    low = np.where(seen, keypoints[..., :2], np.inf).min(1)
    high = np.where(seen, keypoints[..., :2], -np.inf).max(1)
    return np.linalg.norm(np.where(seen.any(axis=1), high - low, 0.0), axis=-1)


def _grouped(affinity: Array) -> list[list[int]]:
    """Tracklets grouped into people: the two groups for which most speaks are joined, until nothing speaks for any two."""
    sums = affinity.copy()
    np.fill_diagonal(sums, -np.inf)
    groups = {index: [index] for index in range(len(sums))}
    while len(groups) > 1:
        first, second = divmod(int(sums.argmax()), len(sums))
        if sums[first, second] <= 0:
            break
        first, second = min(first, second), max(first, second)
        groups[first] += groups.pop(second)
        sums[first] += sums[second]
        sums[:, first] = sums[first]
        sums[first, first] = -np.inf
        sums[second] = sums[:, second] = -np.inf
    return list(groups.values())


def _essential(a: Array, b: Array) -> Array | None:
    """The essential matrix of the rays (n, P, 2) of one person in two cameras; None if there are too few points."""
    known = np.isfinite(a).all(-1) & np.isfinite(b).all(-1)
    first, second = a[known], b[known]
    if len(first) < _LEAST_POINTS:
        return None
    spaced = np.unique(np.linspace(0, len(first) - 1, _MOST_POINTS).round().astype(int))
    found, _ = cv2.findEssentialMat(first[spaced], second[spaced], np.eye(3), cv2.USAC_ACCURATE, 0.999, _RANSAC_SHARE)
    return None if found is None or found.shape[0] < 3 else np.asarray(found[:3], dtype=np.float64)


def _residuals(essential: Array, a: Array, b: Array) -> Array:
    """The median distance (n,) of the points of each frame from their epipolar lines, of rays (n, P, 2), in focal lengths."""
    ones = np.ones_like(a[..., :1])
    first, second = np.concatenate([a, ones], -1), np.concatenate([b, ones], -1)
    lines_b, lines_a = first @ essential.T, second @ essential
    algebraic = np.abs((second * lines_b).sum(-1))
    return _median(algebraic / np.sqrt((lines_a[..., :2] ** 2).sum(-1) + (lines_b[..., :2] ** 2).sum(-1) + 1e-300))


def _rays(views: Sequence[View], cameras: Intrinsics | None, sizes: Sequence[Array]) -> list[Array]:
    """The rays (N, P, 2) of every detection, normalised image coordinates; NaN where a point was not seen."""
    rays = []
    for camera, (view, size) in enumerate(zip(views, sizes, strict=True)):
        pixels = view.keypoints[..., :2]
        if cameras is None:
            rays.append((pixels - size / 2) / size.max())
            continue
        lens = Intrinsics(cameras.matrix[camera : camera + 1].double(), _one(cameras.distortion, camera), cameras.fisheye)
        flat = torch.from_numpy(pixels.reshape(1, -1, 2))
        known = flat.isfinite().all(-1)
        found = torch.full_like(flat, torch.nan)
        found[known] = lens.undistort(flat[known][None])[0]
        rays.append(found.numpy().reshape(pixels.shape))
    return rays


def _one(distortion: Tensor | None, camera: int) -> Tensor | None:
    return None if distortion is None else distortion[camera : camera + 1].double()


def _sizes(views: Sequence[View], cameras: Intrinsics | None, image_size: Tensor | None) -> list[Array]:
    """Width and height of each camera's images; from the principal point where they are not known."""
    if image_size is not None:
        return [size.numpy().astype(np.float64) for size in image_size]
    assert cameras is not None
    return [2 * matrix[:2, 2].numpy().astype(np.float64) for matrix in cameras.matrix]


def _numbered(views: Sequence[View], number: int) -> Athlete:
    """The person of a number that the tracker gave."""
    rows = tuple(np.flatnonzero(view.persons == number) for view in views)
    repeated = any(len(np.unique(view.frames[own])) != len(own) for view, own in zip(views, rows, strict=True))
    if number < 0 or repeated or not any(map(len, rows)):
        known = sorted({int(person) for view in views for person in np.unique(view.persons) if person >= 0})
        raise CalibrationError(
            "nobody has this number",
            where="person",
            got=number,
            expected=f"one of {', '.join(map(str, known[:20]))}" if known else "another choice: the files number nobody",
        )
    return Athlete(rows)


def _hands(names: Sequence[str] | None) -> list[int] | None:
    """The indices of the wrists; None where the points have no such names."""
    found = [index for index, name in enumerate(names or ()) if name in ("left_wrist", "right_wrist")]
    return found or None


_Measure = Callable[[View, Rows, Array, "list[int] | None", View | None], float]


def _largest(view: View, rows: Rows, size: Array, hands: list[int] | None, stick: View | None) -> float:
    return float(_diagonal(view.keypoints[rows]).sum() / np.linalg.norm(size)) / len(np.unique(view.frames))


def _central(view: View, rows: Rows, size: Array, hands: list[int] | None, stick: View | None) -> float:
    centre = np.nanmean(np.where(np.isfinite(view.keypoints[rows, :, :1]), view.keypoints[rows, :, :2], np.nan), axis=1)
    off = np.linalg.norm(centre - size / 2, axis=1) / np.linalg.norm(size / 2)
    return float(np.nan_to_num(np.maximum(0, 1 - off)).sum()) / len(np.unique(view.frames))


def _moving(view: View, rows: Rows, size: Array, hands: list[int] | None, stick: View | None) -> float:
    steps = np.linalg.norm(np.diff(view.keypoints[rows, :, :2], axis=0), axis=-1)
    moved = [float(np.median(step[np.isfinite(step)])) for step in steps if np.isfinite(step).any()]
    return sum(moved) / float(np.linalg.norm(size)) / len(np.unique(view.frames))


def _holding(view: View, rows: Rows, size: Array, hands: list[int] | None, stick: View | None) -> float:
    """How near the hands are to the stick, summed over frames."""
    assert stick is not None
    near = 0.0
    for row in rows:
        ends = stick.keypoints[stick.frames == view.frames[row]].reshape(-1, 3)[:, :2]
        body = view.keypoints[row]
        points = body[hands or slice(None), :2]
        between = np.linalg.norm(ends[:, None] - points[None], axis=-1)
        if np.isfinite(between).any():
            near += float(np.exp(-np.nanmin(between) / (_REACH * max(1.0, _diagonal(body[None])[0]))))
    return near / len(np.unique(view.frames))


_WHO = {
    "largest": "who is largest in the images",
    "central": "who is in the middle",
    "moving": "who moves most",
    "stick": "who is nearest to the stick",
}
"""Words for each way to choose the athlete."""

_MEASURES: dict[str, _Measure] = {"largest": _largest, "central": _central, "moving": _moving, "stick": _holding}
"""How much speaks for a person being the athlete, in one camera."""
