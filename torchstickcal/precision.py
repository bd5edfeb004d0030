"""At least float32: tensors of lower precision are widened, and no autocast region lowers the precision of what is computed."""

from __future__ import annotations

import functools
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import ParamSpec, TypeVar

import torch
from torch import Tensor

_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")


def at_least_float32(tensor: Tensor) -> Tensor:
    """A tensor of real numbers as float32 or float64, with gradients: lower precisions widened, integers as float64."""
    if tensor.is_floating_point():
        return tensor.float() if tensor.dtype.itemsize < torch.float32.itemsize else tensor
    return tensor.double()


def in_common_precision(*tensors: Tensor) -> tuple[Tensor, ...]:
    """Tensors of real numbers in the highest precision that one of them has, at least float32, with gradients."""
    wide = [at_least_float32(tensor) for tensor in tensors]
    dtype = torch.float64 if any(tensor.dtype == torch.float64 for tensor in wide) else torch.float32
    return tuple(tensor.to(dtype) for tensor in wide)


def full_precision(device: torch.device) -> AbstractContextManager[object]:
    """A region without autocast: half precision would spoil poses and residuals, in which large numbers nearly cancel."""
    if not torch.amp.is_autocast_available(device.type):
        return nullcontext()
    return torch.autocast(device.type, enabled=False)


def in_full_precision(function: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """Decorator: compute without autocast, on the device of the first tensor among the arguments."""

    @functools.wraps(function)
    def guarded(*arguments: _Arguments.args, **keywords: _Arguments.kwargs) -> _Result:
        tensors = (value for value in (*arguments, *keywords.values()) if isinstance(value, Tensor))
        with full_precision(next((tensor.device for tensor in tensors), torch.device("cpu"))):
            return function(*arguments, **keywords)

    return guarded
