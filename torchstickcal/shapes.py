"""Shapes of arrays that belong together."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from torch import Tensor

from torchstickcal.errors import CalibrationError


def check_shapes(owner: str, arrays: Mapping[str, Any], shapes: Mapping[str, str]) -> dict[str, int]:
    """Refuse arrays that do not fit together.

    Args:
        owner: what the arrays are of, for the message.
        arrays: by name; None for one that is not known.
        shapes: by name, the axes of each array: a letter for a size that is the same wherever the letter occurs, or a number.

    Returns:
        The size that each letter stands for.

    Raises:
        CalibrationError: for the first array that has another shape.

    Example:
        >>> import torch
        >>> check_shapes("rig", {"rotations": torch.zeros(4, 3, 3), "names": None}, {"rotations": "C 3 3", "names": "C"})
        {'C': 4}
    """
    sizes: dict[str, int] = {}
    for name, axes in shapes.items():
        array = arrays.get(name)
        if array is None:
            continue
        wanted, got = axes.split(), tuple(array.shape)
        if len(got) == len(wanted):
            sizes |= {axis: size for axis, size in zip(wanted, got, strict=True) if axis.isalpha() and axis not in sizes}
        if got != tuple(sizes.get(axis, axis) if axis.isalpha() else int(axis) for axis in wanted):
            known = ", ".join(f"{axis} = {sizes[axis]}" for axis in dict.fromkeys(wanted) if axis in sizes)
            expected = f"({', '.join(wanted)}{',' if len(wanted) == 1 else ''}){f' with {known}' if known else ''}"
            raise CalibrationError("an array of the wrong shape", where=f"{owner}: {name}", got=got, expected=expected)
    return sizes


def extended(values: Tensor, ndim: int) -> Tensor:
    """A tensor with dimensions of 1 appended, ``ndim`` dimensions in all: values per session or camera beside larger tensors.

    Example:
        >>> import torch
        >>> extended(torch.zeros(4), 3).shape
        torch.Size([4, 1, 1])
    """
    return values.reshape(*values.shape, *[1] * (ndim - values.ndim))
