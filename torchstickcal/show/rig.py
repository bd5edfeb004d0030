"""Figures of a calibrated rig: cameras, athlete and stick."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import cast

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from mpl_toolkits.mplot3d import Axes3D
from mpl_toolkits.mplot3d.art3d import Line3DCollection
from numpy.typing import NDArray

from torchstickcal.result import Calibration
from torchstickcal.show.look import COLOURS, camera_colour
from torchstickcal.show.skeleton import bones_of
from torchstickcal.show.space import frusta, plot_rotation, without_extremes
from torchstickcal.show.tables import printable

_MAX_STICK_FRAMES = 60
_VIEW_DEG = 22.0, -62.0
"""Elevation and azimuth from which the scene is seen."""
_HALO = [withStroke(linewidth=2.5, foreground="white")]
"""Around names, so that they can be read in front of lines."""
_STICK, _BODY = COLOURS["stick"].light, COLOURS["body"].light


def rig_figure(calibration: Calibration, frame: int | None = None) -> Figure:
    """A 3D figure with the cameras as pyramids, the athlete in one frame, and the sticks in frames of the whole session.

    Args:
        calibration: the calibration to draw.
        frame: the frame in which the athlete is drawn; None for the frame with the most known points.
    """
    if frame is None:
        frame = int(calibration.points.isfinite().all(-1).sum(1).argmax())
    points = calibration.points.detach().double().cpu().numpy()
    corners = frusta(calibration).cpu().numpy()
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
    _look_from_above(axes, plot_rotation(calibration).numpy())
    return figure


def _look_from_above(axes: Axes3D, rotation: NDArray[np.float64]) -> None:
    """Turn the view so that up in the scene is up in the figure, whatever the axes of the calibration.

    Args:
        axes: to be turned.
        rotation: (3, 3), rows right, forward and up of the scene.
    """
    elevation, azimuth = np.radians(_VIEW_DEG)
    level = np.cos(elevation)
    eye = np.array([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)]) @ rotation
    upright = rotation[2] - eye * (eye @ rotation[2])
    own = np.array([0.0, 0.0, 1.0]) - eye * eye[2]  # what matplotlib shows as up without a roll
    roll = np.arctan2(eye @ np.cross(upright, own), upright @ own)
    axes.view_init(float(np.degrees(np.arcsin(eye[2]))), float(np.degrees(np.arctan2(eye[1], eye[0]))), float(np.degrees(roll)))


def _draw_cameras(axes: Axes3D, names: Sequence[str], corners: NDArray[np.float64]) -> None:
    for number, (name, (apex, *base)) in enumerate(zip(names, corners, strict=True)):
        edges = [*((apex, corner) for corner in base), *itertools.pairwise([*base, base[0]])]
        colour = camera_colour(number).light
        axes.add_collection3d(Line3DCollection(np.array(edges), colors=colour, linewidths=1.2))
        axes.text(
            apex[0], apex[1], apex[2], f" {printable(name)}", color=colour, fontsize=8, parse_math=False, path_effects=_HALO
        )


def _draw_sticks(axes: Axes3D, calibration: Calibration, points: NDArray[np.float64], frame: int) -> None:
    step = max(1, len(points) // _MAX_STICK_FRAMES)
    for stick in calibration.sticks:
        ends = points[::step, list(stick.ends)]
        known = ends[np.isfinite(ends).all((1, 2))]
        if len(known):
            axes.add_collection3d(Line3DCollection(known, colors=_STICK, alpha=0.15, linewidths=0.8))
        axes.plot(*points[frame, list(stick.ends)].T, color=_STICK, linewidth=2.5)


def _draw_athlete(axes: Axes3D, calibration: Calibration, points: NDArray[np.float64]) -> None:
    """Draw the points (P, 3) of one frame, and the bones between those with known names."""
    bones = points[np.array(bones_of(calibration.point_names), dtype=int).reshape(-1, 2)]
    known = bones[np.isfinite(bones).all((1, 2))]
    if len(known):
        axes.add_collection3d(Line3DCollection(known, colors=_BODY, linewidths=1.8))
    axes.scatter(*points.T, color=_BODY, s=8, depthshade=False)


def _equal_axes(axes: Axes3D, points: NDArray[np.float64]) -> None:
    """Set the limits of the axes to the points, with the same scale on all axes."""
    low, high = points.min(0), points.max(0)
    margin = 0.03 * (high - low).max()
    low, high = low - margin, high + margin
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    axes.set_zlim(low[2], high[2])
    axes.set_box_aspect(tuple(high - low), zoom=1.3)  # pyright: ignore[reportArgumentType]
