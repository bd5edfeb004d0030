"""From pairs to a rig: a maximum spanning tree, and poses propagated along it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from torchstickcal.errors import RigError
from torchstickcal.pipeline.initialise.pairs import Pair, RelativePose, two_view_depths
from torchstickcal.pipeline.initialise.triangulate import triangulate
from torchstickcal.pipeline.initialise.views import Array, Views, spread

_PLAUSIBLE_SHARE = 0.5
_NEARLY_ALL = 0.9
_MAX_POINTS = 400


class Edge(NamedTuple):
    """A branch of the tree: a placed camera and the camera to place from it."""

    parent: int
    child: int
    poses: tuple[RelativePose, ...]


def spanning_tree(
    common: NDArray[np.int_], relate: Callable[[int, int], Pair], labels: Sequence[str], min_common: int
) -> list[Edge]:
    """Maximum spanning tree over inlier counts, rooted at the first camera, in the order of growth.

    Relating a pair costs more than all the rest, and it cannot have more inliers than common points. So a pair is related
    only when no pair that could join the tree promises more, and is taken at once if nearly all its points are inliers.

    Args:
        common: (C, C), the number of points two cameras have in common.
        relate: finds the relative poses of two cameras.
        labels: the cameras' names, for messages.
        min_common: fewest common points of a pair.

    Raises:
        RigError: if some camera cannot be reached, naming it and the pairs that fell short.
    """
    cameras = range(len(labels))
    placed, edges, related = {0}, list[Edge](), dict[tuple[int, int], Pair]()
    while len(placed) < len(labels):
        crossing = [(i, j) for i in cameras for j in cameras if i < j and (i in placed) != (j in placed)]
        promised = {pair: related[pair].inliers if pair in related else int(common[pair]) for pair in crossing}
        best = max(crossing, key=lambda pair: promised[pair])
        if promised[best] < min_common:
            raise _disconnected({pair: int(common[pair]) for pair in crossing}, placed, labels, min_common)
        if best not in related:
            related[best] = relate(*best)
            if related[best].inliers < _NEARLY_ALL * related[best].common:
                continue
        poses = related[best].poses
        if best[0] in placed:
            edges.append(Edge(best[0], best[1], poses))
        else:
            edges.append(Edge(best[1], best[0], tuple(pose.inverse() for pose in poses)))
        placed.add(edges[-1].child)
    return edges


def propagate(edges: Sequence[Edge], views: Views, scale: float) -> tuple[Array, Array]:
    """Poses of all cameras, world to camera, in the frame of the first; the first edge has length 1.

    A pose out of an essential matrix is one of four, and the count of points in front of both cameras does not always
    tell which: the twisted twin is told from the true one by a third camera, in which it projects the points elsewhere.
    So the tree is grown from every plausible pose of the first edge, at each edge the pose is taken that the points
    placed so far support best, and the tree with most support is returned. A few hundred points, spread over the session,
    tell.

    Args:
        edges: the tree, in order of growth.
        views: what the cameras see.
        scale: residual, in normalised coordinates, up to which a point supports a pose.
    """
    columns = np.flatnonzero(views.visible.any(0))
    rays, visible = views.rays(list(range(len(views.visible))), columns[spread(len(columns), _MAX_POINTS)])
    first = edges[0].poses
    plausible = [pose for pose in first if pose.in_front >= _PLAUSIBLE_SHARE * first[0].in_front]
    trees = [_grow(root, edges, rays, visible, scale) for root in plausible]
    _, rotations, translations = max(trees, key=lambda tree: tree[0])
    return rotations, translations


def _grow(
    root: RelativePose, edges: Sequence[Edge], rays: Array, visible: NDArray[np.bool_], scale: float
) -> tuple[float, Array, Array]:
    """Support of the tree that starts with a pose of its first edge, and the poses of all cameras."""
    cameras = len(rays)
    rotations, translations = np.tile(np.eye(3), (cameras, 1, 1)), np.zeros((cameras, 3))
    rotations[edges[0].child], translations[edges[0].child] = root.rotation, root.translation
    placed = [edges[0].parent, edges[0].child]
    support = float(root.in_front)
    for edge in edges[1:]:
        known = triangulate(
            torch.from_numpy(rotations[placed]),
            torch.from_numpy(translations[placed]),
            torch.from_numpy(rays[placed]),
            torch.from_numpy(visible[placed]).double(),
            scale=scale,
        ).numpy()
        candidates = [_attach(pose, edge, rotations, translations, known, rays, visible, scale) for pose in edge.poses]
        gained, rotations[edge.child], translations[edge.child] = max(candidates, key=lambda c: c[0])
        support += gained
        placed.append(edge.child)
    return support, rotations, translations


def _attach(
    pose: RelativePose,
    edge: Edge,
    rotations: Array,
    translations: Array,
    known: Array,
    rays: Array,
    visible: NDArray[np.bool_],
    scale: float,
) -> tuple[float, Array, Array]:
    """Support and pose of a camera placed from its parent, the baseline measured on points known already."""
    parent, child = edge.parent, edge.child
    common = np.flatnonzero(visible[parent] & visible[child] & np.isfinite(known[0]))
    depth_known = rotations[parent, 2] @ known[:, common] + translations[parent, 2]
    depth_pair, _ = two_view_depths(pose.rotation, pose.translation, rays[parent][:, common], rays[child][:, common])
    usable = (depth_pair > 0) & (depth_known > 0)
    baseline = float(np.median(depth_known[usable] / depth_pair[usable])) if usable.any() else 1.0
    rotation = pose.rotation @ rotations[parent]
    translation = pose.rotation @ translations[parent] + baseline * pose.translation
    seen = np.flatnonzero(visible[child] & np.isfinite(known[0]))
    x, y, z = rotation @ known[:, seen] + translation[:, None]
    z_safe = np.where(np.abs(z) < 1e-9, 1e-9, z)
    squared = (x / z_safe - rays[child, 0, seen]) ** 2 + (y / z_safe - rays[child, 1, seen]) ** 2
    return float(((z > 0) / (1 + squared / scale**2)).sum()), rotation, translation


def _disconnected(common: dict[tuple[int, int], int], placed: set[int], labels: Sequence[str], min_common: int) -> RigError:
    cut_off = [label for index, label in enumerate(labels) if index not in placed]
    counts = ", ".join(f"{labels[i]} and {labels[j]} share {count}" for (i, j), count in common.items())
    return RigError(
        "cameras see too little in common to be placed in one rig",
        where="keypoints",
        got=f"{', '.join(cut_off)} cut off; {counts}",
        expected=f"at least {min_common} common points that fit one pose, between some pair",
        remedy="Use a longer session in which the athlete crosses the views of these cameras, or leave them out.",
    )
