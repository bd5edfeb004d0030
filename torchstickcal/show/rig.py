"""Figures of a calibrated rig: cameras, athlete and stick."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import cast

import numpy as np
import torch
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d import Axes3D
from mpl_toolkits.mplot3d.art3d import Line3DCollection
from numpy.typing import NDArray
from torch import Tensor

from torchstickcal.geometry import se3
from torchstickcal.result import Calibration

BONES = (
    ("pelvis", "spine"), ("spine", "neck"), ("neck", "head"), ("head", "head_top"),
    *(
        (f"{side}_{a}" if a != "neck" and a != "pelvis" else a, f"{side}_{b}")
        for side in ("left", "right")
        for a, b in (
            ("neck", "shoulder"), ("shoulder", "elbow"), ("elbow", "wrist"), ("wrist", "hand"),
            ("pelvis", "knee"), ("knee", "shin"), ("shin", "ankle"),
        )
    ),
)  # fmt: skip
"""The bones that are drawn between points with these names."""
_FRUSTUM_DEPTH = 0.09
"""Depth of the drawn camera pyramids, as a fraction of the largest distance between two cameras."""
_MAX_STICK_FRAMES = 60
_CAMERA_COLOUR, _STICK_COLOUR, _BODY_COLOUR = "#1f5fa8", "#d1495b", "#33383d"


def rig_figure(calibration: Calibration, frame: int | None = None) -> Figure:
    """A 3D figure with the cameras as pyramids, the athlete in one frame, and the sticks in frames of the whole session.

    Args:
        calibration: the calibration to draw.
        frame: the frame in which the athlete is drawn; None for the frame with the most known points.
    """
    if frame is None:
        frame = int(calibration.points.isfinite().all(-1).sum(1).argmax())
    rotation = plot_rotation(calibration)
    points = _rotated(calibration.points, rotation)
    corners = _rotated(frusta(calibration), rotation)
    figure = Figure(figsize=(9, 6), layout="tight")
    axes = cast(Axes3D, figure.add_subplot(projection="3d"))
    _draw_cameras(axes, calibration.camera_names, corners)
    _draw_sticks(axes, calibration, points, frame)
    _draw_athlete(axes, calibration, points[frame])
    _equal_axes(axes, np.concatenate([corners.reshape(-1, 3), without_extremes(points.reshape(-1, 3))]))
    axes.set_xlabel("x (m)")
    axes.set_ylabel("y (m)")
    axes.set_zlabel("z (m)")
    axes.set_title(f"{len(calibration.camera_names)} cameras, {len(points)} frames, frame {frame}")
    axes.view_init(elev=22, azim=-62)
    return figure


def _draw_cameras(axes: Axes3D, names: Sequence[str], corners: NDArray[np.float64]) -> None:
    for name, (apex, *base) in zip(names, corners, strict=True):
        edges = [*((apex, corner) for corner in base), *itertools.pairwise([*base, base[0]])]
        axes.add_collection3d(Line3DCollection(np.array(edges), colors=_CAMERA_COLOUR, linewidths=1.2))
        axes.text(apex[0], apex[1], apex[2], f" {name}", color=_CAMERA_COLOUR, fontsize=8)


def _draw_sticks(axes: Axes3D, calibration: Calibration, points: NDArray[np.float64], frame: int) -> None:
    step = max(1, len(points) // _MAX_STICK_FRAMES)
    for stick in calibration.sticks:
        ends = points[::step, list(stick.ends)]
        known = ends[np.isfinite(ends).all((1, 2))]
        if len(known):
            axes.add_collection3d(Line3DCollection(known, colors=_STICK_COLOUR, alpha=0.15, linewidths=0.8))
        axes.plot(*points[frame, list(stick.ends)].T, color=_STICK_COLOUR, linewidth=2.5)


def _draw_athlete(axes: Axes3D, calibration: Calibration, points: NDArray[np.float64]) -> None:
    """Draw the points (P, 3) of one frame, and the bones between those with known names."""
    index = {name: number for number, name in enumerate(calibration.point_names or ())}
    bones = np.array([points[[index[first], index[second]]] for first, second in BONES if first in index and second in index])
    if len(bones):
        axes.add_collection3d(Line3DCollection(bones[np.isfinite(bones).all((1, 2))], colors=_BODY_COLOUR, linewidths=1.8))
    axes.scatter(*points.T, color=_BODY_COLOUR, s=8, depthshade=False)


def plot_rotation(calibration: Calibration) -> Tensor:
    """Rotation (3, 3) from the world to the plot, where +z is up: as the world says, else the cameras' mean up direction."""
    if calibration.world.up == "z":
        return torch.eye(3, dtype=torch.float64)
    up = torch.nn.functional.normalize(-calibration.rotations.double().cpu()[:, 1].mean(0), dim=0)
    forward = calibration.rotations.double().cpu()[0, 2]
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, up), dim=0)
    return torch.stack([right, torch.linalg.cross(up, right), up])


def _rotated(points: Tensor, rotation: Tensor) -> NDArray[np.float64]:
    return (points.detach().double().cpu() @ rotation.mT).numpy()


def frusta(calibration: Calibration) -> Tensor:
    """Pyramid of each camera, (C, 5, 3): camera centre and the four image corners, in the world."""
    matrix = calibration.intrinsics.double()
    size = 2 * matrix[:, :2, 2] if calibration.image_size is None else calibration.image_size.double()
    centres = calibration.camera_centres.double()
    depth = _FRUSTUM_DEPTH * float(torch.cdist(centres, centres).max())
    unit = matrix.new_tensor([[0, 0], [1, 0], [1, 1], [0, 1]])
    corners = torch.cat([unit * size[:, None], torch.ones_like(unit[:, :1]).expand(len(size), 4, 1)], dim=-1)
    rays = depth * corners @ torch.linalg.inv(matrix).mT
    in_camera = torch.cat([torch.zeros_like(rays[:, :1]), rays], dim=1)
    rotations, translations = calibration.rotations.double(), calibration.translations.double()
    return in_camera @ rotations + se3.camera_centres(rotations, translations)[:, None]


def without_extremes(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """The points between the 2nd and 98th percentile of each coordinate. Wrongly triangulated points can be far away."""
    known = points[np.isfinite(points).all(1)]
    low, high = np.percentile(known, [2, 98], axis=0)
    return known[((known >= low) & (known <= high)).all(1)]


def _equal_axes(axes: Axes3D, points: NDArray[np.float64]) -> None:
    """Set the limits of the axes to the points, with the same scale on all axes."""
    low, high = points.min(0), points.max(0)
    margin = 0.03 * (high - low).max()
    low, high = low - margin, high + margin
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    axes.set_zlim(low[2], high[2])
    axes.set_box_aspect(tuple(high - low), zoom=1.3)  # pyright: ignore[reportArgumentType]
