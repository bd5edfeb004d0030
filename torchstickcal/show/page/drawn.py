"""What the page draws of a calibration, thinned where it would be too much, as plain data for the script."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchstickcal.geometry.cameras import Intrinsics
from torchstickcal.lazy import cached_property
from torchstickcal.result import Calibration
from torchstickcal.show.page.packing import packed, packed_codes, packed_floats, packed_roots, packed_shares
from torchstickcal.show.skeleton import bones_of
from torchstickcal.show.space import frusta, plot_rotation
from torchstickcal.show.tables import keypoints_seen, point_name, stick_name
from torchstickcal.solvers.uncertainty import centre_covariances, point_covariances

_POINT_BYTES, _IMAGE_BYTES = 1_000_000, 2_000_000
"""Of all points of the drawn frames, and of the keypoints and residuals of those whose images are drawn."""
_BUCKETS = 600
"""Largest number of places of a curve over time."""
_CLOUD = 600
"""Residuals of a camera that are drawn one by one."""
_CELLS = 16
"""Cells along the longer side of an image."""
_CELL_KEYPOINTS = 200_000
"""Keypoints of a camera from which the cells are filled."""
_LEAST_OF_A_CELL = 20
"""Keypoints of a cell from which on their mean residual is shown."""
_ELLIPSOID_FRAMES = 100
_SIGMAS_95 = 2.7955
"""Half the size of the ellipsoid that holds 95 % of a position in space, in standard deviations."""
_FAR = 4.0
"""How many times as large as the scene the space is in which points are drawn."""
SEEN, ASIDE, RELABELLED = 1, 2, 3
"""Codes of a keypoint that was used, set aside, or used and relabelled; 0 is not seen."""


@dataclass(frozen=True)
class Drawing:
    """What is drawn of one calibration."""

    calibration: Calibration

    @cached_property
    def frames(self) -> Tensor:
        """The common frames that are drawn in space."""
        count, points = self.calibration.points.shape[:2]
        return torch.arange(0, count, max(1, math.ceil(6 * points * count / _POINT_BYTES)))

    @cached_property
    def image_frames(self) -> Tensor:
        """Those of :attr:`frames` whose images are drawn too."""
        cameras, points = len(self.calibration.camera_names), self.calibration.points.shape[1]
        return self.frames[:: max(1, math.ceil(8 * cameras * points * len(self.frames) / _IMAGE_BYTES))]

    @cached_property
    def own_frame(self) -> Tensor:
        """(C, G), the frame of each camera that is nearest to a common frame, -1 where there is none."""
        index = self.calibration.frame_index.cpu()
        own = torch.full((len(index), len(self.calibration.points)), -1)
        cameras, frames = (index >= 0).nonzero(as_tuple=True)
        own[cameras, index[cameras, frames]] = frames
        return own

    @cached_property
    def codes(self) -> Tensor:
        """(C, F, P), what became of each keypoint."""
        c = self.calibration
        codes = c.inliers.cpu().to(torch.uint8) * SEEN
        codes[(c.inliers & c.relabelled).cpu()] = RELABELLED
        codes[(keypoints_seen(c) & ~c.inliers).cpu()] = ASIDE
        return codes

    def common(self, own: Tensor, frames: Tensor, missing: Any) -> Tensor:
        """What cameras have in their own frames (C, F, ...) at some common frames, (C, n, ...)."""
        index = self.own_frame[:, frames]
        cameras = torch.arange(len(own))[:, None].expand_as(index)
        found = own[cameras, index.clamp_min(0)]
        found[index < 0] = missing
        return found

    def projections(self, frames: Tensor, cameras: slice = slice(None)) -> Tensor:
        """Where the points of some common frames appear in all images, or those of some cameras, (C, n, P, 2), pixels."""
        c = self.calibration
        lens = None if c.distortion is None else c.distortion.double().cpu()
        own = Intrinsics(c.intrinsics.double().cpu(), lens, c.fisheye)[cameras]
        points = c.points[frames.to(c.points.device)].detach().double().cpu()
        in_camera = (
            points.flatten(0, 1) @ c.rotations[cameras].double().cpu().mT + c.translations[cameras].double().cpu()[:, None]
        )
        return own.project(in_camera).where(in_camera[..., 2:] > 0, torch.nan).unflatten(1, points.shape[:2])

    @cached_property
    def corners(self) -> Tensor:
        """(C, 5, 3), the pyramid of each camera."""
        return frusta(self.calibration).detach().cpu()

    @cached_property
    def ellipsoids(self) -> Tensor:
        """(C, 3, 3), half axes of the ellipsoids that hold 95 % of the cameras' positions."""
        c = self.calibration
        return _half_axes(centre_covariances(c.camera_centres.double(), c.covariance).cpu())

    @cached_property
    def image_sizes(self) -> list[list[float]]:
        """Width and height of each image; twice the principal point where it is not known."""
        c = self.calibration
        sizes = 2 * c.intrinsics[:, :2, 2] if c.image_size is None else c.image_size
        return sizes.double().cpu().tolist()


