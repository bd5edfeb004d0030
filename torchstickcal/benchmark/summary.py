"""What the tables are made of: means and deviations of rows, and a table itself."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from statistics import fmean, variance

from torchstickcal.benchmark.methods import METHODS
from torchstickcal.benchmark.run import LACKS_INPUT, Row

Cell = str | int | float | None


@dataclass(frozen=True)
class Table:
    """A table. None is an empty cell."""

    name: str
    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    note: str = ""


def rows_of(rows: Iterable[Row], *methods: str) -> list[Row]:
    """The rows of some methods, without the sessions that lack an input of the method."""
    return [row for row in rows if row.method in methods and row.outcome != LACKS_INPUT]


def distinct(rows: Iterable[Row], key: Callable[[Row], int]) -> list[int]:
    """The different values of a key, in increasing order, without 0."""
    return sorted({key(row) for row in rows} - {0})


def mean_errors(rows: Sequence[Row]) -> tuple[float | None, float | None]:
    """Mean rotation error, degrees, and mean translation error, millimetres, of the sessions that were calibrated."""
    return mean(row.rotation_deg for row in rows), millimetres(mean(row.translation_m for row in rows))


def mean_bounds(rows: Sequence[Row]) -> tuple[float | None, float | None]:
    """Mean bounds of the rotation error, degrees, and of the translation error, millimetres."""
    return mean(row.bound_rotation_deg for row in rows), millimetres(mean(row.bound_translation_m for row in rows))


def variances(rows: Sequence[Row]) -> tuple[float | None, float | None]:
    """Variances of the rotation error, degrees^2, and of the translation error, millimetres^2, between sessions."""
    rotations = [row.rotation_deg for row in rows if row.rotation_deg is not None]
    translations = [1000 * row.translation_m for row in rows if row.translation_m is not None]
    return (variance(rotations), variance(translations)) if len(rotations) > 1 else (None, None)


def deviations(rows: Sequence[Row]) -> tuple[float | None, ...]:
    """Standard deviations of the rotation error, degrees, and of the translation error, millimetres, between sessions."""
    return tuple(None if square is None else math.sqrt(square) for square in variances(rows))


def seconds_of(rows: Iterable[Row]) -> list[float]:
    """Run times, seconds."""
    return [row.seconds for row in rows if row.seconds is not None]


def solved(rows: Sequence[Row]) -> str:
    """Number of sessions that were calibrated, of all."""
    return f"{sum(row.rotation_deg is not None for row in rows)} of {len(rows)}"


def title_of(method: str) -> str:
    """Title of a method; its name if no such method is registered."""
    return METHODS[method].title if method in METHODS else method


def mean(values: Iterable[float | None]) -> float | None:
    """Mean of the values that are known."""
    known = [value for value in values if value is not None]
    return fmean(known) if known else None


def millimetres(metres: float | None) -> float | None:
    """A length in millimetres."""
    return None if metres is None else 1000 * metres


def ratio(value: float | None, reference: float | None) -> float | None:
    """A value divided by a reference, if both are known."""
    return None if value is None or not reference else value / reference
