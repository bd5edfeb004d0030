"""What may happen to files: to the bytes of any, and to what those of one format say."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

Damage = Callable[[bytes, np.random.Generator], bytes]
"""From the content of a file to other content."""

CANARY = Path(tempfile.gettempdir(), f"torchstickcal_canary_{os.getpid()}")
"""A file that exists if a program inside another file was run."""


class Program:
    """A pickle of this runs a program that leaves a mark."""

    def __reduce__(self) -> tuple[object, ...]:
        return os.system, (f"touch {CANARY}",)
