"""What each camera sees, as the initialisation looks at it: a sample of the points at a time, undistorted."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from torchstickcal.model.measurements import Measurements

Array = NDArray[np.float64]

_UNDISTORTED_AT_ONCE = 500_000
"""Keypoints of a session up to which all are undistorted once, instead of each sample when it is looked at."""


class Views:
    """Access to the keypoints of a session without holding them twice.

    Args:
        measurements: one session.
    """

    def __init__(self, measurements: Measurements) -> None:
        self._measurements = measurements
        self.visible: NDArray[np.bool_] = measurements.visible[0].cpu().numpy()
        """(C, N)"""
        self.focal_px: Array = measurements.cameras.focal_px[0].cpu().numpy()
        """(C,)"""
        self._whole = self._undistorted(slice(None), slice(None)) if self.visible.size <= _UNDISTORTED_AT_ONCE else None

    def common(self) -> NDArray[np.int_]:
        """The number of points two cameras have in common, (C, C)."""
        count = len(self.visible)
        return np.array([[np.count_nonzero(self.visible[i] & self.visible[j]) for j in range(count)] for i in range(count)])

    def rays(self, cameras: list[int], columns: NDArray[np.intp]) -> tuple[Array, NDArray[np.bool_]]:
        """Normalised coordinates (c, 2, n) of some points in some cameras, and which of them are seen (c, n).

        A keypoint beyond the fold of its lens counts as not seen.
        """
        whole = self._whole
        rays = self._undistorted(cameras, columns) if whole is None else whole[cameras][:, :, columns]
        return np.nan_to_num(rays), self.visible[cameras][:, columns] & np.isfinite(rays).all(1)

    def _undistorted(self, cameras: list[int] | slice, columns: NDArray[np.intp] | slice) -> Array:
        m = self._measurements
        pixels = m.pixels[0][cameras][:, :, columns].double().movedim(1, -1)
        return m.cameras[0][cameras].undistort(pixels).movedim(-1, 1).cpu().numpy()


def spread(count: int, limit: int) -> NDArray[np.intp]:
    """At most ``limit`` of the indices below ``count``, evenly spread."""
    return np.linspace(0, count - 1, min(limit, count)).astype(np.intp)
