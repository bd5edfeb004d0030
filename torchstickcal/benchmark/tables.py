"""The measurements as tables, next to the paper's: pure functions of rows."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean, median, variance

from torchstickcal.benchmark.methods import METHODS
from torchstickcal.benchmark.published import (
    ABLATION,
    INPUTS,
    MEDIAN_SECONDS,
    MEMORY_MB,
    NOT_RUN,
    REASONS,
    STATE_OF_THE_ART,
    Errors,
)
from torchstickcal.benchmark.run import CONVERGED, LACKS_INPUT, Row

SUCCESS_BOUNDS = 3.0
"""A calibration succeeds with rotation and translation errors of at most so many times the bound."""

_NOTABLE = 1.3
_SOTA = (
    "aruco_cube", "calib_person", "calib_person_in_motion", "extra_calib", "extra_calib_in_motion", "kineo", "kineo_in_motion",
    "ewand", "paper", "lbfgs", "default",
)  # fmt: skip
_INPUTS = {
    "human_height": ("human_height",),
    "human_height_in_motion": ("human_height_in_motion",),
    "human_guessed": ("human_guessed_low", "human_guessed_high"),
    "human_only": ("human_only",),
    "human_bones": ("human_bones",),
    "stick_only": ("stick_only",),
    "paper": ("paper",),
    "default": ("default",),
}
_ABLATION = ("paper", "without_length", "without_smoothness", "default")
_PROFILED = ("default", "paper")

Cell = str | int | float | None


@dataclass(frozen=True)
class Table:
    """A table; what is not known is None."""

    name: str
    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    note: str = ""


def tables(rows: Sequence[Row]) -> list[Table]:
    """All tables that the rows fill, in the order of the page."""
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


def state_of_the_art(rows: Sequence[Row]) -> Table:
    """Mean errors of all methods, next to the paper's; methods that were not run with a sentence and the paper's figure."""
    found: list[tuple[Cell, ...]] = []
    for name in _SOTA:
        if of := _of(rows, name):
            found.append((_title(name), *_means(of), *_paper(STATE_OF_THE_ART.get(name)), _solved(of)))
    if found:
        found += [
            (f"{name}: not run, needs images and trained weights", None, None, *_paper(errors), None)
            for name, errors in NOT_RUN.items()
        ]
    header = ("method", "rotation (deg)", "translation (mm)", "paper: rotation (deg)", "paper: translation (mm)", "sessions")
    return Table(
        "sota",
        "Comparison of methods",
        header,
        tuple(found),
        _reasons(rows, {name: (name,) for name in _SOTA}, STATE_OF_THE_ART),
    )


def inputs(rows: Sequence[Row]) -> Table:
    """Mean errors and their variances by what is used: the athlete, the stick, or both."""
    found: list[tuple[Cell, ...]] = []
    for name, methods in _INPUTS.items():
        if of := _of(rows, *methods):
            paper = INPUTS.get(name)
            scatter = (None, None) if paper is None else (paper.rotation_scatter, _mm(paper.translation_scatter))
            title = "Human, stature - 0.1 m and + 0.1 m" if name == "human_guessed" else _title(name)
            found.append((title, *_means(of), *_variances(of), *_deviations(of), *_paper(paper), *scatter))
    header = (
        "inputs", "rotation (deg)", "translation (mm)", "variance (deg²)", "variance (mm²)", "std (deg)", "std (mm)",
        "paper: rotation (deg)", "paper: translation (mm)", "paper: variance (deg)", "paper: variance (mm)",
    )  # fmt: skip
    note = "What the paper calls variances has the size and the unit of standard deviations. " + _reasons(rows, _INPUTS, INPUTS)
    return Table("inputs", "Input variants", header, tuple(found), note)


def ablation(rows: Sequence[Row]) -> Table:
    """Mean errors of the published method without a term of its stage 3."""
    found = [(_title(name), *_means(of), *_paper(ABLATION.get(name))) for name in _ABLATION if (of := _of(rows, name))]
    header = ("configuration", "rotation (deg)", "translation (mm)", "paper: rotation (deg)", "paper: translation (mm)")
    note = _reasons(rows, {name: (name,) for name in _ABLATION}, ABLATION)
    return Table("ablation", "Components of stage 3", header, tuple(found), note)


def run_time(rows: Sequence[Row]) -> Table:
    """Median and longest time of a calibration by number of cameras, seconds."""
    found: list[tuple[Cell, ...]] = []
    for cameras in _values(rows, lambda row: row.cameras):
        times = [_seconds(row for row in _of(rows, name) if row.cameras == cameras) for name in _PROFILED]
        if any(times):
            figures = [figure for t in times for figure in ((median(t), max(t)) if t else (None, None))]
            found.append((cameras, *figures, MEDIAN_SECONDS.get(cameras)))
    columns = [f"`{name}`: {kind} (s)" for name in _PROFILED for kind in ("median", "longest")]
    note = "Keypoints to result, one thread. The paper's longest takes 102 s; its machine is another."
    return Table("run_time", "Run time", ("cameras", *columns, "paper: median (s)"), tuple(found), note)


def memory(rows: Sequence[Row]) -> Table:
    """Peak memory by number of cameras, megabytes: of the process over that before the call, and of torch's tensors."""
    found: list[tuple[Cell, ...]] = []
    for cameras in _values(rows, lambda row: row.cameras):
        of = [row for row in _of(rows, "default") if row.cameras == cameras and row.peak_tensor_bytes is not None]
        if of:
            resident = [row.peak_resident_bytes for row in of if row.peak_resident_bytes is not None]
            tensors = [row.peak_tensor_bytes for row in of if row.peak_tensor_bytes is not None]
            ours = (median(row.input_bytes for row in of), *_typical_and_worst(resident), *_typical_and_worst(tensors))
            megabytes = (None if figure is None else figure / 1e6 for figure in ours)
            found.append((cameras, *megabytes, *MEMORY_MB.get(cameras, (None, None, None))))
    header = (
        "cameras", "input", "process: typical", "process: worst", "tensors: typical", "tensors: worst",
        "paper: input", "paper: typical", "paper: worst",
    )  # fmt: skip
    note = "Megabytes, of `default`, beyond what is there before the call. The paper's are of its last adjustment alone."
    return Table("memory", "Memory", header, tuple(found), note)


