"""Clocks and shutters of the cameras: time offsets between cameras, and rolling shutters."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from torchstickcal.simulate.athlete import Motion
from torchstickcal.simulate.rigs import CameraRig

Array = NDArray[np.float64]

_ITERATIONS = 40
_TOLERANCE_ROWS = 1e-10


@dataclass(frozen=True)
class Clocks:
    """Time offsets between the cameras and read-out time of their rolling shutters.

    Row v of an image of height h is exposed at ``frame time + time offset + readout_s * v / h``. The time offset of camera 0
    is 0: its frame times are the common clock.

    Args:
        offset_s: largest time offset, seconds; the offset of each other camera is drawn uniformly from
            ``-offset_s`` to ``offset_s``.
        readout_s: read-out time of every camera, from the first to the last row, seconds; 0 is a global shutter.

    Example:
        >>> Clocks(offset_s=0.1).offsets(3, np.random.default_rng(0)).round(3)
        array([ 0.   , -0.046, -0.092])
    """

    offset_s: float = 0.0
    readout_s: float = 0.0

    def offsets(self, cameras: int, rng: np.random.Generator) -> Array:
        """Draw the time offsets of the cameras.

        Args:
            cameras: their number C.
            rng: random generator.

        Returns:
            (C,), seconds; 0 for camera 0.
        """
        drawn = rng.uniform(-self.offset_s, self.offset_s, cameras)
        return np.where(np.arange(cameras) > 0, drawn, 0.0)


def exposed_points(motion: Motion, rig: CameraRig, times: Array, readout_s: float) -> Array:
    """Positions of the points when each camera exposed them, (C, F, P, 3), metres.

    With a rolling shutter the time of exposure depends on the image row of the point, and the image row on the time. The row
    that satisfies both is found with the secant method, for all points at once.

    Args:
        motion: of the athlete and the stick.
        rig: the cameras.
        times: at which each camera exposes the first row of its frames, (C, F), seconds.
        readout_s: read-out time, seconds.
    """
    different, own = np.unique(times, axis=0, return_inverse=True)  # most often all cameras have the same
    points = np.stack([motion.points(camera) for camera in different])[own.ravel()]
    if readout_s == 0:
        return points
    height = rig.image_size[1]
    cameras, frames, count = points.shape[:3]
    camera, frame, point = (index.ravel() for index in np.indices((cameras, frames, count)))

    def image_rows(active: NDArray[np.intp], rows: Array) -> tuple[Array, Array]:
        delay = readout_s * np.clip(rows, 0, height) / height
        exposed = motion.points(times[camera[active], frame[active]] + delay)[np.arange(len(active)), point[active]]
        return exposed, rig.rows(exposed, camera[active])

    active = np.arange(points[..., 0].size)
    flat = points.reshape(-1, 3)
    previous_rows = np.zeros(len(active))
    rows = rig.rows(flat, camera)
    previous_error = rows - previous_rows
    for _ in range(_ITERATIONS):
        flat[active], projected = image_rows(active, rows)
        error = projected - rows
        change = error - previous_error
        step = np.where(np.abs(change) > 1e-12, -error * (rows - previous_rows) / np.where(change == 0, 1, change), error)
        unsolved = (np.abs(error) > _TOLERANCE_ROWS) & (np.abs(rows) < 10 * height)
        if not unsolved.any():
            break
        active, previous_rows, previous_error = active[unsolved], rows[unsolved], error[unsolved]
        rows = (rows + step)[unsolved]
    return flat.reshape(points.shape)
