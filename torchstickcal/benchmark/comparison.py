"""The tables that have a counterpart in the paper: comparison of methods, input variants, ablation of the last stage."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from torchstickcal.benchmark.baselines import PublishedErrors
from torchstickcal.benchmark.baselines.base import ComparisonTable
from torchstickcal.benchmark.methods import METHODS
from torchstickcal.benchmark.published import NOT_RUN
from torchstickcal.benchmark.run import Row
from torchstickcal.benchmark.summary import Cell, Table, deviations, mean_errors, millimetres, rows_of, solved, variances

_NOTABLE_RATIO = 1.3


class _Line(NamedTuple):
    """A row of a table: the measured rows of one method, or of several that share it."""

    title: str
    rows: list[Row]
    published: PublishedErrors | None
    reasons: tuple[str, ...]

    @property
    def published_errors(self) -> tuple[float | None, float | None]:
        """Degrees and millimetres."""
        return _published(self.published)

    @property
    def differs(self) -> bool:
        """Whether an error differs from the published one by more than 30 %."""
        pairs = zip(mean_errors(self.rows), self.published_errors, strict=True)
        ratios = [ours / theirs for ours, theirs in pairs if ours is not None and theirs is not None]
        return any(not 1 / _NOTABLE_RATIO <= ratio <= _NOTABLE_RATIO for ratio in ratios)


def state_of_the_art(rows: Sequence[Row]) -> Table:
    """Mean errors of the methods beside the published ones; methods that cannot be run, with the published errors alone."""
    lines = _lines(rows, "sota")
    cells: list[tuple[Cell, ...]] = [
        (line.title, *mean_errors(line.rows), *line.published_errors, solved(line.rows)) for line in lines
    ]
    if cells:
        cells += [
            (f"{name}: not run, needs images and trained weights", None, None, *_published(errors), None)
            for name, errors in NOT_RUN.items()
        ]
    header = ("method", "rotation (deg)", "translation (mm)", "paper: rotation (deg)", "paper: translation (mm)", "sessions")
    return Table("sota", "Comparison of methods", header, tuple(cells), _reasons(lines))


def inputs(rows: Sequence[Row]) -> Table:
    """Mean errors and their variation between sessions by what is used: the athlete, the stick, or both."""
    lines = _lines(rows, "inputs")
    cells = tuple(
        (
            line.title,
            *mean_errors(line.rows),
            *variances(line.rows),
            *deviations(line.rows),
            *line.published_errors,
            *_published_variation(line.published),
        )
        for line in lines
    )
    header = (
        "inputs", "rotation (deg)", "translation (mm)", "variance (deg²)", "variance (mm²)", "std (deg)", "std (mm)",
        "paper: rotation (deg)", "paper: translation (mm)", "paper: variance (deg)", "paper: variance (mm)",
    )  # fmt: skip
    note = "What the paper calls variances has the size and the unit of standard deviations. " + _reasons(lines)
    return Table("inputs", "Input variants", header, cells, note)


def ablation(rows: Sequence[Row]) -> Table:
    """Mean errors of the published method without single terms of its last stage."""
    lines = _lines(rows, "ablation")
    cells = tuple((line.title, *mean_errors(line.rows), *line.published_errors) for line in lines)
    header = ("configuration", "rotation (deg)", "translation (mm)", "paper: rotation (deg)", "paper: translation (mm)")
    return Table("ablation", "Ablation of the last stage", header, cells, _reasons(lines))


def _lines(rows: Sequence[Row], table: ComparisonTable) -> list[_Line]:
    """The rows of a table for which something was measured, by the positions of the methods."""
    listed = [(name, method.listing) for name, method in METHODS.items() if table in method.listing.tables]
    listed.sort(key=lambda entry: entry[1].position)
    sharing: dict[str, list[str]] = {}
    for name, listing in listed:
        sharing.setdefault(listing.row or listing.title, []).append(name)
    listings = dict(listed)
    return [
        _Line(title, of, listings[names[0]].tables[table], listings[names[0]].reasons)
        for title, names in sharing.items()
        if (of := rows_of(rows, *names))
    ]


def _reasons(lines: Sequence[_Line]) -> str:
    """Why errors differ from the published ones by more than 30 %."""
    titles: dict[str, list[str]] = {}
    for line in lines:
        for reason in line.reasons if line.differs else ():
            titles.setdefault(reason, []).append(line.title)
    sentences = (f"[{'; '.join(of)}] {reason}" for reason, of in sorted(titles.items()))
    return f"Why errors differ from the paper's by more than 30 %: {' '.join(sentences)}" if titles else ""


def _published(errors: PublishedErrors | None) -> tuple[float | None, float | None]:
    """Published errors, degrees and millimetres."""
    return (None, None) if errors is None else (errors.rotation_deg, millimetres(errors.translation_m))


def _published_variation(errors: PublishedErrors | None) -> tuple[float | None, float | None]:
    """Published variation between sessions, degrees and millimetres."""
    return (None, None) if errors is None else (errors.rotation_variation_deg, millimetres(errors.translation_variation_m))