def efficiency(rows: Sequence[Row]) -> Table:
    """Mean errors over mean bounds: 1 is the statistical limit."""
    found: list[tuple[Cell, ...]] = []
    for name in METHODS:
        of = [row for row in _of(rows, name) if row.bound_rotation_deg is not None]
        if of:
            rotation, translation = _means(of)
            bound = (_mean(row.bound_rotation_deg for row in of), _mm(_mean(row.bound_translation_m for row in of)))
            shares = (_ratio(rotation, bound[0]), _ratio(translation, bound[1]))
            found.append((_title(name), *shares, rotation, translation, *bound, _solved(of)))
    header = (
        "method", "rotation: error / bound", "translation: error / bound", "rotation (deg)", "translation (mm)",
        "bound: rotation (deg)", "bound: translation (mm)", "sessions",
    )  # fmt: skip
    note = (
        "The Cramér-Rao bound is for those who use all inliers, joints and stick, and know their noise and the stick's length "
        "exactly. It is not the bound of methods that know something else: a cube, the true height, the true bones. "
        "The mean of a sample can lie a little below 1."
    )
    return Table("efficiency", "Efficiency", header, tuple(found), note)


def success(rows: Sequence[Row], label: str, key: Callable[[Row], str]) -> Table:
    """The share of sessions that a method calibrates with errors of at most 3 times the bound, by regime or otherwise."""
    bounded = [row for row in rows if row.bound_rotation_deg is not None and row.outcome != LACKS_INPUT]
    groups = sorted({key(row) for row in bounded}, key=lambda group: (len(group), group))
    found: list[tuple[Cell, ...]] = []
    for name in METHODS:
        of = [row for row in bounded if row.method == name]
        if of:
            shares = [_mean(float(succeeds(row)) for row in of if key(row) == group) for group in groups]
            found.append((_title(name), *(None if share is None else f"{share:.0%}" for share in shares)))
    title = f"Success by {label}"
    note = f"Rotation and translation errors of at most {SUCCESS_BOUNDS:g} times the bound of the inliers."
    return Table(f"success_by_{label}", title, ("method", *groups), tuple(found), note)


def by_cameras(rows: Sequence[Row]) -> Table:
    """The effect of the number of cameras on `default`."""
    found = _by(_of(rows, "default"), lambda row: row.cameras)
    return Table("cameras", "Effect of the number of cameras", ("cameras", *_EFFECT), found, "Of `default`.")


def by_frames(rows: Sequence[Row]) -> Table:
    """The effect of the number of frames on `default`, given the sessions' first frames or whole sessions."""
    found = _by(_of(rows, *_LENGTHS), lambda row: row.frames)
    return Table("frames", "Effect of the number of frames", ("frames", *_EFFECT), found, "Of `default`, on the first frames.")


