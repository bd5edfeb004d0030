"""Worker processes of one torch thread each, which end when the process that started them ends, however it ends."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection
from types import TracebackType
from typing import ParamSpec, Self, TypeVar

import torch

_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")

SPAWN = multiprocessing.get_context("spawn")
"""How the processes are started: each begins anew, because a fork would copy threads and locks in the middle of their work."""


class WorkerProcesses:
    """A pool of processes, used in a ``with`` block; an exception in the block ends the processes at once.

    The processes do not hear Ctrl-C: this process hears it and ends them.

    Args:
        count: number of processes.
        prepare: called first in each of them.

    Example::

        with WorkerProcesses(2) as processes:
            print(processes.submit(abs, -3).result())
    """

    def __init__(self, count: int, prepare: Callable[[], object] | None = None) -> None:
        self._theirs, self._ours = SPAWN.Pipe(duplex=False)
        self._pool = ProcessPoolExecutor(count, SPAWN, initializer=_start, initargs=(self._theirs, prepare))

    def submit(
        self, function: Callable[_Arguments, _Result], *arguments: _Arguments.args, **keywords: _Arguments.kwargs
    ) -> Future[_Result]:
        """Have a process call a function.

        Raises:
            BrokenProcessPool: if one of the processes has ended.
        """
        with _without_interrupts():
            return self._pool.submit(function, *arguments, **keywords)

    def end(self) -> None:
        """End the processes at once, whatever they are doing."""
        self._ours.close()
        self._pool.shutdown(cancel_futures=True)
        self._theirs.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if kind is None:
            self._pool.shutdown()
        self.end()


@contextmanager
def _without_interrupts() -> Iterator[None]:
    """A block that starts processes which do not hear Ctrl-C."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    handler = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, handler)


def _start(parent: Connection, prepare: Callable[[], object] | None) -> None:
    """Make a new process ready to work.

    Args:
        parent: a pipe that the process which started this one closes, or that the operating system closes when that one ends.
        prepare: called at the end.
    """
    threading.Thread(target=_end_with, args=(parent,), daemon=True).start()
    torch.set_num_threads(1)
    if prepare:
        prepare()


def _end_with(parent: Connection) -> None:
    """End this process as soon as the other end of a pipe is closed, whatever else it is doing."""
    with suppress(EOFError, OSError):
        parent.recv_bytes()
    os._exit(1)
