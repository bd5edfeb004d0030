"""The command `calibrate-many`."""

from __future__ import annotations

import argparse
import re
import sys
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from textwrap import shorten
from typing import TYPE_CHECKING, Any

from torchstickcal.cli.calibrate import given_of, with_stick
from torchstickcal.cli.configuration import calibration_config, made_with
from torchstickcal.cli.outputs import EXIT_DONE, EXIT_NOT_CONVERGED, chosen_files
from torchstickcal.cli.plugins import import_plugins
from torchstickcal.cli.progress import Progress, progress
from torchstickcal.cli.world import placed, world_of
from torchstickcal.errors import CalibrationError

if TYPE_CHECKING:
    from torchstickcal.many import SessionRow
    from torchstickcal.observations import Observations
    from torchstickcal.outputs import ResultFiles
    from torchstickcal.result import Calibration

_UNITS = {"": 1, "K": 10**3, "M": 10**6, "G": 10**9, "T": 10**12, "Ki": 2**10, "Mi": 2**20, "Gi": 2**30, "Ti": 2**40}
_SIZE = re.compile(r"(\d+(?:\.\d+)?)\s*([KMGT]i?)?B?")
_SHOWN_FAILURES, _LONGEST_ERROR = 5, 250


def calibrate_sessions(options: argparse.Namespace) -> int:
    from torchstickcal.many import calibrate_many, session_files
    from torchstickcal.many.cluster import cluster_executor
    from torchstickcal.many.manifest import CONVERGED, FAILED
    from torchstickcal.many.tables import INDEX_FILE

    config = calibration_config(options)
    memory_bytes, shard = _bytes(options.memory), _shard(options.shard)
    world_of(options.world, options.units)
    files = chosen_files(options.write, options.page, options.rrd)
    writing = _Writing(options.config, files, _with_whole_path(options.world), options.units, tuple(options.set))
    given = given_of(options)
    for name in ("intrinsics", "skeleton"):  # files, which processes elsewhere must find too
        file = getattr(given, name)
        if isinstance(file, str | Path) and Path(file).is_file():
            given = replace(given, **{name: type(file)(Path(file).absolute())})
    stick = _Stick(options.stick_length, options.stick_sigma)
    sessions = session_files(options.sessions, options.format, given, None if stick == _Stick() else stick)
    plugins = [str(Path(plugin).absolute()) if plugin.endswith(".py") else plugin for plugin in options.plugin]
    with cluster_executor(options.cluster) if options.cluster else nullcontext() as executor, progress(options) as bar:
        done = calibrate_many(
            sessions,
            config,
            executor=executor,
            out=options.out,
            jobs=options.jobs,
            memory_bytes=memory_bytes,
            shard=shard,
            retry=options.retry,
            write=writing,
            prepare=partial(import_plugins, plugins),
            progress=_Failures(bar),
        )
    failed = [row for row in done.rows if row.outcome == FAILED]
    converged = sum(row.outcome == CONVERGED for row in done.rows)
    for row in failed[:_SHOWN_FAILURES]:
        print(f"failed: {row.name}: {shorten(str(row.error), _LONGEST_ERROR, placeholder='...')}", file=sys.stderr)
    if len(failed) > _SHOWN_FAILURES:
        print(f"failed: {len(failed) - _SHOWN_FAILURES} more; {options.out / INDEX_FILE} says why", file=sys.stderr)
    print(f"{converged} of {len(done.rows)} converged, {len(failed)} failed; {options.out / INDEX_FILE} shows all")
    return EXIT_DONE if converged == len(done.rows) else EXIT_NOT_CONVERGED


class _Failures:
    """Shows on a bar how many sessions are done, and how many of them failed."""

    def __init__(self, bar: Progress) -> None:
        self._bar, self._failed = bar, 0

    def __call__(self, done: int, total: int | None, row: SessionRow) -> None:
        self._failed += row.error is not None
        self._bar(done, total or 0, f"session {done} of {total}, {self._failed} failed: {row.name}")


@dataclass(frozen=True)
class _Stick:
    """What the options say of the stick of every session."""

    length_m: float | None = None
    sigma_m: float | None = None

    def __call__(self, observations: Observations) -> Observations:
        return with_stick(observations, self.length_m, self.sigma_m)


@dataclass(frozen=True)
class _Writing:
    """Writes the files that `calibrate` writes with the same options."""

    config: str
    files: ResultFiles
    world: str
    units: str | None
    set: tuple[str, ...] = ()

    def __call__(self, calibration: Calibration, folder: Path, provenance: dict[str, Any]) -> None:
        calibration, sentences = placed(calibration, world_of(self.world, self.units))
        provenance = provenance | made_with(self.config, self.set)
        if notes := [*provenance.get("notes", ()), *sentences]:
            provenance["notes"] = notes
        self.files(calibration, folder, provenance)


def _with_whole_path(world: str) -> str:
    """A frame of the world whose file is found from any folder."""
    kind, _, file = world.partition(" ")
    return f"{kind} {Path(file).absolute()}" if file else kind


def _bytes(text: str | None) -> int | None:
    """A size such as 8GB as bytes.

    Raises:
        CalibrationError: if it is none.
    """
    if text is None:
        return None
    size = _SIZE.fullmatch(text.strip())
    if size is None:
        raise CalibrationError("not a size", where="--memory", got=repr(text), expected="a size such as 8GB or 500MB")
    return int(float(size[1]) * _UNITS[size[2] or ""])


def _shard(text: str | None) -> tuple[int, int] | None:
    """A shard such as 1/4 as two numbers.

    Raises:
        CalibrationError: if it is none.
    """
    if text is None:
        return None
    shard = re.fullmatch(r"(\d{1,9})/(\d{1,9})", text.strip(), flags=re.ASCII)
    if shard is None:
        raise CalibrationError("not a shard", where="--shard", got=repr(text), expected="i/n with i from 1 to n, such as 1/4")
    return int(shard[1]), int(shard[2])
