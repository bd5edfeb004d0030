"""Measurement of every method on every case. A run that was interrupted continues where it stopped."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import as_completed
from dataclasses import asdict, dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import NamedTuple

import torch

from torchstickcal.benchmark.baselines import Estimate, Inputs, MissingInputError
from torchstickcal.benchmark.bound import Bound, camera_bound
from torchstickcal.benchmark.cases import Case, Source
from torchstickcal.benchmark.memory import Memory, input_bytes, memory_needed
from torchstickcal.benchmark.methods import EXTERNAL, Method, method
from torchstickcal.errors import CalibrationError, FileFormatError
from torchstickcal.files import json_text
from torchstickcal.metrics import PoseErrors, pose_errors
from torchstickcal.processes import WorkerProcesses
from torchstickcal.untrusted import read_bytes, row_of

ROWS_FILE = "rows.jsonl"
_JOBS_PER_PROCESSOR = 8
CONVERGED, NOT_CONVERGED, FAILED, LACKS_INPUT = "converged", "not converged", "failed", "lacks an input"


@dataclass(frozen=True)
class Row:
    """The measurement of one method on one case."""

    place: str
    """name of the set of cases"""
    case: str
    regime: str
    cameras: int
    frames: int
    noise_px: float | None
    method: str
    outcome: str
    """``converged``, ``not converged`` (the errors are those of the last poses), ``failed``, or ``lacks an input``"""
    status: str
    """``converged``, or why not"""
    rotation_deg: float | None
    translation_m: float | None
    """mean errors of the cameras; None unless the pose of every camera was estimated"""
    bound_rotation_deg: float | None
    bound_translation_m: float | None
    """Cramér-Rao bounds of the mean errors"""
    seconds: float | None
    """run time of the method, on one thread"""
    input_bytes: int
    peak_resident_bytes: int | None
    peak_tensor_bytes: int | None
    """peak memory of a call in addition to its input; None if it was not measured"""


Progress = Callable[[int, int, str], None]
"""Called with the number of finished measurements, the number of all, and a description of the last one."""


def run_benchmark(
    place: str,
    cases: Sequence[Source],
    methods: Sequence[str],
    out: Path,
    jobs: int = 1,
    progress: Progress | None = None,
    prepare: Callable[[], object] | None = None,
) -> list[Row]:
    """Measure methods on cases, except for what the folder ``out`` already holds. Poses from elsewhere are compared each time.

    Each measurement is written to a file in ``out`` at once, so that an interrupted run can be repeated and continues.

    Args:
        place: name of the set of cases.
        cases: their sources; cases without truth are skipped.
        methods: names of the methods.
        out: folder of the results; created if it does not exist.
        jobs: number of processes, each with one thread.
        progress: called after each measurement.
        prepare: with more than one process, called first in each of them: it imports the modules that register losses, sports
            or baselines of your own, for example ``functools.partial(importlib.import_module, "my_baselines")``.

    Returns:
        The rows of these cases and methods, in their order, measured now or earlier.

    Raises:
        CalibrationError: if ``out`` holds measurements of another set of cases, for an unknown method, or if ``jobs`` is less
            than 1 or more than 8 per processor.

    Example:
        >>> import pathlib, tempfile
        >>> from torchstickcal.benchmark import run_benchmark, sources
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     cases = sources("sports-stick-syn", 1)
        ...     rows = run_benchmark("sports-stick-syn", cases, ["default", "ewand"], pathlib.Path(folder))
        >>> [(row.method, row.outcome, row.translation_m < 0.01) for row in rows]
        [('default', 'converged', True), ('ewand', 'converged', True)]
    """
    most = _JOBS_PER_PROCESSOR * (os.cpu_count() or 1)
    if not 1 <= jobs <= most:
        what = "no process to measure in" if jobs < 1 else "more processes than this machine can run"
        raise CalibrationError(what, where="--jobs", got=jobs, expected=f"1 to {most}")
    for name in methods:
        method(name)
    out.mkdir(parents=True, exist_ok=True)
    file = out / ROWS_FILE
    known = {(row.case, row.method): row for row in read_rows(file) if row.method not in EXTERNAL}
    places = {row.place for row in known.values()} - {place}
    if places:
        raise CalibrationError(
            "the folder holds results of another benchmark", where=str(out), got=", ".join(sorted(places)), expected=place
        )
    wanted = [(source, name) for source in cases for name in methods]
    missing = [(source, name) for source, name in wanted if (source.name, name) not in known]
    with file.open("a", encoding="utf-8") as stream:
        for done, row in enumerate(_measured(place, missing, jobs, prepare), len(wanted) - len(missing) + 1):
            if row is not None:
                known[row.case, row.method] = row
                stream.write(json_text(asdict(row), indent=False) + "\n")
                stream.flush()
            if progress:
                progress(done, len(wanted), f"{row.case} {row.method}" if row else "skipped: no truth")
    return [known[source.name, name] for source, name in wanted if (source.name, name) in known]


def read_rows(file: Path) -> list[Row]:
    """The rows of a file. An incomplete last line, of a run that was interrupted, is removed from the file.

    Raises:
        FileFormatError: if a line is not a row.
    """
    if not file.exists():
        return []
    content = read_bytes(file)
    whole = content[: content.rfind(b"\n") + 1]
    if len(whole) < len(content):
        file.write_bytes(whole)
    try:
        return [row_of(Row, json.loads(line)) for line in whole.splitlines()]
    except (ValueError, TypeError, RecursionError) as error:
        raise FileFormatError("not a file of measurements", where=str(file), got=str(error), expected="rows") from error


def measure(place: str, source: Source, name: str) -> Row | None:
    """Measure one method on one case; None if the case has no truth.

    Any exception that the method raises is reported in the row.
    """
    measured = method(name)
    try:
        loaded = _loaded(source, measured.frames)
    except CalibrationError as error:
        return _unreadable(place, source, name, error)
    if loaded is None:
        return None
    case, bound = loaded
    found = _called(name, measured, case)
    errors, needed = found.errors, found.needed
    return Row(
        place=place,
        case=case.name,
        regime=case.regime,
        cameras=case.observations.num_cameras,
        frames=case.observations.num_frames,
        noise_px=case.noise_px,
        method=name,
        outcome=found.outcome,
        status=found.status,
        rotation_deg=errors.mean_rotation_deg if errors else None,
        translation_m=errors.mean_translation_m if errors else None,
        bound_rotation_deg=bound.rotation_deg if bound else None,
        bound_translation_m=bound.translation_m if bound else None,
        seconds=found.seconds,
        input_bytes=input_bytes(case.observations),
        peak_resident_bytes=needed.resident_bytes if needed else None,
        peak_tensor_bytes=needed.tensor_bytes if needed else None,
    )


class _Result(NamedTuple):
    """The result of a call of a method: without errors if it failed."""

    outcome: str
    status: str
    seconds: float | None = None
    errors: PoseErrors | None = None
    needed: Memory | None = None


def _called(name: str, measured: Method, case: Case) -> _Result:
    """Call a method on a case, and compare its estimate with the truth."""
    seconds = None
    try:
        inputs = measured.inputs(case)
        _warm_up(name, measured, inputs)
        start = time.perf_counter()
        estimate = measured.estimate(inputs)
        seconds = time.perf_counter() - start if measured.timed else None
        outcome, errors = FAILED, None
        if bool(estimate.translations.isfinite().all()):
            outcome = CONVERGED if estimate.status == "converged" else NOT_CONVERGED
            errors = errors_of(estimate, case)
        needed = memory_needed(partial(measured.estimate, inputs)) if measured.profiled else None
        return _Result(outcome, estimate.status, seconds, errors, needed)
    except MissingInputError as error:
        return _Result(LACKS_INPUT, str(error))
    except Exception as error:
        return _Result(FAILED, f"{type(error).__name__}: {error}".splitlines()[0], seconds)


def errors_of(estimate: Estimate, case: Case) -> PoseErrors:
    """The errors of a method on a case; the size of the rig is fitted to the truth where the method does not say it."""
    alignment = "similarity" if estimate.up_to_scale else "rigid"
    truth = case.truth
    return pose_errors(estimate.rotations, estimate.translations, truth.rotations, truth.translations, alignment)


def _measured(
    place: str, missing: Sequence[tuple[Source, str]], jobs: int, prepare: Callable[[], object] | None
) -> Iterator[Row | None]:
    """The rows of cases and methods, as they are finished."""
    if jobs == 1 or not missing:
        threads = torch.get_num_threads()
        torch.set_num_threads(1)
        try:
            yield from (measure(place, source, name) for source, name in missing)
        finally:
            torch.set_num_threads(threads)
        return
    with WorkerProcesses(min(jobs, len(missing)), prepare) as processes:
        futures = [processes.submit(measure, place, source, name) for source, name in missing]
        for future in as_completed(futures):
            yield future.result()


@lru_cache(maxsize=4)
def _loaded(source: Source, frames: int | None) -> tuple[Case, Bound | None] | None:
    """A case with its bound; remembered, because the methods of a case are measured one after another."""
    case = source.load()
    if case is None:
        return None
    case = case if frames is None else case.first(frames)
    return case, camera_bound(case)


_warm: set[str] = set()


def _warm_up(name: str, measured: Method, inputs: Inputs) -> None:
    """Call a method once without timing it: the first call in a process loads and compiles code."""
    if name not in _warm:
        measured.estimate(inputs)
        _warm.add(name)


def _unreadable(place: str, source: Source, name: str, error: CalibrationError) -> Row:
    """The row of a case that cannot be read."""
    unknown = dict.fromkeys(
        ("noise_px", "rotation_deg", "translation_m", "bound_rotation_deg", "bound_translation_m", "seconds"), None
    )
    return Row(
        place=place,
        case=source.name,
        regime="-",
        cameras=0,
        frames=0,
        method=name,
        outcome=FAILED,
        status=f"{type(error).__name__}: {error}",
        input_bytes=0,
        peak_resident_bytes=None,
        peak_tensor_bytes=None,
        **unknown,
    )