def failures(rows: Sequence[Row]) -> Table:
    """What did not converge, or failed, with what the method says about it."""
    said: dict[tuple[str, str, str], int] = {}
    for row in rows:
        if row.outcome != CONVERGED:
            key = (_title(row.method), row.outcome, row.status)
            said[key] = said.get(key, 0) + 1
    found = tuple((*key, count) for key, count in said.items())
    return Table("failures", "What did not converge", ("method", "outcome", "status", "sessions"), found)


def succeeds(row: Row) -> bool:
    """Whether both errors of a row with a bound are at most 3 times it."""
    if (
        row.rotation_deg is None
        or row.translation_m is None
        or row.bound_rotation_deg is None
        or row.bound_translation_m is None
    ):
        return False
    rotation, translation = row.rotation_deg / row.bound_rotation_deg, row.translation_m / row.bound_translation_m
    return max(rotation, translation) <= SUCCESS_BOUNDS


_EFFECT = (
    "rotation (deg)", "translation (mm)", "bound: rotation (deg)", "bound: translation (mm)", "time, median (s)", "sessions",
)  # fmt: skip
_LENGTHS = tuple(name for name in METHODS if name == "default" or METHODS[name].frames is not None)


def _by(rows: Sequence[Row], key: Callable[[Row], int]) -> tuple[tuple[Cell, ...], ...]:
    found: list[tuple[Cell, ...]] = []
    for value in _values(rows, key):
        of = [row for row in rows if key(row) == value]
        bound = (_mean(row.bound_rotation_deg for row in of), _mm(_mean(row.bound_translation_m for row in of)))
        times = _seconds(of)
        found.append((value, *_means(of), *bound, median(times) if times else None, _solved(of)))
    return tuple(found)


def _of(rows: Iterable[Row], *methods: str) -> list[Row]:
    """The rows of some methods, those left out for which an input is lacking."""
    return [row for row in rows if row.method in methods and row.outcome != LACKS_INPUT]


def _values(rows: Iterable[Row], key: Callable[[Row], int]) -> list[int]:
    return sorted({key(row) for row in rows} - {0})


def _means(rows: Sequence[Row]) -> tuple[float | None, float | None]:
    """Mean rotation error, degrees, and translation error, millimetres, of the sessions that were calibrated."""
    return _mean(row.rotation_deg for row in rows), _mm(_mean(row.translation_m for row in rows))


def _variances(rows: Sequence[Row]) -> tuple[float | None, float | None]:
    rotations = [row.rotation_deg for row in rows if row.rotation_deg is not None]
    translations = [1000 * row.translation_m for row in rows if row.translation_m is not None]
    return (variance(rotations), variance(translations)) if len(rotations) > 1 else (None, None)


def _deviations(rows: Sequence[Row]) -> tuple[float | None, ...]:
    return tuple(None if square is None else math.sqrt(square) for square in _variances(rows))


def _mean(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return fmean(known) if known else None


def _mm(metres: float | None) -> float | None:
    return None if metres is None else 1000 * metres


def _ratio(value: float | None, reference: float | None) -> float | None:
    return None if value is None or not reference else value / reference


def _seconds(rows: Iterable[Row]) -> list[float]:
    return [row.seconds for row in rows if row.seconds is not None]


def _typical_and_worst(values: Sequence[int]) -> tuple[float | None, float | None]:
    return (median(values), max(values)) if values else (None, None)


def _solved(rows: Sequence[Row]) -> str:
    return f"{sum(row.rotation_deg is not None for row in rows)} of {len(rows)}"


def _title(name: str) -> str:
    return METHODS[name].title if name in METHODS else name


def _paper(errors: Errors | None) -> tuple[float | None, float | None]:
    return (None, None) if errors is None else (errors.rotation_deg, _mm(errors.translation_m))


def _reasons(rows: Sequence[Row], methods: Mapping[str, tuple[str, ...]], published: Mapping[str, Errors]) -> str:
    """Why rows are more than 30 % off the paper's."""
    said: dict[str, list[str]] = {}
    for name in methods.keys() & published.keys():
        ours, theirs = _means(_of(rows, *methods[name])), _paper(published[name])
        off = [o / t for o, t in zip(ours, theirs, strict=True) if o is not None and t is not None]
        if any(not 1 / _NOTABLE <= ratio <= _NOTABLE for ratio in off):
            for reason in REASONS.get(name, ()):
                said.setdefault(reason, []).append(name)
    order = list(methods)
    sentences = (f"[{', '.join(sorted(names, key=order.index))}] {reason}" for reason, names in sorted(said.items()))
    return f"More than 30 % off the paper, why: {' '.join(sentences)}" if said else ""
