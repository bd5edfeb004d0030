"""Memory of the sessions that are calibrated at the same time: each takes what it needs, and waits until there is enough."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from torchstickcal.errors import CalibrationError
from torchstickcal.observations import Observations
from torchstickcal.processes import SPAWN

PROCESS_BYTES = 400_000_000
"""What a process needs before it has read a session."""
_SESSION_BYTES, _KEYPOINT_BYTES, _FURTHER_KEYPOINT_BYTES = 50_000_000, 1100, 130
"""What a calibration needs in addition: at most so much, and for each keypoint of the session, measured from 6 to 840
thousand keypoints; beyond a million it was not."""
_MOST_CHECKED = 1_000_000
"""Keypoints beyond which a longer session needs less for each: its lenses and clocks are checked on a part of it."""


class Budget:
    """Memory that some processes share, bytes. First come, first served: a large session waits until it is alone."""

    def __init__(self, total_bytes: int) -> None:
        self.total_bytes = total_bytes
        self._taken = SPAWN.Value("q", 0, lock=False)
        self._returned = SPAWN.Condition()
        self._queue = SPAWN.Lock()

    @contextmanager
    def taking(self, needed_bytes: int) -> Iterator[None]:
        """A block that needs some memory; it begins when there is enough.

        Raises:
            CalibrationError: if there will never be enough.
        """
        check_enough(needed_bytes, self.total_bytes)
        with self._queue, self._returned:
            self._returned.wait_for(lambda: self._taken.value + needed_bytes <= self.total_bytes)
            self._taken.value += needed_bytes
        try:
            yield
        finally:
            with self._returned:
                self._taken.value -= needed_bytes
                self._returned.notify_all()


def memory_for_sessions(memory_bytes: int, processes: int) -> int:
    """What is left for sessions, bytes, of the memory of some processes and the one that started them.

    Raises:
        CalibrationError: if nothing is left.
    """
    own = (processes + 1) * PROCESS_BYTES
    if memory_bytes <= own:
        raise CalibrationError(
            "too little memory for the processes",
            where="memory",
            got=f"{memory_bytes / 1e9:.2f} GB for {processes} processes and the one that starts them",
            expected=f"more than {own / 1e9:.2f} GB",
            remedy="Allow more memory, or use fewer processes.",
        )
    return memory_bytes - own


def check_enough(needed_bytes: int, total_bytes: int) -> None:
    """Refuse a session that needs more memory than there is.

    Raises:
        CalibrationError: if it does.
    """
    if needed_bytes > total_bytes:
        raise CalibrationError(
            "a session needs more memory than it may have",
            where="memory",
            got=f"about {needed_bytes / 1e9:.2f} GB for the session",
            expected=f"at most {total_bytes / 1e9:.2f} GB for all sessions at a time",
            remedy="Allow more memory, use fewer processes, or calibrate a part of its frames.",
        )


def needed_bytes(*sessions: Observations) -> int:
    """An upper estimate of the memory that the calibration of some sessions needs, side by side."""
    keypoints = sum(session.keypoints.numel() // 2 for session in sessions)
    further = max(0, keypoints - _MOST_CHECKED)
    return _SESSION_BYTES + _KEYPOINT_BYTES * (keypoints - further) + _FURTHER_KEYPOINT_BYTES * further
