"""Measuring every method on every case, so that what is interrupted can go on where it was."""

from __future__ import annotations

import json
import multiprocessing
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from functools import lru_cache, partial
from pathlib import Path

import torch

from torchstickcal.benchmark.baselines import Inputs, MissingInputError
from torchstickcal.benchmark.bound import Bound, camera_bound
from torchstickcal.benchmark.cases import Case, Source
from torchstickcal.benchmark.memory import input_bytes, memory_needed
from torchstickcal.benchmark.methods import METHODS
from torchstickcal.errors import CalibrationError, FileFormatError
from torchstickcal.metrics import pose_errors

ROWS_FILE = "rows.jsonl"
CONVERGED, NOT_CONVERGED, FAILED, LACKS_INPUT = "converged", "not converged", "failed", "lacks an input"


@dataclass(frozen=True)
class Row:
    """A method on a case."""

    place: str
    case: str
    regime: str
    cameras: int
    frames: int
    noise_px: float | None
    method: str
    outcome: str
    """``converged``, ``not converged`` (with the poses it stopped at), ``failed``, or ``lacks an input``"""
    status: str
    """what the method says about it"""
    rotation_deg: float | None
    translation_m: float | None
    """mean camera errors, None where there is no pose of every camera"""
    bound_rotation_deg: float | None
    bound_translation_m: float | None
    seconds: float | None
    """of the call alone, on one thread"""
    input_bytes: int
    peak_resident_bytes: int | None
    peak_tensor_bytes: int | None
    """what a call needs beyond its input, where it was measured"""


Progress = Callable[[int, int, str], None]
"""Told how many of how many measurements are done, and what was the last."""


def run_benchmark(
    place: str, cases: Sequence[Source], methods: Sequence[str], out: Path, jobs: int = 1, progress: Progress | None = None
) -> list[Row]:
    """Measure what the folder ``out`` does not hold yet; every measurement is in its file before the next one counts.

    Args:
        place: what the cases are called together.
        cases: where they come from; those without truth are passed over.
        methods: their names.
        out: the folder, made if need be.
        jobs: processes, each with one thread.
        progress: is told after each measurement.

    Returns:
        The rows of these cases and methods, in their order, measured now or before.

    Raises:
        CalibrationError: if ``out`` holds measurements of another place, or jobs are fewer than 1.
    """
    if jobs < 1:
        raise CalibrationError("no process to measure in", where="--jobs", got=jobs, expected="1 or more")
    out.mkdir(parents=True, exist_ok=True)
    file = out / ROWS_FILE
    known = {(row.case, row.method): row for row in read_rows(file)}
    places = {row.place for row in known.values()} - {place}
    if places:
        raise CalibrationError(
            "the folder holds another benchmark's results", where=str(out), got=", ".join(sorted(places)), expected=place
        )
    wanted = [(source, name) for source in cases for name in methods]
    missing = [(source, name) for source, name in wanted if (source.name, name) not in known]
    with file.open("a", encoding="utf-8") as stream:
        for done, row in enumerate(_measured(place, missing, jobs), len(wanted) - len(missing) + 1):
            if row is not None:
                known[row.case, row.method] = row
                stream.write(json.dumps(asdict(row)) + "\n")
                stream.flush()
            if progress:
                progress(done, len(wanted), f"{row.case} {row.method}" if row else "without truth")
    return [known[source.name, name] for source, name in wanted if (source.name, name) in known]


def read_rows(file: Path) -> list[Row]:
    """The rows of a file; a last line that was cut off is removed from it.

    Raises:
        FileFormatError: if another line is not a row.
    """
    if not file.exists():
        return []
    content = file.read_bytes()
    whole = content[: content.rfind(b"\n") + 1]
    if len(whole) < len(content):
        file.write_bytes(whole)
    try:
        return [Row(**json.loads(line)) for line in whole.splitlines()]
    except (ValueError, TypeError) as error:
        raise FileFormatError("not a file of measurements", where=str(file), got=str(error), expected="rows") from error


def measure(place: str, source: Source, name: str) -> Row | None:
    """One method on one case; None if the case carries no truth. Whatever a method raises is its failure, not the run's."""
    method = METHODS[name]
    try:
        loaded = _loaded(source, method.frames)
    except CalibrationError as error:
        return _unreadable(place, source, name, error)
    if loaded is None:
        return None
    case, bound = loaded
    seconds = needed = errors = None
    try:
        inputs = method.inputs(case)
        _warm_up(name, inputs)
        began = time.perf_counter()
        estimate = method.estimate(inputs)
        seconds = time.perf_counter() - began
        outcome, status = CONVERGED if estimate.status == "converged" else NOT_CONVERGED, estimate.status
        truth = case.truth
        if bool(estimate.translations.isfinite().all()):
            errors = pose_errors(estimate.rotations, estimate.translations, truth.rotations, truth.translations)
        else:
            outcome = FAILED
        needed = memory_needed(partial(method.estimate, inputs)) if method.profiled else None
    except MissingInputError as error:
        outcome, status = LACKS_INPUT, str(error)
    except Exception as error:
        outcome, status = FAILED, f"{type(error).__name__}: {error}".splitlines()[0]
    return Row(
        place=place,
        case=case.name,
        regime=case.regime,
        cameras=case.observations.num_cameras,
        frames=case.observations.num_frames,
        noise_px=case.noise_px,
        method=name,
        outcome=outcome,
        status=status,
        rotation_deg=errors.mean_rotation_deg if errors else None,
        translation_m=errors.mean_translation_m if errors else None,
        bound_rotation_deg=bound.rotation_deg if bound else None,
        bound_translation_m=bound.translation_m if bound else None,
        seconds=seconds,
        input_bytes=input_bytes(case.observations),
        peak_resident_bytes=needed.resident_bytes if needed else None,
        peak_tensor_bytes=needed.tensor_bytes if needed else None,
    )


def _measured(place: str, missing: Sequence[tuple[Source, str]], jobs: int) -> Iterator[Row | None]:
    if jobs == 1 or not missing:
        threads = torch.get_num_threads()
        torch.set_num_threads(1)
        try:
            yield from (measure(place, source, name) for source, name in missing)
        finally:
            torch.set_num_threads(threads)
        return
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(jobs, len(missing)), context, initializer=torch.set_num_threads, initargs=(1,)) as pool:
        try:
            for future in as_completed([pool.submit(measure, place, source, name) for source, name in missing]):
                yield future.result()
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


@lru_cache(maxsize=4)
def _loaded(source: Source, frames: int | None) -> tuple[Case, Bound | None] | None:
    """A case with its bound; the methods of a case come one after another."""
    case = source.load()
    if case is None:
        return None
    case = case if frames is None else case.first(frames)
    return case, camera_bound(case)


_warm: set[str] = set()


def _warm_up(name: str, inputs: Inputs) -> None:
    """The first call in a process pays for what is loaded and compiled; it is not timed."""
    if name not in _warm:
        METHODS[name].estimate(inputs)
        _warm.add(name)


def _unreadable(place: str, source: Source, name: str, error: CalibrationError) -> Row:
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
