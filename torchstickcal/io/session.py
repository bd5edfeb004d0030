"""Names that simulate/ and benchmark/ import from here; they are found when they are used."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torchstickcal.io import SPORTS_STICK_SYN_JOINTS, Truth, read_npz, write_npz

__all__ = ["SPORTS_STICK_SYN_JOINTS", "Truth", "read_npz", "write_npz"]


def __getattr__(name: str) -> Any:
    return getattr(import_module("torchstickcal.io"), name)
