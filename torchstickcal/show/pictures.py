"""Figures of residuals, and pictures with keypoints and reprojections drawn into them."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from torch import Tensor

from torchstickcal.result import Calibration
from torchstickcal.show.look import COLOURS, camera_colour
from torchstickcal.show.tables import printable

_USED, _ASIDE, _REPROJECTION = (COLOURS[name].light for name in ("used", "aside", "reprojection"))
_MOST_POINTS = 1000
_MOST_COLUMNS = 5
_LEAST_LIMIT_PX = 0.01
_MARGIN = 0.25
"""Of a picture around the athlete, as a fraction of its larger side."""
_SPREAD = 0.99
"""Share of the residuals that the axes show."""


def residuals_figure(calibration: Calibration) -> Figure:
    """The residuals of each camera along x and y, and their size over the frames."""
    residuals, inliers = calibration.residuals_px.detach().double().cpu(), calibration.inliers.cpu()
    names = [printable(name) for name in calibration.camera_names]
    rows, columns = _grid(len(names))
    height = 2.6 * (rows + 1)
    figure = Figure(figsize=(2.7 * columns + 0.4, height))
    grid = figure.add_gridspec(
        rows + 1, columns, left=0.08, right=0.98, bottom=0.5 / height, top=1 - 0.35 / height, hspace=0.45, wspace=0.3
    )
    limit = _limit(residuals[inliers])
    for camera, name in enumerate(names):
        axes = figure.add_subplot(grid[camera // columns, camera % columns])
        for chosen, colour, label in ((~inliers, _ASIDE, "set aside"), (inliers, _USED, "used")):
            found = residuals[camera][chosen[camera] & residuals[camera].isfinite().all(-1)]
            x, y = found[:: 1 + len(found) // _MOST_POINTS].unbind(1)
            axes.plot(x.numpy(), y.numpy(), ".", markersize=3, alpha=0.4, color=colour, markeredgewidth=0, label=label)
        axes.set(xlim=(-limit, limit), ylim=(limit, -limit), aspect="equal")
        unused = int((~inliers & residuals.isfinite().all(-1))[camera].sum())
        axes.set_title(f"{name}: {int(inliers[camera].sum())} used, {unused} set aside", fontsize=8)
        axes.tick_params(labelsize=7)
        axes.locator_params(nbins=5)
        axes.set_xlabel("x (px)" if camera >= len(names) - columns else "", fontsize=8)
        axes.set_ylabel("y (px)" if camera % columns == 0 else "", fontsize=8)
        if camera == 0:
            axes.legend(loc="upper right", fontsize=7, markerscale=3)
    over_time = figure.add_subplot(grid[rows, :])
    sizes = residuals.norm(dim=-1).where(inliers, torch.nan).nanmedian(dim=2).values
    for number, (name, size) in enumerate(zip(names, sizes.numpy(), strict=True)):
        over_time.plot(size, linewidth=0.9, label=name, color=camera_colour(number).light)
    over_time.set_ylim(0, 1.35 * float(sizes.nan_to_num().max()) or 1.0)
    over_time.set_xlabel("frame", fontsize=8)
    over_time.set_ylabel("residual (px)", fontsize=8)
    over_time.set_title("median size of the residuals over the points of a frame", fontsize=9)
    over_time.tick_params(labelsize=7)
    over_time.legend(fontsize=7, ncols=math.ceil(len(names) / 4), loc="upper right")
    return figure


def _grid(cameras: int) -> tuple[int, int]:
    """Rows and columns for a picture of each camera."""
    rows = math.ceil(cameras / _MOST_COLUMNS)
    return rows, math.ceil(cameras / rows)


def _limit(used: Tensor) -> float:
    """Up to where residuals (n, 2) are shown."""
    sizes = used.abs().flatten()
    if not len(sizes):
        return 1.0
    return 1.1 * max(_LEAST_LIMIT_PX, float(sizes.kthvalue(max(1, round(_SPREAD * len(sizes)))).values))


def keypoints_figure(
    keypoints: Tensor,
    reprojections: Tensor,
    inliers: Tensor,
    names: Sequence[str],
    images: Tensor | None = None,
    title: str = "",
) -> Figure:
    """The image of each camera with its keypoints, the projections of the points, and a line between the two.

    Args:
        keypoints: (C, P, 2), pixels, NaN where not seen.
        reprojections: (C, P, 2), pixels, NaN where the point is not known.
        inliers: (C, P), True where a keypoint was used.
        names: C names of the cameras.
        images: (C, 3, H, W) or (C, 1, H, W), 0 to 1, or 0 to 255 in bytes; None for an empty background.
        title: of the whole figure.
    """
    rows, columns = _grid(len(names))
    figure = Figure(figsize=(3.2 * columns, 2.6 * rows + 0.5), layout="constrained")
    for camera, name in enumerate(names):
        axes = figure.add_subplot(rows, columns, camera + 1)
        if images is not None:
            axes.imshow(_picture(images[camera]), cmap="gray", vmin=0, vmax=1)
        _draw_keypoints(axes, keypoints[camera], reprojections[camera], inliers[camera])
        _set_limits(axes, keypoints[camera], reprojections[camera], images)
        axes.set_title(name, fontsize=9)
        axes.tick_params(labelsize=7)
    figure.supxlabel("x (px)", fontsize=8)
    figure.supylabel("y (px)", fontsize=8)
    figure.suptitle(title, fontsize=10)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower right", fontsize=8, ncols=3)
    return figure


def _draw_keypoints(axes: Axes, keypoints: Tensor, reprojections: Tensor, inliers: Tensor) -> None:
    found, used = reprojections.numpy(), inliers.numpy()
    given = keypoints.numpy()
    pairs = np.stack([given, found], axis=1)
    axes.add_collection(LineCollection(list(pairs[np.isfinite(pairs).all((1, 2))]), colors=_REPROJECTION, linewidths=0.8))
    axes.scatter(*given[used].T, s=12, color=_USED, linewidths=0, label="keypoint, used")
    axes.scatter(*given[~used].T, s=18, color=_ASIDE, marker="x", linewidths=1, label="keypoint, set aside")
    axes.scatter(*found.T, s=22, facecolors="none", edgecolors=_REPROJECTION, linewidths=0.9, label="reprojection")


def _set_limits(axes: Axes, keypoints: Tensor, reprojections: Tensor, images: Tensor | None) -> None:
    """Show the part of the image in which the athlete is."""
    axes.set_aspect("equal")
    seen = torch.cat([keypoints[keypoints.isfinite().all(-1)], reprojections[reprojections.isfinite().all(-1)]]).double()
    low, high = torch.tensor([-0.5, -0.5]).double(), torch.tensor([99.5, 99.5]).double()
    if images is not None:
        high = torch.tensor([images.shape[-1], images.shape[-2]]).double() - 0.5
    if len(seen):
        margin = 5.0 + _MARGIN * float((seen.amax(0) - seen.amin(0)).max())
        first, last = seen.amin(0) - margin, seen.amax(0) + margin
        if images is None:
            low, high = first, last
        elif bool((first < high).all() and (last > low).all()):
            low, high = torch.maximum(first, low), torch.minimum(last, high)
    axes.set(xlim=(float(low[0]), float(high[0])), ylim=(float(high[1]), float(low[1])))


def _picture(image: Tensor) -> np.ndarray:
    """An image (3, H, W) or (1, H, W) as matplotlib shows it."""
    bright = image.detach().cpu().float() / (255.0 if image.dtype == torch.uint8 else 1.0)
    picture = bright.clamp(0.0, 1.0).movedim(0, -1).numpy()
    return picture[..., 0] if picture.shape[-1] == 1 else picture
