"""How far a command is, and how long it still takes, on the last line of a terminal."""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING

from torchstickcal.cli.console import show_status, shows_status

if TYPE_CHECKING:
    from torchstickcal.config import Config
    from torchstickcal.observations import Observations
    from torchstickcal.pipeline.calibrate import Callback
    from torchstickcal.result import Calibration
    from torchstickcal.solvers import IterationRecord

_AFTER_S = 1.0
"""What takes less has no bar."""
_EVERY_S = 0.1
_WIDTH = 30
_HALF_WAY = 4
"""Iterations after which half of a stage is taken to be done: how many it needs is not known."""


class Progress:
    """A bar with the time left. It is drawn from the first second on.

    Args:
        shown: whether it is drawn at all.
    """

    def __init__(self, shown: bool) -> None:
        self._shown = shown
        self._began = self._drawn = time.monotonic()
        self._first: tuple[float, float] | None = None
        """when it was first called, and how much was done then"""

    def __call__(self, done: float, total: float, what: str) -> None:
        """Show how much is done, and what is done now. The time left follows from what was done since the first call."""
        now = time.monotonic()
        self._first = (now, done) if self._first is None else self._first
        if not self._shown or total <= 0 or now - self._began < _AFTER_S or now - self._drawn < _EVERY_S:
            return
        self._drawn = now
        filled, since = int(_WIDTH * done / total), done - self._first[1]
        left = f", {_duration((now - self._first[0]) * (total - done) / since)} left" if since > 0 else ""
        show_status(f"[{'#' * filled:<{_WIDTH}}] {100 * done / total:.0f} %{left}: {what}")


@contextmanager
def progress(options: argparse.Namespace) -> Iterator[Progress]:
    """A block with a bar in a terminal; none if the output goes elsewhere, or with ``--quiet`` or ``--json``."""
    try:
        yield Progress(shows_status() and getattr(options, "json", None) is None)
    finally:
        show_status("")


class StagesProgress:
    """Listens to a calibration and shows how far it is; passes all calls on to another callback.

    Args:
        bar: shows it.
        weights: the stages, in their order, and how long each of them takes in comparison with the others.
        following: the other callback.
    """

    def __init__(self, bar: Progress, weights: Mapping[str, float], following: Callback | None = None) -> None:
        self._bar, self._following, self._furthest = bar, following, 0.0
        self._weights = weights

    def on_start(self, observations: Observations) -> None:
        self._bar(0.0, 1.0, "first estimate")
        if (on_start := getattr(self._following, "on_start", None)) is not None:
            on_start(observations)

    def on_iteration(self, record: IterationRecord) -> None:
        names = list(self._weights)
        before = 1.0 + sum(self._weights[name] for name in names[: names.index(record.stage)])
        inside = self._weights[record.stage] * record.iteration / (record.iteration + _HALF_WAY)
        share = (before + inside) / (1.0 + sum(self._weights.values()))
        self._furthest = max(self._furthest, share)  # some stages are run again
        self._bar(self._furthest, 1.0, f"stage {record.stage}, iteration {record.iteration}")
        if self._following:
            self._following.on_iteration(record)

    def on_end(self, calibration: Calibration) -> None:
        self._bar(1.0, 1.0, "quality and files")
        if self._following:
            self._following.on_end(calibration)


def weights_of(config: Config) -> dict[str, float]:
    """The stages of a configuration, and how long each of them takes in comparison with the others."""
    return {name: 2.0 if stage.cameras == "held" else 1.0 for name, stage in config.stages.items()}


def _duration(seconds: float) -> str:
    """A time as people say it.

    Example:
        >>> _duration(12), _duration(200), _duration(5000)
        ('12 s', '3 min', '1.4 h')
    """
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 3600 else f"{seconds / 3600:.1f} h"
