"""The tables of the benchmark, beside the figures of the paper. All are pure functions of the measured rows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from statistics import median

from torchstickcal.benchmark.comparison import ablation, inputs, state_of_the_art
from torchstickcal.benchmark.methods import METHODS
from torchstickcal.benchmark.published import MEDIAN_SECONDS, MEMORY_MB
from torchstickcal.benchmark.run import CONVERGED, LACKS_INPUT, Row
from torchstickcal.benchmark.summary import (
    Cell,
    Table,
    distinct,
    mean,
    mean_bounds,
    mean_errors,
    ratio,
    rows_of,
    seconds_of,
    solved,
    title_of,
)

SUCCESS_BOUNDS = 3.0
"""A calibration succeeds if its rotation and translation errors are at most this many times the bound."""

_EFFECT = (
    "rotation (deg)", "translation (mm)", "bound: rotation (deg)", "bound: translation (mm)", "time, median (s)", "sessions",
)  # fmt: skip


def tables(rows: Sequence[Row]) -> list[Table]:
    """All tables for which something was measured, in the order of the page."""
    made = [
        state_of_the_art(rows),
        inputs(rows),
        ablation(rows),
        run_time(rows),
        memory(rows),
        efficiency(rows),
        success(rows, "regime", lambda row: row.regime),
        success(rows, "cameras", lambda row: str(row.cameras)),
        by_cameras(rows),
        by_frames(rows),
        failures(rows),
    ]
    return [table for table in made if table.rows]


def run_time(rows: Sequence[Row]) -> Table:
    """Median and maximum run time of a calibration by number of cameras, seconds."""
    profiled = [name for name, method in METHODS.items() if method.profiled]
    cells: list[tuple[Cell, ...]] = []
    for cameras in distinct(rows, lambda row: row.cameras):
        times = [seconds_of(row for row in rows_of(rows, name) if row.cameras == cameras) for name in profiled]
        if any(times):
            figures = [figure for t in times for figure in ((median(t), max(t)) if t else (None, None))]
            cells.append((cameras, *figures, MEDIAN_SECONDS.get(cameras)))
    columns = [f"`{name}`: {kind} (s)" for name in profiled for kind in ("median", "maximum")]
    note = (
        "From keypoints to result, with one thread. The maximum in the paper is 102 s; it was measured on a different machine."
    )
    return Table("run_time", "Run time", ("cameras", *columns, "paper: median (s)"), tuple(cells), note)


def memory(rows: Sequence[Row]) -> Table:
    """Peak memory by number of cameras, megabytes: of the process beyond that before the call, and of torch's tensors."""
    cells: list[tuple[Cell, ...]] = []
    for cameras in distinct(rows, lambda row: row.cameras):
        of = [row for row in rows_of(rows, "default") if row.cameras == cameras and row.peak_tensor_bytes is not None]
        if of:
            resident = [row.peak_resident_bytes for row in of if row.peak_resident_bytes is not None]
            tensors = [row.peak_tensor_bytes for row in of if row.peak_tensor_bytes is not None]
            ours = (median(row.input_bytes for row in of), *_median_and_maximum(resident), *_median_and_maximum(tensors))
            megabytes = (None if figure is None else figure / 1e6 for figure in ours)
            cells.append((cameras, *megabytes, *MEMORY_MB.get(cameras, (None, None, None))))
    header = (
        "cameras", "input", "process: median", "process: maximum", "tensors: median", "tensors: maximum",
        "paper: input", "paper: typical", "paper: worst",
    )  # fmt: skip
    note = (
        "Megabytes that a calibration with `default` needs in addition to what is in memory before the call. The paper's "
        "figures are for its last adjustment alone."
    )
    return Table("memory", "Memory", header, tuple(cells), note)


