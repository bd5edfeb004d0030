"""When each camera looks: clocks that differ, and shutters that read one row after another."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from torchstickcal.simulate.motions import Motion
from torchstickcal.simulate.rigs import CameraRig

Array = NDArray[np.float64]

_ITERATIONS = 40
_TOLERANCE_ROWS = 1e-10


@dataclass(frozen=True)
class Clocks:
    """How far the cameras' clocks and shutters are from perfect.

    Row v of an image of height h is exposed at ``frame time + time offset + readout_s * v / h``. Camera 0's offset is 0:
    its frame times are the common clock.

    Args:
        offset_s: largest offset of the other cameras, which are drawn uniformly up to it, late or early.
        readout_s: time from the first row to the last, of every camera.
    """

    offset_s: float = 0.0
    readout_s: float = 0.0

    def offsets(self, cameras: int, rng: np.random.Generator) -> Array:
        """Time offsets (C,), seconds."""
        drawn = rng.uniform(-self.offset_s, self.offset_s, cameras)
        return np.where(np.arange(cameras) > 0, drawn, 0.0)


def exposed_points(motion: Motion, rig: CameraRig, times: Array, readout_s: float) -> Array:
    """Where each camera finds the points (C, F, P, 3) in frames that begin at times (C, F), seconds.

    With a rolling shutter the row in which a point appears says when it was exposed, and that where it was: the row at
    which both agree is found by the secant method, for all points at once.
    """
    points = np.stack([motion.points(camera) for camera in times])
    if readout_s == 0:
        return points
    height = rig.image_size[1]
    cameras, frames, count = points.shape[:3]
    camera, frame, point = (index.ravel() for index in np.indices((cameras, frames, count)))

    def image_rows(active: NDArray[np.intp], rows: Array) -> tuple[Array, Array]:
        delay = readout_s * np.clip(rows, 0, height) / height
        found = motion.points(times[camera[active], frame[active]] + delay)[np.arange(len(active)), point[active]]
        return found, rig.rows(found, camera[active])

    active = np.arange(points[..., 0].size)
    flat = points.reshape(-1, 3)
    before = np.zeros(len(active))
    rows = rig.rows(flat, camera)
    error_before = rows - before
    for _ in range(_ITERATIONS):
        flat[active], seen = image_rows(active, rows)
        error = seen - rows
        change = error - error_before
        step = np.where(np.abs(change) > 1e-12, -error * (rows - before) / np.where(change == 0, 1, change), error)
        going = (np.abs(error) > _TOLERANCE_ROWS) & (np.abs(rows) < 10 * height)
        if not going.any():
            break
        active, before, error_before, rows = active[going], rows[going], error[going], (rows + step)[going]
    return flat.reshape(points.shape)
