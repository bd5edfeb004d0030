"""What an analysis found, as tables (csv), as JSON, and as a text to print."""

from __future__ import annotations

import csv
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from torchstickcal.analysis.analyse import Analysis, Figure
from torchstickcal.analysis.angles import ANGLES
from torchstickcal.analysis.phases import EVENTS, RULES, SPORTS
from torchstickcal.analysis.repeats import SHARES
from torchstickcal.files import json_text

TABLES = ("curves.csv", "swings.csv", "repeated.csv", "analysis.json")
"""The files that :func:`write_tables` writes."""


def write_tables(folder: Path, analysis: Analysis) -> None:
    """Write all tables into a folder that exists: :data:`TABLES`."""
    _write(folder / TABLES[0], _curve_rows(analysis))
    _write(folder / TABLES[1], _swing_rows(analysis))
    _write(folder / TABLES[2], _repeated_rows(analysis))
    (folder / TABLES[3]).write_text(json_text(as_json(analysis)) + "\n", "utf-8")


def as_json(analysis: Analysis) -> dict[str, Any]:
    """Swings, repeated swings, rules and definitions, without the curves."""
    return {
        "sport": analysis.sport,
        "notes": list(analysis.notes),
        "swings": [
            {
                "events": _figures(swing.events),
                "not_found": list(swing.not_found),
                "figures": _figures(swing.figures),
                "angles": {name: _figures(events) for name, events in swing.angles.items()},
            }
            for swing in analysis.swings
        ],
        "multiple_correlation": {name: _plain(repeated.correlation) for name, repeated in analysis.repeated.items()},
        "rules": RULES | {"impact": SPORTS[analysis.sport].rule},
        "angles": {
            name: {"definition": angle.definition, "source": angle.source}
            for name, angle in ANGLES.items()
            if name in analysis.curves
        },
    }


def table(analysis: Analysis) -> str:
    """The swings as a text to print."""
    rows = [["swing", *EVENTS, "tempo", "tip speed (m/s)", "at impact (m/s)"]]
    for number, swing in enumerate(analysis.swings, 1):
        times = [_shown(swing.events[event], 3, "not found") for event in EVENTS]
        figures = swing.figures
        speeds = [_shown(figures[name], 2) for name in ("tempo", "peak_tip_speed", "impact_tip_speed")]
        rows.append([str(number), *times, *speeds])
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ["  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True)) for row in rows]
    return "\n".join([*lines, *(f"note: {note}" for note in analysis.notes)])


def _shown(figure: Figure, digits: int, unknown: str = "-") -> str:
    if figure.value != figure.value:
        return unknown
    return f"{figure.value:.{digits}f} +- {'?' if figure.std != figure.std else f'{figure.std:.{digits}f}'}"


def _plain(figure: Figure) -> dict[str, Any]:
    return {"value": figure.value, "std": figure.std, "unit": figure.unit}


def _figures(figures: Any) -> dict[str, Any]:
    return {name: _plain(figure) for name, figure in figures.items()}


def _curve_rows(analysis: Analysis) -> Iterable[list[Any]]:
    yield ["time_s", *(f"{name}{suffix}" for name in analysis.curves for suffix in ("", "_std"))]
    for frame, time in enumerate(analysis.times):
        values = [number for curve in analysis.curves.values() for number in (curve.values[frame], curve.std[frame])]
        yield [f"{time:.6f}", *(_number(value) for value in values)]


def _swing_rows(analysis: Analysis) -> Iterable[list[Any]]:
    yield ["swing", "figure", "event", "value", "std", "unit"]
    for number, swing in enumerate(analysis.swings, 1):
        yield from ([number, "not_found", event, "", "", ""] for event in swing.not_found)
        found = [("time", event, figure) for event, figure in swing.events.items()]
        found += [(name, "", figure) for name, figure in swing.figures.items()]
        found += [(name, event, figure) for name, events in swing.angles.items() for event, figure in events.items()]
        for name, event, figure in found:
            yield [number, name, event, _number(figure.value), _number(figure.std), figure.unit]


def _repeated_rows(analysis: Analysis) -> Iterable[list[Any]]:
    suffixes = ("_mean", "_mean_std", "_spread")
    yield ["per_cent", *(f"{name}{suffix}" for name in analysis.repeated for suffix in suffixes)]
    for step, share in enumerate(SHARES if analysis.repeated else ()):
        values = [number for r in analysis.repeated.values() for number in (r.mean[step], r.std[step], r.spread[step])]
        yield [f"{share:g}", *(_number(value) for value in values)]


def _number(value: float) -> str:
    """Six digits; empty where not known."""
    return f"{value:.6g}" if value == value else ""


def _write(path: Path, rows: Iterable[list[Any]]) -> None:
    with path.open("w", encoding="utf-8", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows(rows)
