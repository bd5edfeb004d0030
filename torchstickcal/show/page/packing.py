"""Arrays as short texts for the page's script: base64 of small integers."""

from __future__ import annotations

import base64
from typing import Any

import numpy as np
from torch import Tensor

UNKNOWN = -32768
"""Stands for NaN in packed numbers."""
_LARGEST = 32000


def packed(values: Tensor, largest: float | None = None) -> dict[str, Any]:
    """Numbers as 16-bit integers with a common factor, NaN as :data:`UNKNOWN`.

    Args:
        values: of any shape.
        largest: numbers beyond this count as not known; None for none.

    Returns:
        ``factor`` and ``int16``, the base64 of the integers in little-endian order.

    Example:
        >>> import torch
        >>> packed(torch.tensor([1.0, float("nan")]))
        {'factor': 3.125e-05, 'int16': 'AH0AgA=='}
    """
    numbers = values.detach().double().cpu().numpy()
    known = np.isfinite(numbers) if largest is None else np.abs(numbers) <= largest
    most = float(np.abs(numbers[known]).max(initial=0.0))
    factor = (most or 1.0) / _LARGEST
    integers = np.where(known, np.rint(numbers / factor), UNKNOWN).astype("<i2")
    return {"factor": factor, "int16": _base64(integers)}


def packed_roots(values: Tensor) -> dict[str, Any]:
    """Numbers as in :func:`packed`, by the root of their size: small ones keep their digits beside large ones."""
    return packed(values.detach().double().abs().sqrt().copysign(values.double()))


def packed_floats(values: Tensor) -> str:
    """Numbers in single precision."""
    return _base64(values.detach().cpu().numpy().astype("<f4"))


def packed_shares(values: Tensor) -> str:
    """Numbers from 0 to 1 as bytes, 255 for NaN."""
    return _base64((250 * values.double()).round().nan_to_num(255.0).cpu().numpy().astype(np.uint8))


def packed_codes(values: Tensor) -> str:
    """Numbers from 0 to 3, four in a byte, the first in the lowest bits.

    Example:
        >>> import torch
        >>> packed_codes(torch.tensor([1, 2, 3]))
        'OQ=='
    """
    flat = values.flatten().cpu().numpy().astype(np.uint8)
    four = np.pad(flat, (0, -len(flat) % 4)).reshape(-1, 4)
    return _base64((four << np.array([0, 2, 4, 6], dtype=np.uint8)).sum(1, dtype=np.uint8))


def _base64(array: np.ndarray) -> str:
    return base64.b64encode(array.tobytes()).decode("ascii")
