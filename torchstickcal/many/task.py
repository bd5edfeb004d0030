"""Sessions, from reading them to their written results and their rows; runs in any process."""

from __future__ import annotations

import hashlib
import pickle
import re
import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, is_dataclass
from pathlib import Path
from typing import Any, NamedTuple

from torchstickcal.config import Config, with_refine
from torchstickcal.errors import CalibrationError, ConfigError
from torchstickcal.files import atomic_set, remove_remains
from torchstickcal.io import LoadedSession
from torchstickcal.many.manifest import CONVERGED, FAILED, NOT_CONVERGED, SessionRow
from torchstickcal.many.memory import Budget, check_enough, needed_bytes
from torchstickcal.many.sources import Source
from torchstickcal.observations import Observations
from torchstickcal.pipeline.calibrate import calibrate
from torchstickcal.pipeline.together import KEYPOINTS_TOGETHER, calibrate_together
from torchstickcal.result import Calibration

RESULTS = "results"
"""The folder, in that of all results, with a folder for each session."""
_LONGEST_FOLDER = 100

Write = Callable[[Calibration, Path, dict[str, Any]], None]
"""Writes a calibration into a folder; the dictionary says of what session it is, as JSON can hold it."""


@dataclass(frozen=True)
class Settings:
    """What all sessions share."""

    config: Config
    refine: Any
    out: Path | None
    """folder of the results of all; None where they are returned"""
    write: Write
    memory_bytes: int | None
    """that one session may need"""

    def code_of(self, source: Source) -> str:
        """A short code that is the same for the same configuration and options."""
        write = repr(self.write) if is_dataclass(self.write) else getattr(self.write, "__qualname__", type(self.write).__name__)
        return hashlib.sha256(repr((self.config, self.refine, write, source.options)).encode()).hexdigest()[:12]


@dataclass(frozen=True)
class Task:
    """A session to be calibrated, as it is sent to another process."""

    source: Source
    code: str
    """of its settings"""
    prepare: Callable[[], object] | None
    """called first, in the process that calibrates: settings may be of classes that only it knows"""
    settings: bytes
    """pickled :class:`Settings`"""


_budget: Budget | None = None
"""The memory that the processes of a pool share."""


def use_budget(budget: Budget | None, prepare: Callable[[], object] | None) -> None:
    """Begin a process of a pool."""
    global _budget
    _budget = budget
    if prepare:
        prepare()


Done = tuple[SessionRow, Calibration | None]
"""What became of a session, and its calibration where it is not written."""


class Performed(NamedTuple):
    """What a call has done of the tasks that it was given."""

    done: list[Done]
    """of the first of them"""
    together: int | None = None
    """how many such sessions are worth calibrating together; None if that is not known"""


def perform(tasks: Sequence[Task]) -> Performed:
    """Calibrate sessions. Whatever goes wrong with one is its row.

    Small ones are adjusted side by side, as many as are worth it. A large one is calibrated only if it is the only task: the
    others need not wait for it.
    """
    taken: list[_Loaded | Done] = []
    sessions: list[_Loaded] = []
    for task in tasks:
        loaded = _loaded(task)
        if isinstance(loaded, _Loaded):
            if len(tasks) > 1 and loaded.together == 1:
                return Performed(_rows(taken), together=1)
            if sessions and not _fit_together([*sessions, loaded]):
                break
            sessions.append(loaded)
        taken.append(loaded)
    return Performed(_rows(taken), min((one.together for one in taken if isinstance(one, _Loaded)), default=None))


def _rows(taken: Sequence[_Loaded | Done]) -> list[Done]:
    """What becomes of sessions that fit together, or of one, and of those that could not be read."""
    calibrated = iter(_calibrated([one for one in taken if isinstance(one, _Loaded)]))
    return [next(calibrated) if isinstance(one, _Loaded) else one for one in taken]


def failed_row(task: Task, error: str, seconds: float = 0.0) -> SessionRow:
    """The row of a session that could not be calibrated."""
    nothing = dict.fromkeys(
        ("verdict", "cameras", "frames", "keypoints", "reprojection_px", "centre_std_m", "rotation_std_deg", "scale_std",
         "warnings", "folder")
    )  # fmt: skip
    return SessionRow(
        name=task.source.name,
        origin=task.source.origin,
        settings=task.code,
        outcome=FAILED,
        status=FAILED,
        error=error,
        refined="",
        seconds=seconds,
        **nothing,
    )


def error_text(error: BaseException) -> str:
    """An error on one line."""
    return " ".join(f"{type(error).__name__}: {error}".split())


def folder_of(name: str) -> str:
    """A name for a folder: that of the session, with a code where a folder cannot be called so.

    Example:
        >>> folder_of("swing 1.npz"), folder_of("day 2/swing.npz")
        ('swing 1.npz', 'day 2_swing.npz-ecca6757')
    """
    plain = re.sub(r"[^\w .+=@-]", "_", name)[:_LONGEST_FOLDER].strip(" .")
    if plain == name:
        return name
    return f"{plain}-{hashlib.sha256(name.encode()).hexdigest()[:8]}"


