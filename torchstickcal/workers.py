"""Threads of our own for work on the CPU, each of which keeps torch to itself.

The solvers' operations are small: shared among torch's threads they gain nothing on an idle machine and lose much on a busy
one, where every matrix product waits for a thread that does not run. How many threads torch takes is a setting of the calling
thread, so here it can be one without a change to the caller's.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import ParamSpec, TypeVar

import torch

_Arguments = ParamSpec("_Arguments")
_Item = TypeVar("_Item")
_Result = TypeVar("_Result")

_pools: dict[int, ThreadPoolExecutor] = {}
"""By process: threads do not survive a fork."""
_here = threading.local()


def on_worker(
    device: torch.device,
    function: Callable[_Arguments, _Result],
    *arguments: _Arguments.args,
    **keywords: _Arguments.kwargs,
) -> _Result:
    """A function's result; for work on the CPU, computed in a thread in which torch has one thread."""
    if device.type != "cpu" or _is_worker():
        return function(*arguments, **keywords)
    return _pool().submit(_as_here(function), *arguments, **keywords).result()


def map_on_workers(device: torch.device, function: Callable[[_Item], _Result], items: Iterable[_Item]) -> list[_Result]:
    """A function's results for several items; for work on the CPU, side by side in as many threads as torch has here."""
    if device.type != "cpu" or _is_worker():
        return list(map(function, items))
    return list(_pool().map(_as_here(function), items))


def _is_worker() -> bool:
    return getattr(_here, "is_worker", False)


def _as_here(function: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """The function under the caller's choice of whether to record gradients."""
    enabled = torch.is_grad_enabled()

    def run(*arguments: _Arguments.args, **keywords: _Arguments.kwargs) -> _Result:
        with torch.set_grad_enabled(enabled):
            return function(*arguments, **keywords)

    return run


def _pool() -> ThreadPoolExecutor:
    """This process's threads."""
    if os.getpid() not in _pools:
        threads = torch.get_num_threads()
        pool = ThreadPoolExecutor(threads, "torchstickcal", initializer=_become_worker)
        all_started = threading.Barrier(threads)
        list(pool.map(lambda _: all_started.wait(), range(threads)))
        torch.set_num_threads(threads)  # what threads started later begin with
        _pools[os.getpid()] = pool
    return _pools[os.getpid()]


def _become_worker() -> None:
    _here.is_worker = True
    torch.get_num_threads()  # a thread that has not asked yet would take everybody's number at its first operation
    torch.set_num_threads(1)
