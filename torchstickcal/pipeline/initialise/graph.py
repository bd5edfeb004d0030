"""From pairs of cameras to a rig: a maximum spanning tree, and poses propagated along its edges."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from torchstickcal.errors import RigError
from torchstickcal.geometry.triangulation import triangulate, triangulate_robustly
from torchstickcal.pipeline.initialise.pairs import Pair, RelativePose, two_view_depths
from torchstickcal.pipeline.initialise.views import Array, Views, spread

_PLAUSIBLE_SHARE = 0.5
"""Number of points in front of both cameras, relative to the best pose, from which a pose is plausible."""
_SUFFICIENT_INLIERS = 0.9
"""Inliers over common points from which a pair joins the tree without comparison with other pairs."""
_MAX_POINTS = 400
_SOUND_SHARE = 0.6
"""Support of a camera below which it is placed again."""
_CLEAR_GAIN = 0.05
"""Gain of support from which the new place is better."""
_PLACING_ROUNDS, _PNP_ROUNDS, _MIN_POINTS = 3, 300, 12


class Edge(NamedTuple):
    """An edge of the tree, from a camera with a known pose to the next camera."""

    parent: int
    child: int
    poses: tuple[RelativePose, ...]


def spanning_tree(
    common: NDArray[np.int_], relate: Callable[[int, int], Pair], labels: Sequence[str], min_common: int
) -> list[Edge]:
    """Edges of the maximum spanning tree over the strengths of the pairs, from the strongest pair on (Prim's algorithm).

    To relate a pair is the expensive step. The number of common points is an upper bound for the strength. So a pair is
    related only if no other pair that could join the tree has a higher bound or strength. A pair of which almost all points are
    inliers, with sufficient parallax, joins the tree at once.

    Args:
        common: number of common points of each pair, (C, C).
        relate: a function that estimates the relative poses of two cameras.
        labels: names of the cameras, for error messages.
        min_common: smallest number of inliers of an edge.

    Raises:
        RigError: if the cameras fall into several parts. The message names them, the smallest first, and what they share.
    """
    related, waiting = dict[tuple[int, int], Pair](), set(range(len(labels)))
    trees = list[list[Edge]]()
    parts = list[set[int]]()
    while waiting:
        edges = _grown(waiting, common, relate, related, min_common)
        trees.append(edges)
        parts.append({camera for edge in edges for camera in (edge.parent, edge.child)} or {min(waiting)})
        waiting -= parts[-1]
    if len(parts) > 1:
        counts = {pair: related[pair].inliers if pair in related else int(common[pair]) for pair in _pairs(range(len(labels)))}
        raise _disconnected(sorted(map(sorted, parts), key=len), counts, labels, min_common)
    return trees[0]


def _grown(
    cameras: set[int],
    common: NDArray[np.int_],
    relate: Callable[[int, int], Pair],
    related: dict[tuple[int, int], Pair],
    min_common: int,
) -> list[Edge]:
    """The edges of the tree that grows from the strongest pair of some cameras; ``related`` takes up what it estimates."""
    placed, edges = set[int](), list[Edge]()
    while True:
        crossing = [(i, j) for i, j in _pairs(cameras) if not placed or (i in placed) != (j in placed)]
        usable = [pair for pair in crossing if (related[pair].inliers if pair in related else common[pair]) >= min_common]
        if not usable:
            return edges
        bounds = {pair: related[pair].strength if pair in related else float(common[pair]) for pair in usable}
        best = max(usable, key=lambda pair: bounds[pair])
        if best not in related:
            related[best] = relate(*best)
            if related[best].strength < _SUFFICIENT_INLIERS * related[best].common:
                continue
        poses = related[best].poses
        if best[0] in placed or not placed:
            edges.append(Edge(best[0], best[1], poses))
        else:
            edges.append(Edge(best[1], best[0], tuple(pose.inverse() for pose in poses)))
        placed |= set(best)


def _pairs(cameras: Iterable[int]) -> list[tuple[int, int]]:
    return list(itertools.combinations(sorted(cameras), 2))


def propagate(edges: Sequence[Edge], views: Views, scale: float) -> tuple[Array, Array]:
    """Rotations (C, 3, 3) and translations (C, 3) of all cameras, in the frame of camera 0. The first edge has length 1.

    An essential matrix allows four poses. The number of points in front of both cameras does not always identify the true pose
    among them: the twisted pair can have as many. A third camera decides, because the wrong pose projects the points elsewhere
    in it. So the cameras are placed once for every plausible pose of the first edge. At each further edge, the pose with the
    largest support by the points known so far is used. Of these rigs, the one with the largest total support is kept. Where the
    points of the others contradict a camera, all is also done with steady keypoints alone, each camera that is contradicted is
    placed again, and the rig is kept on which more keypoints agree. A few hundred points, evenly spaced in the session, are
    sufficient.

    Args:
        edges: the spanning tree.
        views: the keypoints.
        scale: scale of the robust kernel, in normalised image coordinates.
    """
    columns = np.flatnonzero(views.visible.any(0))
    columns = columns[spread(len(columns), _MAX_POINTS)]
    rays, visible = views.rays(list(range(len(views.visible))), columns)
    first = edges[0].poses
    plausible = [pose for pose in first if pose.in_front >= _PLAUSIBLE_SHARE * first[0].in_front]

    def placed(used: NDArray[np.bool_]) -> tuple[Array, Array]:
        rigs = [_place_cameras(root, edges, rays, used, scale) for root in plausible]
        return max(rigs, key=lambda rig: rig[0])[1:]

    def support(rig: tuple[Array, Array]) -> float:
        rotations, translations = rig
        return sum(_supported(camera, rotations, translations, rays, visible, scale).share for camera in range(len(rays)))

    rotations, translations = placed(visible)
    if _doubtful(rotations, translations, rays, visible, scale):
        steady = visible & views.steady[:, columns]
        rigs: list[tuple[Array, Array]] = []
        for used in (steady, visible) if steady.sum(1).min() >= _MIN_POINTS else (visible,):
            rotations, translations = placed(used)
            _place_again(rotations, translations, rays, used, scale)
            rigs.append((rotations, translations))
        rotations, translations = max(rigs, key=support)
    from_first = rotations @ rotations[0].T
    from_first[0] = np.eye(3)
    return from_first, translations - from_first @ translations[0]


def _doubtful(rotations: Array, translations: Array, rays: Array, visible: NDArray[np.bool_], scale: float) -> list[int]:
    """The cameras that the points of all others contradict, the least supported first; none of two."""
    shares: dict[int, float] = {}
    # points that most views agree on take longer, and are needed only where plain ones do not do
    for camera, plain in enumerate(_points_by_others(rotations, translations, rays, visible, scale) if len(rays) > 2 else ()):
        if _support(camera, plain, rotations, translations, rays, visible, scale).share < _SOUND_SHARE:
            shares[camera] = _supported(camera, rotations, translations, rays, visible, scale).share
    return [camera for camera in sorted(shares, key=lambda c: shares[c]) if shares[camera] < _SOUND_SHARE]


def _place_again(rotations: Array, translations: Array, rays: Array, visible: NDArray[np.bool_], scale: float) -> None:
    """Place cameras anew, in place, by the points of all others, the least supported first (perspective-n-point, RANSAC).

    A new place must be better for the camera, and no worse for all cameras together: where few points are right, the wrong ones
    can be enough for a camera alone.
    """

    def supports() -> list[_Support]:
        return [_supported(camera, rotations, translations, rays, visible, scale) for camera in range(len(rays))]

    for _ in range(_PLACING_ROUNDS):
        doubtful = _doubtful(rotations, translations, rays, visible, scale)
        if not doubtful:
            return
        before = supports()
        for camera in doubtful:
            own = before[camera]
            if len(own.seen) < _MIN_POINTS:
                continue
            pose = _resected(own.known[:, own.seen], rays[camera][:, own.seen], scale)
            if pose is None:
                continue
            kept = rotations[camera].copy(), translations[camera].copy()
            rotations[camera], translations[camera] = pose
            after = supports()
            better = after[camera].share >= own.share + _CLEAR_GAIN
            if better and sum(support.share for support in after) > sum(support.share for support in before):
                before = after
            else:
                rotations[camera], translations[camera] = kept


def _resected(points: Array, rays: Array, scale: float) -> tuple[Array, Array] | None:
    """Rotation and translation of a camera by known points (3, n) and its rays (2, n) to them; None if none are found."""
    points, rays = np.ascontiguousarray(points.T), np.ascontiguousarray(rays.T)
    try:
        found, turn, shift, _ = cv2.solvePnPRansac(
            points, rays, np.eye(3), None,
            iterationsCount=_PNP_ROUNDS, reprojectionError=scale / 2, confidence=0.9999, flags=cv2.SOLVEPNP_SQPNP,
        )  # fmt: skip
    except cv2.error:  # points in one place or on one line
        return None
    if not found or not (np.isfinite(turn).all() and np.isfinite(shift).all()):
        return None
    rotation, translation = (np.asarray(part, dtype=np.float64) for part in (cv2.Rodrigues(turn)[0], shift[:, 0]))
    return rotation, translation


class _Support(NamedTuple):
    """How well a camera agrees with the points that the others see."""

    share: float
    """mean kernel weight of its keypoints, 0 to 1"""
    known: Array
    """(3, n), the points by the other cameras; NaN where not known"""
    seen: NDArray[np.intp]
    """the known points that it sees"""


def _supported(
    camera: int, rotations: Array, translations: Array, rays: Array, visible: NDArray[np.bool_], scale: float
) -> _Support:
    """The support of a camera by the points that most of the others agree on."""
    others = [other for other in range(len(rays)) if other != camera]
    known = _points(triangulate_robustly, others, rotations, translations, rays, visible, scale)
    return _support(camera, known, rotations, translations, rays, visible, scale)


def _support(
    camera: int,
    known: Array,
    rotations: Array,
    translations: Array,
    rays: Array,
    visible: NDArray[np.bool_],
    scale: float,
) -> _Support:
    """The support of a camera by points (3, n) of all others."""
    seen = np.flatnonzero(visible[camera] & np.isfinite(known).all(0))
    weights = _kernel_weights(rotations[camera], translations[camera], known[:, seen], rays[camera][:, seen], scale)
    return _Support(float(weights.mean()) if len(seen) else 1.0, known, seen)


def _points_by_others(rotations: Array, translations: Array, rays: Array, visible: NDArray[np.bool_], scale: float) -> Array:
    """For each of the cameras, the points that the others see, (C, 3, n); NaN where fewer than two of them do."""
    others = np.array([[other for other in range(len(rays)) if other != camera] for camera in range(len(rays))])
    return _points(triangulate, others, rotations, translations, rays, visible, scale)


def _points(
    method: Callable[..., torch.Tensor],
    cameras: list[int] | NDArray[np.int_],
    rotations: Array,
    translations: Array,
    rays: Array,
    visible: NDArray[np.bool_],
    scale: float,
) -> Array:
    """Points (3, n) that some of the cameras see, triangulated by a method; NaN where fewer than two of them do.

    Several rows of cameras, of the same number, give several such sets of points, (..., 3, n).
    """
    known = (torch.from_numpy(of_cameras[cameras]) for of_cameras in (rotations, translations, rays))
    return method(*known, torch.from_numpy(visible[cameras]).double(), scale=scale).numpy()


def _kernel_weights(rotation: Array, translation: Array, points: Array, rays: Array, scale: float) -> Array:
    """Weights (n,) of keypoints by their distance from the projections of points (3, n); zero behind the camera."""
    x, y, z = rotation @ points + translation[:, None]
    z_safe = np.where(np.abs(z) < 1e-9, 1e-9, z)
    squared = (x / z_safe - rays[0]) ** 2 + (y / z_safe - rays[1]) ** 2
    return (z > 0) / (1 + squared / scale / scale)


def _place_cameras(
    root: RelativePose, edges: Sequence[Edge], rays: Array, visible: NDArray[np.bool_], scale: float
) -> tuple[float, Array, Array]:
    """Total support, rotations and translations of the rig with a given pose of the first edge."""
    cameras = len(rays)
    rotations, translations = np.tile(np.eye(3), (cameras, 1, 1)), np.zeros((cameras, 3))
    rotations[edges[0].child], translations[edges[0].child] = root.rotation, root.translation
    placed = [edges[0].parent, edges[0].child]
    support = float(root.in_front)
    for edge in edges[1:]:
        known = _points(triangulate, placed, rotations, translations, rays, visible, scale)
        candidates = _candidates(edge, rotations, translations, known, rays, visible, scale)
        gained, rotations[edge.child], translations[edge.child] = max(candidates, key=lambda candidate: candidate[0])
        support += gained
        placed.append(edge.child)
    return support, rotations, translations


def _candidates(
    edge: Edge,
    rotations: Array,
    translations: Array,
    known: Array,
    rays: Array,
    visible: NDArray[np.bool_],
    scale: float,
) -> Iterator[tuple[float, Array, Array]]:
    """Support, rotation and translation of the child of an edge, for each of the edge's relative poses.

    The length of the baseline is the median ratio of the depths of known points to their depths for a baseline of length 1. The
    support is the sum of the kernel weights of the known points that the child sees.
    """
    parent, child = edge.parent, edge.child
    seen = np.flatnonzero(visible[child] & np.isfinite(known[0]))
    points, own, shared = known[:, seen], rays[child][:, seen], visible[parent, seen]
    depth_known = rotations[parent, 2] @ points[:, shared] + translations[parent, 2]
    of_parent, of_child = rays[parent][:, seen[shared]], own[:, shared]
    for pose in edge.poses:
        depth_pair, _ = two_view_depths(pose.rotation, pose.translation, of_parent, of_child)
        usable = (depth_pair > 0) & (depth_known > 0)
        baseline = float(np.median(depth_known[usable] / depth_pair[usable])) if usable.any() else 1.0
        rotation = pose.rotation @ rotations[parent]
        translation = pose.rotation @ translations[parent] + baseline * pose.translation
        yield float(_kernel_weights(rotation, translation, points, own, scale).sum()), rotation, translation


def _disconnected(
    parts: list[list[int]], shared: dict[tuple[int, int], int], labels: Sequence[str], min_common: int
) -> RigError:
    """The error that names the parts, the smallest first, and what they share.

    Args:
        parts: cameras of each part.
        shared: for each pair of cameras, the number of points that fit one relative pose, or an upper bound of it.
        labels: names of the cameras.
        min_common: number of such points from which a pair connects two parts.
    """
    named = [", ".join(labels[camera] for camera in part) for part in parts]
    links: list[str] = []
    for first, second in itertools.combinations(parts, 2):
        i, j = max((sorted((a, b)) for a in first for b in second), key=lambda pair: shared[pair[0], pair[1]])
        links.append(f"{labels[i]} and {labels[j]} share {shared[i, j]} points")
    return RigError(
        "the cameras fall into parts that see too little in common to be one rig",
        where="keypoints",
        got=f"{len(parts)} parts: {'; '.join(named)}. At best, {', '.join(links)}",
        expected=f"pairs of cameras between the parts that share at least {min_common} points that fit one relative pose",
        remedy="Record a longer session in which cameras of different parts see the athlete together, remove cameras, or "
        'calibrate the largest part alone (incomplete = "largest").',
        parts=tuple(tuple(labels[camera] for camera in part) for part in parts),
    )
