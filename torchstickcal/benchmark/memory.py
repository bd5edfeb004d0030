"""Peak memory of a call, measured in two ways: of the process, and of torch's tensors."""

from __future__ import annotations

import ctypes
import itertools
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch.profiler import ProfilerActivity, profile

from torchstickcal.observations import Observations
from torchstickcal.workers import on_worker

_STATUS, _RESET = Path("/proc/self/status"), Path("/proc/self/clear_refs")


class Memory(NamedTuple):
    """Peak memory that a call needs in addition to what is allocated before it."""

    resident_bytes: int | None
    """of the process; None where the operating system does not report it (Linux does)"""
    tensor_bytes: int
    """allocated by torch for tensors"""


def memory_needed(call: Callable[[], Any]) -> Memory:
    """Peak memory of a call, which is made twice: once for each way of measuring.

    Example:
        >>> import torch
        >>> memory_needed(lambda: torch.ones(1_000_000).sum()).tensor_bytes >= 4_000_000
        True
    """
    return Memory(_peak_resident_bytes(call), on_worker(torch.device("cpu"), _peak_tensor_bytes, call))


def input_bytes(observations: Observations) -> int:
    """Size of the arrays of a session, bytes."""
    given = (observations.keypoints, observations.confidence, observations.intrinsics, observations.distortion)
    return sum(tensor.numel() * tensor.element_size() for tensor in given if tensor is not None)


def _peak_resident_bytes(call: Callable[[], Any]) -> int | None:
    """Increase of the resident memory of the process to its peak during the call.

    Memory that earlier calls have freed is first returned to the operating system; otherwise the call would reuse it and
    appear to need none.
    """
    try:
        ctypes.CDLL(None).malloc_trim(0)
        _RESET.write_text("5")
        before = _status("VmRSS")
    except (OSError, AttributeError, KeyError, TypeError):
        return None
    call()
    return max(0, _status("VmHWM") - before)


def _peak_tensor_bytes(call: Callable[[], Any]) -> int:
    """Peak of torch's own record of allocations; a block that is freed before anything else is allocated does not count.

    The profiler records the thread that starts it: it has to be the one in which the call computes, a worker.
    """
    profiler = profile(activities=[ProfilerActivity.CPU], profile_memory=True)
    with _quiet():
        profiler.start()
    try:
        call()
    finally:
        with _quiet():
            profiler.stop()
    assert profiler.profiler is not None
    results: Any = profiler.profiler.kineto_results
    events = sorted((event for event in results.events() if event.name() == "[memory]"), key=lambda event: event.start_ns())
    sizes = [event.nbytes() for event in events]
    unused = {i for i, pair in enumerate(itertools.pairwise(sizes)) if pair[0] > 0 and sum(pair) == 0}
    kept = (size for i, size in enumerate(sizes) if i not in unused and i - 1 not in unused)
    return max(itertools.accumulate(kept, initial=0))


@contextmanager
def _quiet() -> Iterator[None]:
    """Suppress what the profiler prints to standard error when it starts and stops."""
    saved, null = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 2)
    try:
        yield
    finally:
        os.dup2(saved, 2)
        os.close(saved)
        os.close(null)


def _status(key: str) -> int:
    """An entry of the status file of the process, bytes."""
    lines = dict(line.split(":", 1) for line in _STATUS.read_text("utf-8").splitlines())
    return 1024 * int(lines[key].split()[0])
