"""Several small sessions at a time: the adjustments of sessions of one kind run side by side, everything else one by one.

The operations of a small session are so short that much of their time is spent on calling them. Side by side, sessions share
the calls.
"""

from __future__ import annotations

import time
from collections.abc import Hashable, Sequence
from contextlib import suppress

from torchstickcal.config import Config
from torchstickcal.observations import Observations
from torchstickcal.pipeline.adjustment import Adjustment
from torchstickcal.pipeline.calibrate import Due, calibration_steps
from torchstickcal.pipeline.inference import inference_of
from torchstickcal.pipeline.run import Run
from torchstickcal.result import Calibration
from torchstickcal.workers import on_worker

KEYPOINTS_TOGETHER = 32_000
"""Keypoints, seen or not, of sessions that are worth adjusting side by side: more would leave the processor's cache."""


def calibrate_together(sessions: Sequence[Observations], config: Config) -> list[Calibration | None]:
    """Calibrate several sessions on one device, with the results of :func:`torchstickcal.calibrate` up to rounding errors.

    Args:
        sessions: of any shapes; those that are alike are adjusted side by side.
        config: of all of them.

    Returns:
        The calibration of each session; None where something has gone wrong. Calibrated alone, such a session says what.
    """
    return on_worker(sessions[0].keypoints.device, _together, sessions, config) if sessions else []


def _together(sessions: Sequence[Observations], config: Config) -> list[Calibration | None]:
    every = [_Session(session, config) for session in sessions]
    with inference_of(max(sessions, key=lambda session: session.keypoints.numel()), config):
        for session in every:
            session.go_on()
        while waiting := [session for session in every if session.due]:
            for alike in _alike(waiting):
                _adjust(alike, config)
    return [session.found for session in every]


class _Session:
    """A session on its way from one adjustment to the next."""

    def __init__(self, observations: Observations, config: Config) -> None:
        self._steps = calibration_steps(observations, config)
        self._stopped = 0.0
        self.due: Due | None = None
        """the adjustment that it waits for; None before the first and after the last one"""
        self.found: Calibration | None = None

    def go_on(self, adjusted: Adjustment | None = None) -> None:
        """Take an adjustment, None at the beginning, and go on to the next one."""
        if self.due:
            self.due.run.took("total", self._stopped - time.perf_counter())  # the time of the others is not its own
        self.due = None
        with suppress(Exception):  # whatever it is, calibrated alone the session will say it
            try:
                self.due = self._steps.send(adjusted)
            except StopIteration as ended:
                self.found = ended.value
        self._stopped = time.perf_counter()

    def give_up(self) -> None:
        """Leave it without a calibration."""
        self.due = None


def _alike(sessions: Sequence[_Session]) -> list[list[tuple[_Session, Due]]]:
    """Those whose adjustments can be made as one batch."""
    groups: dict[Hashable, list[tuple[_Session, Due]]] = {}
    for session in sessions:
        if due := session.due:
            groups.setdefault((due.adjust, due.adjustment.kind), []).append((session, due))
    return list(groups.values())


def _adjust(alike: Sequence[tuple[_Session, Due]], config: Config) -> None:
    """Make the adjustments of sessions as one batch. Each is said to have taken its share of the time."""
    began, run = time.perf_counter(), Run(config)
    try:
        batch = alike[0][1].adjust(Adjustment.stack([due.adjustment for _, due in alike]), run)
    except Exception:  # it is not known whose it is
        for session, _ in alike:
            session.give_up()
        return
    run.took("total", time.perf_counter() - began)
    for number, (session, due) in enumerate(alike):
        for step, seconds in run.seconds.items():
            due.run.took(step, seconds / len(alike))
        session.go_on(batch.alone(number).after(due.adjustment))
