"""How alike repeated swings are."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from torchstickcal.analysis.interpolation import at

Array = NDArray[np.float64]

SHARES = np.linspace(0.0, 100.0, 101)
"""Per cent of a swing, from takeaway to finish, at which swings are compared"""


def normalised(times: Array, values: Array, first_s: float, last_s: float) -> Array:
    """Curves (T, ...) between two times, at 101 equal steps of the time between them."""
    return at(times, values, first_s + SHARES / 100 * (last_s - first_s))


def multiple_correlation(curves: Array) -> float:
    """Coefficient of multiple correlation of repeated curves (G, T): 1 if they are the same, 0 if they have nothing in common.

    Within one session, after Kadaba et al. 1989, J. Orthop. Res. 7: 849-860. NaN where it is not defined: for fewer than two
    curves, for curves with gaps, and where curves differ among each other more than they change in the mean.

    Example:
        >>> curve = np.sin(np.linspace(0, 6, 101))
        >>> round(multiple_correlation(np.stack([curve, curve + 0.1, curve - 0.1])), 3)
        0.99
        >>> multiple_correlation(np.stack([curve, curve]))
        1.0
    """
    count, steps = curves.shape
    if count < 2 or not np.isfinite(curves).all():
        return float("nan")
    among = np.square(curves - curves.mean(0)).sum() / (steps * (count - 1))
    total = np.square(curves - curves.mean()).sum() / (count * steps - 1)
    share = 1 - among / total if total > 0 else -1.0
    return float(np.sqrt(share)) if share >= 0 else float("nan")