def drawn(calibration: Calibration) -> dict[str, Any]:
    """Everything that the script of the page draws."""
    drawing = Drawing(calibration)
    return {
        "count": len(calibration.points),
        "step": _step(drawing.frames),
        "fps": calibration.fps,
        "times": None if calibration.times is None else packed_floats(calibration.times.cpu()[drawing.frames]),
        "scene": _scene(drawing),
        "cameras": [_camera(drawing, camera) for camera in range(len(calibration.camera_names))],
        "images": _images(drawing),
        "time": _over_time(drawing),
        "visibility": _visibility(drawing),
        "stages": [
            {
                "name": stage.name,
                "cost": [_finite(record.cost) for record in stage.iterations],
                "reprojection": [[_finite(px) for px in record.reprojection_px] for record in stage.iterations],
            }
            for stage in calibration.stages
        ],
    }


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _step(frames: Tensor) -> int:
    return int(frames[1] - frames[0]) if len(frames) > 1 else 1


def _scene(drawing: Drawing) -> dict[str, Any]:
    """Points, bones and sticks in space, around the middle of the scene."""
    c, frames, axes = drawing.calibration, drawing.frames, plot_rotation(drawing.calibration)
    points = c.points.detach().double().cpu()[frames]
    corners = drawing.corners.flatten(0, 1)
    known = points[points.isfinite().all(-1)]
    scene = corners
    if len(known):
        inner = torch.quantile(known[:: 1 + len(known) // 100_000], torch.tensor([0.02, 0.98]).double(), dim=0)
        scene = torch.cat([corners, inner])
        low = float((known[:: 1 + len(known) // 100_000] @ axes[2]).quantile(0.01))
    else:
        low = float((corners @ axes[2]).min())
    middle = (scene.amax(0) + scene.amin(0)) / 2
    radius = float((scene - middle).norm(dim=1).max()) or 1.0
    around = points - middle
    far = around.norm(dim=-1) > _FAR * radius
    around[far] = torch.nan
    size, ellipsoids, ellipsoid_frames = _point_ellipsoids(drawing, frames)
    return {
        "middle": middle.tolist(),
        "radius": radius,
        "axes": axes.tolist(),
        "floor": low - float(middle @ axes[2]),
        "points": packed(around),
        "names": [point_name(c, index) for index in range(points.shape[1])],
        "bones": bones_of(c.point_names),
        "sticks": [list(stick.ends) for stick in c.sticks],
        "codes": packed_codes(drawing.common(drawing.codes, frames, 0)),
        "far": int(far.sum()),
        "ellipsoids": {"frames": ellipsoid_frames, "axes": ellipsoids, "size_m": size},
    }


def _point_ellipsoids(drawing: Drawing, frames: Tensor) -> tuple[float | None, dict[str, Any], int]:
    """Typical size, half axes and number of the points' ellipsoids, in frames evenly among those drawn."""
    c = drawing.calibration
    chosen = frames[torch.linspace(0, len(frames) - 1, min(_ELLIPSOID_FRAMES, len(frames))).round().long()]
    lens = None if c.distortion is None else c.distortion.double().cpu()
    seen = drawing.common(c.inliers.cpu(), chosen, False)
    points = c.points.detach().double().cpu()[chosen]
    covariances = point_covariances(
        points.flatten(0, 1),
        seen.flatten(1),
        c.sigma_px.double().cpu().expand(points.shape[:2]).flatten(),
        (c.rotations.double().cpu(), c.translations.double().cpu()),
        Intrinsics(c.intrinsics.double().cpu(), lens, c.fisheye),
        c.covariance.cpu(),
    )
    axes = _half_axes(covariances)
    sizes = axes.norm(dim=-1).amax(-1)
    known = sizes[sizes.isfinite()]
    if not len(known):
        return None, packed(axes), len(chosen)
    return float(known.median()), packed(axes, 20 * float(known.median())), len(chosen)


def _half_axes(covariances: Tensor) -> Tensor:
    """Half axes (..., 3, 3), one in each row, of the ellipsoids that hold 95 %; NaN where a covariance is not known."""
    known = covariances.isfinite().all(-1).all(-1)
    values, vectors = torch.linalg.eigh(covariances.where(known[..., None, None], 0.0))
    axes = _SIGMAS_95 * values.clamp_min(0).sqrt()[..., None] * vectors.mT
    return axes.where(known[..., None, None], torch.nan)


def _camera(drawing: Drawing, camera: int) -> dict[str, Any]:
    """One camera: its pyramid, its ellipsoid, and its image with coverage and residuals."""
    axes = drawing.ellipsoids[camera]
    width, height = drawing.image_sizes[camera]
    return {
        "name": drawing.calibration.camera_names[camera],
        "corners": drawing.corners[camera].tolist(),
        "ellipsoid": axes.tolist() if bool(axes.isfinite().all()) and bool((axes != 0).any()) else None,
        "width": width,
        "height": height,
        **_image_statistics(drawing, camera, width, height),
    }


def _image_statistics(drawing: Drawing, camera: int, width: float, height: float) -> dict[str, Any]:
    """Where in the image keypoints were used, the mean residual there, and some residuals one by one."""
    c = drawing.calibration
    index = c.frame_index[camera].cpu()
    own = (index >= 0).nonzero()[:, 0]
    own = own[:: 1 + len(own) * c.points.shape[1] // _CELL_KEYPOINTS]
    residuals = c.residuals_px[camera].detach().double().cpu()[own].numpy()
    used = c.inliers[camera].cpu()[own].numpy()
    places = drawing.projections(index[own], slice(camera, camera + 1))[0].numpy() - residuals
    found = used & np.isfinite(places).all(-1)
    places, sizes = places[found], residuals[found]
    columns = _CELLS if width >= height else max(1, round(_CELLS * width / height))
    rows = _CELLS if height > width else max(1, round(_CELLS * height / width))
    x, y = (places / (width, height) * (columns, rows)).clip(0, (columns - 1, rows - 1)).astype(np.int64).T
    cell, cells = y * columns + x, rows * columns
    counts = np.bincount(cell, minlength=cells)
    sums = np.stack([np.bincount(cell, axis, cells) for axis in sizes.T], axis=1)
    means = np.where(counts >= _LEAST_OF_A_CELL, sums.T / counts.clip(1), np.nan).T
    aside = residuals[~used & np.isfinite(residuals).all(-1)]
    return {
        "columns": columns,
        "rows": rows,
        "density": packed_shares(torch.from_numpy(counts / counts.max(initial=1)).sqrt()),
        "covered": float((counts > 0).mean()),
        "means": packed(torch.from_numpy(means)),
        "cloud": packed_roots(_thinned(sizes)),
        "aside": packed_roots(_thinned(aside)),
        "limit": _limit(sizes),
    }


def _thinned(values: NDArray[np.float64]) -> Tensor:
    return torch.from_numpy(values[:: 1 + len(values) // _CLOUD])


def _limit(residuals: NDArray[np.float64]) -> float:
    """Up to where residuals are shown."""
    sizes = np.abs(residuals).ravel()
    rank = max(1, round(0.99 * len(sizes))) - 1
    return 1.1 * max(0.01, float(np.partition(sizes, rank)[rank])) if len(sizes) else 1.0


def _images(drawing: Drawing) -> dict[str, Any]:
    """Keypoints and residuals of the frames whose images are drawn."""
    frames = drawing.image_frames
    residuals = drawing.common(drawing.calibration.residuals_px.detach().double().cpu(), frames, torch.nan)
    keypoints = drawing.projections(frames) - residuals
    largest = 2 * max(max(size) for size in drawing.image_sizes)
    return {
        "every": _step(frames) // _step(drawing.frames),
        "count": len(frames),
        "keypoints": packed(keypoints, largest),
        "residuals": packed_roots(residuals),
    }


def _over_time(drawing: Drawing) -> dict[str, Any]:
    """Curves over the session: residuals and used keypoints of each camera, and the lengths of the sticks."""
    c = drawing.calibration
    every = torch.arange(len(c.points))
    sizes = c.residuals_px.detach().cpu().norm(dim=-1).where(c.inliers.cpu(), torch.nan)
    medians = drawing.common(sizes.nanmedian(-1).values.double(), every, torch.nan)
    seen = drawing.common((drawing.codes > 0).sum(-1).double(), every, 0.0)
    used = drawing.common(c.inliers.cpu().sum(-1).double(), every, 0.0)
    return {
        "size": _bucket_size(len(every)),
        "residual": packed(_bucketed(medians).nanmedian(-1).values),
        "used": packed_shares(_bucketed(used).nansum(-1) / _bucketed(seen).nansum(-1)),
        "sticks": [_lengths(drawing, number) for number in range(len(c.sticks))],
    }


def _lengths(drawing: Drawing, number: int) -> dict[str, Any]:
    """One stick's reconstructed lengths minus the given one, metres: least, median and largest of each place of the curve."""
    c = drawing.calibration
    stick = c.sticks[number]
    errors = c.stick_lengths_m[:, number].detach().double().cpu() - stick.between_m
    parts = _bucketed(errors)
    known = parts.isfinite()
    missing = ~errors.isfinite()
    return {
        "name": stick_name(c, number),
        "given_m": stick.between_m,
        "sigma_m": stick.sigma_m,
        "median": packed(parts.nanmedian(-1).values),
        "least": packed(parts.where(known, torch.inf).amin(-1)),
        "largest": packed(parts.where(known, -torch.inf).amax(-1)),
        "missing": packed_shares(_bucketed(missing.double()).nanmean(-1)),
        "left_out": int(missing.sum()),
    }


def _visibility(drawing: Drawing) -> dict[str, Any]:
    """How many cameras used each point over time, and how much of each point each camera used."""
    c = drawing.calibration
    cameras, frames = c.inliers.shape[:2]
    used = c.inliers.cpu()
    every = torch.arange(len(c.points))
    counts = torch.zeros(c.points.shape[:2])
    for camera in range(cameras):
        own = drawing.own_frame[camera, every]
        counts += (used[camera][own.clamp_min(0)] & (own >= 0)[:, None]).float()
    return {
        "cameras": packed_shares(_bucketed((counts / cameras).mT).nanmean(-1)),
        "used": packed_shares(used.double().mean(1)) if frames else "",
    }


def _bucket_size(count: int) -> int:
    return max(1, math.ceil(count / _BUCKETS))


def _bucketed(values: Tensor) -> Tensor:
    """Values over time (..., G) in groups that follow each other, (..., buckets, size); NaN fills the last one."""
    size = _bucket_size(values.shape[-1])
    padded = torch.nn.functional.pad(values, (0, -values.shape[-1] % size), value=torch.nan)
    return padded.unflatten(-1, (-1, size))
