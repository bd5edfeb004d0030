"""Undistorted keypoints of samples of the points, for the initialisation."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchstickcal.lazy import cached_property
from torchstickcal.model.measurements import Measurements
from torchstickcal.model.unknowns import Columns

Array = NDArray[np.float64]

_MAX_CACHED_KEYPOINTS = 500_000
"""Number of keypoints of a session up to which all are undistorted at once. In longer sessions each sample is undistorted when
it is requested."""
_NEIGHBOURS = 2
"""Frames before and after in which a keypoint's neighbours in time are looked for."""
_STEADY_RATIO = 4.0
"""Distance to the nearest neighbour in time, relative to the lower quartile of its camera, up to which a keypoint is steady."""


class Views:
    """The keypoints of a session in normalised image coordinates, without a second copy of a long session.

    Args:
        measurements: one session.
    """

    def __init__(self, measurements: Measurements) -> None:
        self._measurements = measurements
        self.visible: NDArray[np.bool_] = measurements.visible[0].cpu().numpy()
        """(C, N)"""
        self.focal_px: Array = measurements.cameras.focal_px[0].cpu().numpy()
        """(C,)"""
        every = slice(None)
        self.undistorted = undistorted_keypoints(measurements, every) if self.visible.size <= _MAX_CACHED_KEYPOINTS else None
        """(C, 2, N), normalised image coordinates; None of a long session"""
        self._cache = None if self.undistorted is None else self.undistorted.cpu().numpy()

    def common(self) -> NDArray[np.int_]:
        """Number of common points of each pair of cameras, (C, C)."""
        count = len(self.visible)
        return np.array([[np.count_nonzero(self.visible[i] & self.visible[j]) for j in range(count)] for i in range(count)])

    @cached_property
    def steady(self) -> NDArray[np.bool_]:
        """Keypoints (C, N) near those of the same point in the same camera one or two frames before or after.

        Of wrong keypoints only those are that are wrong in the same way for several frames. Keypoints at exactly the same place
        as before are not: so are marks of what is missing, and detectors that have stopped.
        """
        m = self._measurements
        pixels = m.by_frame(m.pixels[0].double()).where(m.by_frame(m.visible[0])[:, None], torch.nan).cpu().numpy()
        nearest = np.full_like(pixels[:, 0], np.inf)
        for step in range(1, _NEIGHBOURS + 1):
            apart = np.hypot(*np.moveaxis(pixels[:, :, step:] - pixels[:, :, :-step], 1, 0))
            apart[apart == 0] = np.inf
            for own in (nearest[:, step:], nearest[:, :-step]):
                np.fmin(own, apart, out=own)
        nearest = nearest.reshape(len(nearest), -1)
        quartile = [np.quantile(of[np.isfinite(of)], 0.25) if np.isfinite(of).any() else 0.0 for of in nearest]
        return nearest <= _STEADY_RATIO * np.array(quartile)[:, None]

    def rays(self, cameras: list[int], columns: NDArray[np.intp]) -> tuple[Array, NDArray[np.bool_]]:
        """Normalised image coordinates (c, 2, n) of n columns in c cameras, and which of them are seen (c, n).

        Keypoints that the distortion model cannot produce count as not seen.
        """
        if self._cache is None:
            rays = undistorted_keypoints(self._measurements, torch.from_numpy(columns), cameras).cpu().numpy()
        else:
            rays = self._cache[cameras][:, :, columns]
        return np.nan_to_num(rays), self.visible[cameras][:, columns] & np.isfinite(rays).all(1)


def undistorted_keypoints(measurements: Measurements, columns: Columns, cameras: list[int] | slice = slice(None)) -> Tensor:
    """Normalised image coordinates (c, 2, n) of the keypoints of some columns of one session, by default in all cameras."""
    pixels = measurements.pixels[0][cameras][:, :, columns].double().movedim(1, -1)
    return measurements.cameras[0][cameras].undistort(pixels).movedim(-1, 1)


def spread(count: int, limit: int) -> NDArray[np.intp]:
    """At most ``limit`` evenly spaced indices below ``count``."""
    return np.linspace(0, count - 1, min(limit, count)).astype(np.intp)