def efficiency(rows: Sequence[Row]) -> Table:
    """Mean errors divided by mean bounds; 1 is the statistical limit."""
    cells: list[tuple[Cell, ...]] = []
    for name, method in METHODS.items():
        of = [row for row in rows_of(rows, name) if row.bound_rotation_deg is not None]
        if of:
            errors, bounds = mean_errors(of), mean_bounds(of)
            ratios = (ratio(errors[0], bounds[0]), ratio(errors[1], bounds[1]))
            cells.append((method.title, *ratios, *errors, *bounds, solved(of)))
    header = (
        "method", "rotation: error / bound", "translation: error / bound", "rotation (deg)", "translation (mm)",
        "bound: rotation (deg)", "bound: translation (mm)", "sessions",
    )  # fmt: skip
    note = (
        "The Cramér-Rao bound is the smallest mean error of an unbiased method that uses all inliers of joints and stick and "
        "knows their noise and the length of the stick exactly. It does not apply to methods that use other information: a "
        "cube, the true height, true bone lengths. Because the mean is over a sample of sessions, the ratio can be slightly "
        "below 1."
    )
    return Table("efficiency", "Efficiency", header, tuple(cells), note)


def success(rows: Sequence[Row], label: str, key: Callable[[Row], str]) -> Table:
    """Share of the sessions that a method calibrates with errors of at most 3 times the bound.

    Args:
        rows: all measured rows.
        label: what distinguishes the columns, for the title.
        key: the column of a row.
    """
    bounded = [row for row in rows if row.bound_rotation_deg is not None and row.outcome != LACKS_INPUT]
    groups = sorted({key(row) for row in bounded}, key=lambda group: (len(group), group))
    cells: list[tuple[Cell, ...]] = []
    for name, method in METHODS.items():
        of = [row for row in bounded if row.method == name]
        if of:
            shares = [mean(float(succeeds(row)) for row in of if key(row) == group) for group in groups]
            cells.append((method.title, *(None if share is None else f"{100 * share:.0f} %" for share in shares)))
    note = (
        f"Share of the sessions in which rotation and translation error are at most {SUCCESS_BOUNDS:g} times the Cramér-Rao "
        "bound."
    )
    return Table(f"success_by_{label}", f"Success by {label}", ("method", *groups), tuple(cells), note)


def by_cameras(rows: Sequence[Row]) -> Table:
    """Errors of `default` by the number of cameras."""
    cells = _by(rows_of(rows, "default"), lambda row: row.cameras)
    return Table("cameras", "Effect of the number of cameras", ("cameras", *_EFFECT), cells, "Configuration `default`.")


def by_frames(rows: Sequence[Row]) -> Table:
    """Errors of `default` by the number of frames: complete sessions, and their first frames."""
    methods = [name for name, method in METHODS.items() if name == "default" or method.frames is not None]
    cells = _by(rows_of(rows, *methods), lambda row: row.frames)
    note = "Configuration `default` on the first frames of the sessions."
    return Table("frames", "Effect of the number of frames", ("frames", *_EFFECT), cells, note)


def failures(rows: Sequence[Row]) -> Table:
    """Sessions that did not converge, failed, or lack an input, with the status that the method gives."""
    counts: dict[tuple[str, str, str], int] = {}
    for row in rows:
        if row.outcome != CONVERGED:
            key = (row.method, row.outcome, row.status)
            counts[key] = counts.get(key, 0) + 1
    cells = tuple((title_of(method), outcome, status, count) for (method, outcome, status), count in counts.items())
    return Table("failures", "Failures", ("method", "outcome", "status", "sessions"), cells)


def succeeds(row: Row) -> bool:
    """Whether both errors of a row are known and at most 3 times the bound."""
    if (
        row.rotation_deg is None
        or row.translation_m is None
        or row.bound_rotation_deg is None
        or row.bound_translation_m is None
    ):
        return False
    rotation, translation = row.rotation_deg / row.bound_rotation_deg, row.translation_m / row.bound_translation_m
    return max(rotation, translation) <= SUCCESS_BOUNDS


def _by(rows: Sequence[Row], key: Callable[[Row], int]) -> tuple[tuple[Cell, ...], ...]:
    """A row of means for each value of a key."""
    cells: list[tuple[Cell, ...]] = []
    for value in distinct(rows, key):
        of = [row for row in rows if key(row) == value]
        times = seconds_of(of)
        cells.append((value, *mean_errors(of), *mean_bounds(of), median(times) if times else None, solved(of)))
    return tuple(cells)


def _median_and_maximum(values: Sequence[int]) -> tuple[float | None, float | None]:
    return (median(values), max(values)) if values else (None, None)