@dataclass(frozen=True)
class _Loaded:
    """A session that has been read."""

    task: Task
    settings: Settings
    session: LoadedSession
    seconds: float
    """that this took"""

    @property
    def observations(self) -> Observations:
        return self.session.observations

    @property
    def together(self) -> int:
        """How many such sessions are worth calibrating together."""
        return max(1, KEYPOINTS_TOGETHER // max(1, self.observations.keypoints.numel() // 2))


def _loaded(task: Task) -> _Loaded | Done:
    """A session that is read, or the row that says why it cannot be."""
    began = time.perf_counter()
    try:
        if task.prepare:
            task.prepare()
        settings: Settings = pickle.loads(task.settings)
        return _Loaded(task, settings, task.source.load(), time.perf_counter() - began)
    except Exception as error:
        return failed_row(task, error_text(error), time.perf_counter() - began), None


def _fit_together(sessions: Sequence[_Loaded]) -> bool:
    """Whether sessions are so small that they are worth calibrating side by side, and may need that much memory."""
    every = [session.observations for session in sessions]
    allowed = [b for b in (sessions[0].settings.memory_bytes, _budget and _budget.total_bytes) if b is not None]
    small = sum(one.keypoints.numel() // 2 for one in every) <= KEYPOINTS_TOGETHER
    return small and all(needed_bytes(*every) <= bytes for bytes in allowed)


def _calibrated(sessions: Sequence[_Loaded]) -> list[Done]:
    """What becomes of sessions that fit together, or of one."""
    if not sessions:
        return []
    needed = needed_bytes(*(session.observations for session in sessions))
    try:
        if (allowed := sessions[0].settings.memory_bytes) is not None:
            check_enough(needed, allowed)
        with _budget.taking(needed) if _budget else nullcontext():
            began = time.perf_counter()
            found = _side_by_side(sessions)
            share = (time.perf_counter() - began) / len(sessions)
            return [_concluded(session, calibration, share) for session, calibration in zip(sessions, found, strict=True)]
    except CalibrationError as error:  # there is not enough memory
        return [(failed_row(session.task, error_text(error), session.seconds), None) for session in sessions]


def _side_by_side(sessions: Sequence[_Loaded]) -> list[Calibration | None]:
    """The calibrations of sessions; None for those that have to be calibrated alone."""
    settings = sessions[0].settings
    if len(sessions) == 1:
        return [None]
    try:
        config = settings.config if settings.refine is None else with_refine(settings.config, settings.refine)
    except ConfigError:  # each session says it
        return [None] * len(sessions)
    return calibrate_together([session.observations for session in sessions], config)


def _concluded(loaded: _Loaded, calibration: Calibration | None, seconds: float) -> Done:
    """The results of a session, written where they are to be, and its row.

    Args:
        loaded: the session.
        calibration: what was found together with others; None to calibrate it now.
        seconds: the session's share of the time of that.
    """
    began, task, settings = time.perf_counter() - loaded.seconds - seconds, loaded.task, loaded.settings
    try:
        if calibration is None:
            calibration = calibrate(loaded.observations, settings.config, refine=settings.refine)
        folder = None if settings.out is None else _written(calibration, loaded, settings.out)
        row = _row(task, calibration, time.perf_counter() - began, folder)
    except Exception as error:
        return failed_row(task, error_text(error), time.perf_counter() - began), None
    return row, calibration if settings.out is None else None


def _written(calibration: Calibration, loaded: _Loaded, out: Path) -> str:
    """Write the results of a session; where they are in the folder of all results.

    Raises:
        OSError: if they cannot be written.
    """
    source = loaded.task.source
    name = f"{RESULTS}/{folder_of(source.name)}"
    provenance: dict[str, Any] = {"session": source.origin, "name": source.name}
    if loaded.session.notes:
        provenance["notes"] = list(loaded.session.notes)
    with atomic_set(out / name) as folder:
        loaded.settings.write(calibration, folder, provenance)
    remove_remains(out / name)
    return name


def _row(task: Task, calibration: Calibration, seconds: float, folder: str | None) -> SessionRow:
    residuals = calibration.residuals_px.norm(dim=-1)[calibration.inliers]
    return SessionRow(
        name=task.source.name,
        origin=task.source.origin,
        settings=task.code,
        outcome=CONVERGED if calibration.converged else NOT_CONVERGED,
        status=calibration.status,
        error=None,
        verdict=calibration.quality.verdict.value,
        cameras=len(calibration.rotations),
        frames=calibration.frame_index.shape[1],
        keypoints=int(calibration.inliers.sum()),
        reprojection_px=_number(residuals.median()) if len(residuals) else None,
        centre_std_m=_number(calibration.camera_std_m.max()),
        rotation_std_deg=_number(calibration.camera_std_deg.max()),
        scale_std=_number(calibration.scale_std),
        refined=",".join(calibration.refined),
        warnings=len(calibration.warnings),
        seconds=seconds,
        folder=folder,
    )


def _number(value: Any) -> float | None:
    """A number as JSON can hold it: None where it is not known."""
    number = float(value)
    return number if number - number == 0 else None
