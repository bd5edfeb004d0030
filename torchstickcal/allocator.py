"""The memory allocator of the C library, where it is glibc's. Elsewhere, nothing here has an effect."""

from __future__ import annotations

import ctypes
import sys
from functools import lru_cache
from typing import Any

import torch

_LARGE_BLOCK_BYTES = 31 * 2**20


def keep_freed_arrays() -> None:
    """Make the C library keep freed arrays for reuse.

    glibc returns a large block to the system when it is freed, and the page faults of the next allocation then cost more than
    the arithmetic. Its threshold for a large block rises to the largest block freed so far: so free one larger than our arrays.
    """
    torch.empty(_LARGE_BLOCK_BYTES, dtype=torch.uint8)


def give_back_freed_memory() -> None:
    """Return to the system what was freed, and is kept for arrays of a size that are not needed soon."""
    trim = _malloc_trim()
    if trim is not None:
        trim(0)


@lru_cache(maxsize=1)
def _malloc_trim() -> Any:
    return getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform == "linux" else None
