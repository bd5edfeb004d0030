"""One session, from reading it to its written results and its row; runs in any process."""

from __future__ import annotations

import hashlib
import pickle
import re
import time
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass, is_dataclass
from pathlib import Path
from typing import Any

from torchstickcal.config import Config
from torchstickcal.files import atomic_set, remove_remains
from torchstickcal.many.manifest import CONVERGED, FAILED, NOT_CONVERGED, SessionRow
from torchstickcal.many.memory import Budget, check_enough, needed_bytes
from torchstickcal.many.sources import Source
from torchstickcal.pipeline.calibrate import calibrate
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


def perform(task: Task) -> tuple[SessionRow, Calibration | None]:
    """Calibrate a session. Whatever goes wrong is its row; the result is returned where it is not written."""
    began = time.perf_counter()
    try:
        if task.prepare:
            task.prepare()
        settings: Settings = pickle.loads(task.settings)
        calibration, folder = _calibrated(task.source, settings)
    except Exception as error:
        return failed_row(task, error_text(error), time.perf_counter() - began), None
    row = _row(task, calibration, time.perf_counter() - began, folder)
    return row, calibration if settings.out is None else None


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


def _calibrated(source: Source, settings: Settings) -> tuple[Calibration, str | None]:
    """A session's calibration, and where its results have been written.

    Raises:
        CalibrationError: if it cannot be calibrated.
        OSError: if results cannot be written.
    """
    session = source.load()
    needed = needed_bytes(session.observations)
    if settings.memory_bytes is not None:
        check_enough(needed, settings.memory_bytes)
    with _budget.taking(needed) if _budget else nullcontext():
        calibration = calibrate(session.observations, settings.config, refine=settings.refine)
        if settings.out is None:
            return calibration, None
        name = f"{RESULTS}/{folder_of(source.name)}"
        provenance = {"session": source.origin, "name": source.name}
        if session.notes:
            provenance |= {"notes": list(session.notes)}
        with atomic_set(settings.out / name) as folder:
            settings.write(calibration, folder, provenance)
        remove_remains(settings.out / name)
        return calibration, name


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
