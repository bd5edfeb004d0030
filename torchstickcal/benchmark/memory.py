"""How much memory a call takes, measured in two ways."""

from __future__ import annotations

import ctypes
import itertools
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from torch.profiler import ProfilerActivity, profile

from torchstickcal.observations import Observations

_STATUS, _RESET = Path("/proc/self/status"), Path("/proc/self/clear_refs")


class Memory(NamedTuple):
    """The most memory that a call needs at a time, beyond what is there before it."""

    resident_bytes: int | None
    """of the process; None where the system does not tell (it does on Linux)"""
    tensor_bytes: int
    """held by torch for tensors"""


def memory_needed(call: Callable[[], Any]) -> Memory:
    """Call twice and watch, each time, one of the two."""
    return Memory(_peak_resident_bytes(call), _peak_tensor_bytes(call))


def input_bytes(observations: Observations) -> int:
    """Size of a session's arrays."""
    given = (observations.keypoints, observations.confidence, observations.intrinsics, observations.distortion)
    return sum(tensor.numel() * tensor.element_size() for tensor in given if tensor is not None)


def _peak_resident_bytes(call: Callable[[], Any]) -> int | None:
    """With what earlier calls have freed given back to the system first, else this one would be seen to need nothing."""
    try:
        ctypes.CDLL(None).malloc_trim(0)
        _RESET.write_text("5")
        before = _status("VmRSS")
    except (OSError, AttributeError, KeyError, TypeError):
        return None
    call()
    return max(0, _status("VmHWM") - before)


def _peak_tensor_bytes(call: Callable[[], Any]) -> int:
    """By torch's own record of allocations; a block freed before any other is made has held nothing, and does not count."""
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
    useless = {i for i, pair in enumerate(itertools.pairwise(sizes)) if pair[0] > 0 and sum(pair) == 0}
    kept = (size for i, size in enumerate(sizes) if i not in useless and i - 1 not in useless)
    return max(itertools.accumulate(kept, initial=0))


@contextmanager
def _quiet() -> Iterator[None]:
    """Without what the profiler's library prints at its start and end."""
    saved, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    try:
        yield
    finally:
        os.dup2(saved, 2)
        os.close(saved)
        os.close(nowhere)


def _status(key: str) -> int:
    """A figure of the process's status file, bytes."""
    lines = dict(line.split(":", 1) for line in _STATUS.read_text("utf-8").splitlines())
    return 1024 * int(lines[key].split()[0])
