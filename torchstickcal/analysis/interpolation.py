"""Values between frames."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def at(times: Array, values: Array, when: Array | float) -> Array:
    """Values (T, ...) at times (M,) or at one time, by the cubic polynomials through the four frames around; NaN outside."""
    asked = np.atleast_1d(np.asarray(when, dtype=np.float64))
    count = min(4, len(times))
    first = np.clip(np.searchsorted(times, np.nan_to_num(asked)) - 2, 0, len(times) - count)
    index = first[:, None] + np.arange(count)
    near = times[index]
    apart = near[:, :, None] - near[:, None, :] + np.eye(count)
    to = np.broadcast_to((asked[:, None] - near)[:, None, :], apart.shape)
    weights = np.where(np.eye(count, dtype=bool), 1.0, to / apart).prod(-1)
    weights[~((asked >= times[0]) & (asked <= times[-1]))] = np.nan
    found = (weights.reshape(*weights.shape, *[1] * (values.ndim - 1)) * values[index]).sum(1)
    return found if np.ndim(when) else found[0]
