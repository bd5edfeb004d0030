"""Pictures of a calibrated rig: cameras, athlete and stick."""

from __future__ import annotations

import itertools
from typing import cast

import numpy as np
import torch
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d import Axes3D
from numpy.typing import NDArray
from torch import Tensor

from torchstickcal.geometry import se3
from torchstickcal.result import Calibration

_BONES = (
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
_FRUSTUM_DEPTH_SHARE = 0.09
_GHOST_FRAMES = 60
_CAMERA_COLOUR, _STICK_COLOUR, _BODY_COLOUR = "#1f5fa8", "#d1495b", "#33383d"


def rig_figure(calibration: Calibration, frame: int | None = None) -> Figure:
    """Cameras as pyramids, the athlete in one frame and the sticks' sweep through the session, upright.

    Args:
        calibration: what to draw.
        frame: the frame in which the athlete is drawn; None for the one in which most points are known.
    """
    if frame is None:
        frame = int(calibration.points.isfinite().all(-1).sum(1).argmax())
    to_plot = _upright(calibration)
    points = _plotted(calibration.points, to_plot)
    corners = _plotted(_frusta(calibration), to_plot)
    figure = Figure(figsize=(9, 6), layout="tight")
    axes = cast(Axes3D, figure.add_subplot(projection="3d"))
    for name, (apex, *base) in zip(calibration.camera_names, corners, strict=True):
        for first, second in [*((apex, corner) for corner in base), *itertools.pairwise([*base, base[0]])]:
            axes.plot(*np.stack([first, second]).T, color=_CAMERA_COLOUR, linewidth=1.2)
        axes.text(apex[0], apex[1], apex[2], f" {name}", color=_CAMERA_COLOUR, fontsize=8)
    step = max(1, len(points) // _GHOST_FRAMES)
    for stick in calibration.sticks:
        for ends in points[::step, list(stick.ends)]:
            axes.plot(*ends.T, color=_STICK_COLOUR, alpha=0.15, linewidth=0.8)
        axes.plot(*points[frame, list(stick.ends)].T, color=_STICK_COLOUR, linewidth=2.5)
    index = {name: number for number, name in enumerate(calibration.point_names or ())}
    for first, second in _BONES:
        if first in index and second in index:
            axes.plot(*points[frame, [index[first], index[second]]].T, color=_BODY_COLOUR, linewidth=1.8)
    axes.scatter(*points[frame].T, color=_BODY_COLOUR, s=8, depthshade=False)
    _equal_axes(axes, np.concatenate([corners.reshape(-1, 3), _central(points.reshape(-1, 3))]))
    axes.set_xlabel("x (m)")
    axes.set_ylabel("y (m)")
    axes.set_zlabel("z (m)")
    axes.set_title(f"{len(calibration.camera_names)} cameras, {len(points)} frames, frame {frame}")
    axes.view_init(elev=22, azim=-62)
    return figure


def _upright(calibration: Calibration) -> Tensor:
    """Rotation of the world that turns the cameras' mean upward direction to +z."""
    up = torch.nn.functional.normalize(-calibration.rotations.double().cpu()[:, 1].mean(0), dim=0)
    forward = calibration.rotations.double().cpu()[0, 2]
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, up), dim=0)
    return torch.stack([right, torch.linalg.cross(up, right), up])


def _plotted(points: Tensor, to_plot: Tensor) -> NDArray[np.float64]:
    return (points.detach().double().cpu() @ to_plot.mT).numpy()


def _frusta(calibration: Calibration) -> Tensor:
    """Apex and four image corners (C, 5, 3) of every camera, in the world."""
    matrix = calibration.intrinsics.double()
    size = 2 * matrix[:, :2, 2] if calibration.image_size is None else calibration.image_size.double()
    centres = calibration.camera_centres.double()
    depth = _FRUSTUM_DEPTH_SHARE * float(torch.cdist(centres, centres).max())
    unit = matrix.new_tensor([[0, 0], [1, 0], [1, 1], [0, 1]])
    corners = torch.cat([unit * size[:, None], torch.ones_like(unit[:, :1]).expand(len(size), 4, 1)], dim=-1)
    rays = depth * corners @ torch.linalg.inv(matrix).mT
    in_camera = torch.cat([torch.zeros_like(rays[:, :1]), rays], dim=1)
    rotations, translations = calibration.rotations.double(), calibration.translations.double()
    inverse_translations = se3.camera_centres(rotations, translations)
    return in_camera @ rotations + inverse_translations[:, None]


def _central(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """The points without NaN and without the outermost percents, where stray reconstructions lie."""
    known = points[np.isfinite(points).all(1)]
    low, high = np.percentile(known, [2, 98], axis=0)
    return known[((known >= low) & (known <= high)).all(1)]


def _equal_axes(axes: Axes3D, points: NDArray[np.float64]) -> None:
    low, high = points.min(0), points.max(0)
    margin = 0.03 * (high - low).max()
    low, high = low - margin, high + margin
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    axes.set_zlim(low[2], high[2])
    axes.set_box_aspect(tuple(high - low), zoom=1.3)  # pyright: ignore[reportArgumentType]
