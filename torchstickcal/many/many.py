"""Many sessions: which of them are still to be done, who does them, and what became of them."""

from __future__ import annotations

import os
import pickle
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from torchstickcal.config import Config, Refine, load_config
from torchstickcal.errors import CalibrationError, ConfigError, quoted
from torchstickcal.files import POINTS_FILE, try_writing
from torchstickcal.many.engine import on_executor, on_processes
from torchstickcal.many.manifest import FAILED, SessionRow, manifest_name, open_manifest, read_manifests
from torchstickcal.many.sources import SessionLike, Source, sources_of
from torchstickcal.many.tables import FILES, write_tables
from torchstickcal.many.task import Settings, Task, Write
from torchstickcal.outputs import ResultFiles
from torchstickcal.result import Calibration

_MOST_PER_PROCESSOR = 8

Progress = Callable[[int, int | None, SessionRow], None]
"""Called with the number of sessions that are done, that of all if it is known, and the row of the last one."""


@dataclass(frozen=True, eq=False)
class ManyCalibrations:
    """What became of many sessions."""

    rows: tuple[SessionRow, ...]
    """one for each session, in their order"""
    out: Path | None
    """folder of the results; None where they are in memory"""
    _in_memory: Mapping[str, Calibration] = field(default_factory=dict, repr=False)

    def calibration(self, name: str) -> Calibration:
        """The calibration of a session.

        Args:
            name: of the session, as in its row.

        Raises:
            CalibrationError: if there is no session of that name, or if it failed.
            FileNotFoundError: if its results were written without ``points.npz``, or have been removed.
        """
        row = next((row for row in self.rows if row.name == name), None)
        if row is None or row.outcome == FAILED:
            got = "no session of that name" if row is None else row.error
            raise CalibrationError("no calibration", where=name, got=got, expected="a session that was calibrated")
        if self.out is None:
            return self._in_memory[name]
        return Calibration.load(self.out / str(row.folder) / POINTS_FILE)


def calibrate_many(
    sessions: Mapping[str, SessionLike] | Iterable[SessionLike],
    config: str | Path | Mapping[str, Any] | Config = "default",
    refine: Sequence[Refine] | Literal["auto"] | None = None,
    executor: Executor | None = None,
    out: str | Path | None = None,
    *,
    jobs: int | None = None,
    memory_bytes: int | None = None,
    shard: tuple[int, int] | None = None,
    retry: bool = False,
    write: Write | None = None,
    prepare: Callable[[], object] | None = None,
    progress: Progress | None = None,
) -> ManyCalibrations:
    """Calibrate many sessions, except for those that the folder ``out`` already has.

    The results do not depend on the executor, nor on the order, up to rounding errors: small sessions are adjusted side by side
    in batches. With ``out``, each session has a row in a manifest as soon as
    its results are written: whatever is interrupted, the same call goes on with the sessions that are missing. A session that
    cannot be calibrated is a row with its error, and is not tried again unless ``retry`` asks for it.

    Args:
        sessions: by name, or a list or another iterable: paths of files of any format, :class:`Observations`, or functions
            without arguments that return them when their turn comes.
        config: as of :func:`torchstickcal.calibrate`.
        refine: as of :func:`torchstickcal.calibrate`.
        executor: of ``concurrent.futures``; None for processes of this machine, with one thread each.
        out: folder of the results, created if it does not exist; None to keep them in memory.
        jobs: number of processes, where there is no executor; None for one per processor.
        memory_bytes: that all processes may need together, by an estimate from the number of keypoints; sessions wait until
            there is enough for them. With an executor: that one session may need. None for any.
        shard: ``(i, n)``, from ``(1, n)`` to ``(n, n)``, for every n-th session only: the rest is done by other calls with the
            same sessions in the same order, on other machines.
        retry: whether sessions that failed are tried again.
        write: writes the files of each session; None for ``ResultFiles()``, all that ``calibrate`` writes. A function of your
            own is called with a calibration, a folder, and a dictionary that says of what session it is. Where it has options,
            it is a dataclass: its ``repr`` tells one choice of them from another.
        prepare: called first where a session is calibrated: it imports the modules that register losses, camera unknowns or
            file formats of your own, for example ``functools.partial(importlib.import_module, "my_losses")``.
        progress: called after each session.

    Returns:
        A row for each session (of the shard), and the way to the calibrations.

    Raises:
        CalibrationError: if ``sessions`` are no sessions or two have one name; if the folder cannot be written to, is in use,
            or holds results of other settings; if the numbers make no sense; and if processes cannot be started.
        ConfigError: if the configuration cannot be used.
        FileFormatError: if the manifest in the folder is damaged.

    Example:
        >>> from concurrent.futures import ThreadPoolExecutor
        >>> from functools import partial
        >>> from torchstickcal import calibrate_many
        >>> from torchstickcal.simulate import golf_session
        >>> def swing(seed):
        ...     return golf_session(cameras=3, frames=10, seed=seed)[0]
        >>> with ThreadPoolExecutor(2) as threads:
        ...     done = calibrate_many({f"swing {seed}": partial(swing, seed) for seed in (1, 2)}, executor=threads)
        >>> [(row.name, row.outcome) for row in done.rows]
        [('swing 1', 'converged'), ('swing 2', 'converged')]
        >>> done.calibration("swing 2").points.shape
        torch.Size([10, 21, 3])
    """
    jobs = _checked_jobs(jobs, executor)
    _check_shard(shard)
    folder = None if out is None else Path(out).absolute()
    settings = Settings(load_config(config), refine, folder, write or ResultFiles(), memory_bytes if executor else None)
    sources, total = sources_of(sessions)
    if shard is not None:
        total = None if total is None else len(range(shard[0] - 1, total, shard[1]))
        sources = (source for number, source in enumerate(sources) if number % shard[1] == shard[0] - 1)

    earlier: dict[str, SessionRow] = {}
    found: dict[str, SessionRow] = {}
    calibrations: dict[str, Calibration] = {}
    with ExitStack() as stack:
        manifest = None
        if folder is not None:
            try_writing(folder, FILES)
            folder.mkdir(parents=True, exist_ok=True)
            manifest = stack.enter_context(open_manifest(folder / manifest_name(shard)))
            earlier = {name: row for name, row in read_manifests(folder).items() if not (retry and row.outcome == FAILED)}
        plan = _Plan(sources, settings, prepare, earlier)
        count = jobs if total is None else max(1, min(jobs, total))
        done = on_executor(plan.tasks(), executor) if executor else on_processes(plan.tasks(), count, memory_bytes, prepare)
        for together in stack.enter_context(closing(done)):
            if manifest is not None:
                manifest.append([row for row, _ in together])
            for row, calibration in together:
                if calibration is not None:
                    calibrations[row.name] = calibration
                found[row.name] = row
                if progress:
                    progress(plan.done_earlier + len(found), total, row)
    if folder is not None:
        write_tables(folder)
    rows = earlier | found
    return ManyCalibrations(tuple(rows[name] for name in plan.names), folder, calibrations)


