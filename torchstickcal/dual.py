"""Derivatives along a direction, by dual numbers (forward-mode automatic differentiation)."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor
from torch.autograd import forward_ad

from torchstickcal.inference import ordinary

_in_use = threading.RLock()


@contextmanager
def dual_numbers() -> Iterator[None]:
    """A region in which dual numbers can be made. Torch has one for the whole process: other threads wait.

    Example:
        >>> import torch
        >>> with dual_numbers():
        ...     tangent(dual(torch.tensor(3.0), torch.tensor(1.0)).square())
        tensor(6.)
    """
    with _in_use, torch.inference_mode(mode=False), forward_ad.dual_level():  # in inference mode there are no dual numbers
        yield


def dual(value: Tensor, direction: Tensor) -> Tensor:
    """A value as a dual number, which carries its derivative along a direction through what is computed from it."""
    return forward_ad.make_dual(ordinary(value), direction)


def tangent(value: Tensor) -> Tensor:
    """The derivative that a dual number carries; zero if it carries none."""
    parts = forward_ad.unpack_dual(value)
    return torch.zeros_like(parts.primal) if parts.tangent is None else parts.tangent


def _renew() -> None:
    """Begin anew in a forked process: another thread may have been in such a region, and threads do not survive a fork."""
    global _in_use
    _in_use = threading.RLock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_renew)
