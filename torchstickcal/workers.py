"""Worker threads for work on the CPU, each with a single torch thread.

The solvers' operations are small. With several torch threads per operation they are no faster on an idle machine, and much
slower on a busy one, where each matrix product waits for a thread that is not running. The number of torch threads is a setting
of the calling thread. Worker threads can therefore use one torch thread without changing the caller's setting.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import ParamSpec, TypeVar

import numpy.ma  # noqa: F401 else numpy imports it at its first median, and a process forked meanwhile waits forever
import torch

_Arguments = ParamSpec("_Arguments")
_Item = TypeVar("_Item")
_Result = TypeVar("_Result")

_pool: ThreadPoolExecutor | None = None
_starting = threading.Lock()
"""Held by the thread that starts the workers."""
_this_thread = threading.local()


def on_worker(
    device: torch.device,
    function: Callable[_Arguments, _Result],
    *arguments: _Arguments.args,
    **keywords: _Arguments.kwargs,
) -> _Result:
    """The result of a function. For a CPU device it runs in a worker thread."""
    if device.type != "cpu" or _is_worker():
        return function(*arguments, **keywords)
    return _workers().submit(_with_grad_mode(function), *arguments, **keywords).result()


def map_on_workers(device: torch.device, function: Callable[[_Item], _Result], items: Iterable[_Item]) -> list[_Result]:
    """The results of a function for several items. For a CPU device they run in parallel on the worker threads."""
    if device.type != "cpu" or _is_worker():
        return list(map(function, items))
    return list(_workers().map(_with_grad_mode(function), items))


def map_with_idle_workers(function: Callable[[_Item], _Result], items: Sequence[_Item]) -> list[_Result]:
    """The results of a function for several parts of one worker's work. Idle workers take some of them.

    The worker itself never waits for another one to become idle. Outside the workers, the calling thread does everything.
    """
    if not _is_worker() or _pool is None or len(items) < 2:
        return list(map(function, items))
    results: dict[int, _Result] = {}
    open_items = iter(range(len(items)))  # each is taken by one thread: the step of an iterator cannot be interrupted

    def work() -> None:
        for number in open_items:
            results[number] = function(items[number])

    open_work = [work]  # a cancelled helper stays in the queue until a worker is idle: it must not keep the work alive

    def help_out() -> None:
        for own in open_work:
            own()

    helpers = [_pool.submit(_with_modes(help_out)) for _ in range(min(_pool._max_workers, len(items)) - 1)]
    try:
        work()
    finally:
        for helper in helpers:
            if not helper.cancel():
                helper.result()
        open_work.clear()
    return [results[number] for number in range(len(items))]


def _is_worker() -> bool:
    return getattr(_this_thread, "is_worker", False)


def _with_modes(function: Callable[[], None]) -> Callable[[], None]:
    """The function with this worker's gradient mode and inference mode."""
    enabled, function = torch.is_inference_mode_enabled(), _with_grad_mode(function)

    def run() -> None:
        with torch.inference_mode(mode=enabled):
            function()

    return run


def _with_grad_mode(function: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """The function with the caller's gradient mode, which torch stores per thread."""
    enabled = torch.is_grad_enabled()

    def run(*arguments: _Arguments.args, **keywords: _Arguments.kwargs) -> _Result:
        with torch.set_grad_enabled(enabled):
            return function(*arguments, **keywords)

    return run


def _workers() -> ThreadPoolExecutor:
    """The workers of this process, as many as torch has threads when they are first used, at most one per processor."""
    global _pool
    with _starting:
        if _pool is None:
            torch_threads = torch.get_num_threads()
            threads = min(torch_threads, os.cpu_count() or 1)
            pool = ThreadPoolExecutor(threads, "torchstickcal", initializer=_initialise_worker)
            all_started = threading.Barrier(threads)
            list(pool.map(lambda _: all_started.wait(), range(threads)))
            torch.set_num_threads(torch_threads)  # restore the default for threads that are started later
            _pool = pool
        return _pool


def _initialise_worker() -> None:
    _this_thread.is_worker = True
    torch.get_num_threads()  # without this call, the first operation of the thread would reset the number to the default
    torch.set_num_threads(1)


def _forget_workers() -> None:
    """Begin anew in a forked process: threads do not survive a fork, and another thread may have held the lock."""
    global _pool, _starting
    _pool, _starting = None, threading.Lock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget_workers)