class _Plan:
    """Which sessions are still to be done, found out while they are asked for.

    Args:
        sources: all sessions.
        settings: what they share.
        prepare: called first where they are calibrated.
        earlier: rows of those that are done.
    """

    def __init__(
        self,
        sources: Iterator[Source],
        settings: Settings,
        prepare: Callable[[], object] | None,
        earlier: Mapping[str, SessionRow],
    ) -> None:
        self._sources, self._settings, self._prepare, self._earlier = sources, settings, prepare, earlier
        self._packed = _pickled(settings)
        self.names: list[str] = []
        """of all sessions so far"""
        self.done_earlier = 0
        """how many of them had been done"""

    def tasks(self) -> Iterator[Task]:
        """What is still to be done.

        Raises:
            CalibrationError: if a session was calibrated with other settings.
        """
        for source in self._sources:
            self.names.append(source.name)
            code, row = self._settings.code_of(source), self._earlier.get(source.name)
            if row is None:
                yield Task(source, code, self._prepare, self._packed)
                continue
            self.done_earlier += 1
            if row.settings != code:
                raise CalibrationError(
                    "the folder holds results of other settings",
                    where=str(self._settings.out),
                    got=f"{source.name}, calibrated with another configuration or other options",
                    expected="the same configuration and options as before",
                    remedy="Choose another folder.",
                )


def _pickled(settings: Settings) -> bytes:
    """The settings as they are sent to other processes.

    Raises:
        CalibrationError: if they cannot be.
    """
    try:
        return pickle.dumps(settings)
    except Exception as error:
        raise CalibrationError(
            "the settings cannot be sent to other processes",
            where="config, write",
            got=f"{type(error).__name__}: {error}",
            expected="classes and functions at the top of a module",
        ) from error


def _checked_jobs(jobs: int | None, executor: Executor | None) -> int:
    """The number of processes.

    Raises:
        ConfigError: if it makes no sense.
    """
    processors = os.cpu_count() or 1
    if jobs is None:
        return processors
    if executor is not None:
        raise ConfigError("an executor has its own number of processes", where="jobs", got=jobs, expected="jobs or executor")
    if not 1 <= jobs <= _MOST_PER_PROCESSOR * processors:
        what = "no process to calibrate in" if jobs < 1 else "more processes than this machine can run"
        raise ConfigError(what, where="jobs", got=jobs, expected=f"1 to {_MOST_PER_PROCESSOR * processors}")
    return jobs


def _check_shard(shard: tuple[int, int] | None) -> None:
    """Refuse a shard that does not exist.

    Raises:
        ConfigError: if it does not.
    """
    if shard is not None and not 1 <= shard[0] <= shard[1]:
        got = f"{shard[0]}/{shard[1]}"
        raise ConfigError("no such shard", where="shard", got=quoted(got), expected="i/n with i from 1 to n, such as 1/4")
