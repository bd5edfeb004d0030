"""Pictures of an analysis: curves over time with phases, and repeated swings over each other."""

from __future__ import annotations

from matplotlib.axes import Axes
from matplotlib.figure import Figure as Picture

from torchstickcal.analysis.analyse import Analysis
from torchstickcal.analysis.phases import EVENTS, NOT_FOUND
from torchstickcal.analysis.repeats import SHARES

_LEFT, _RIGHT, _MIDDLE = "#1f5fa8", "#d1495b", "#33383d"
_EVENT_COLOURS: dict[str, str] = dict(zip(EVENTS, ("#7f8c8d", "#2e7d32", "#b8860b", "#7f8c8d"), strict=True))
_COLUMNS = 3


def curves_picture(analysis: Analysis) -> Picture:
    """Each curve over time with a band of two standard deviations; left and right of the body in one panel."""
    panels = _panels(list(analysis.curves))
    picture, grid = _grid(len(panels))
    for axes, (title, names) in zip(grid, panels.items(), strict=False):
        for name in names:
            curve, colour = analysis.curves[name], _colour(name)
            axes.fill_between(
                analysis.times, curve.values - 2 * curve.std, curve.values + 2 * curve.std, color=colour, alpha=0.2
            )
            axes.plot(analysis.times, curve.values, color=colour, linewidth=1)
        for swing in analysis.swings:
            for event, figure in swing.events.items():
                if event not in swing.not_found:
                    axes.axvline(figure.value, color=_EVENT_COLOURS[event], linewidth=0.7, linestyle="--")
        _label(axes, title, analysis.curves[names[0]].unit, "time (s)")
    missing = [f"swing {n}: {NOT_FOUND[e].split(':')[0]}" for n, s in enumerate(analysis.swings, 1) for e in s.not_found]
    if missing:
        picture.suptitle("; ".join(missing), fontsize=9)
    return picture


def repeated_picture(analysis: Analysis) -> Picture:
    """Mean of the repeated swings with their spread, from takeaway to finish."""
    panels = _panels(list(analysis.repeated))
    picture, grid = _grid(len(panels))
    for axes, (title, names) in zip(grid, panels.items(), strict=False):
        found = []
        for name in names:
            r, colour = analysis.repeated[name], _colour(name)
            axes.fill_between(SHARES, r.mean - r.spread, r.mean + r.spread, color=colour, alpha=0.2)
            axes.plot(SHARES, r.mean, color=colour, linewidth=1)
            known = r.correlation.value == r.correlation.value
            found.append(f"{r.correlation.value:.3f}" if known else "not defined")
        _label(axes, f"{title} (CMC {', '.join(found)})", analysis.repeated[names[0]].unit, "swing (%)")
    return picture


def _panels(names: list[str]) -> dict[str, list[str]]:
    """Names of curves by the title of their panel."""
    panels: dict[str, list[str]] = {}
    for name in names:
        title = name.removeprefix("left_").removeprefix("right_").replace("_", " ")
        panels.setdefault(title, []).append(name)
    return panels


def _grid(count: int) -> tuple[Picture, list[Axes]]:
    rows = max(1, -(-count // _COLUMNS))
    picture = Picture(figsize=(4.2 * _COLUMNS, 2.4 * rows), layout="tight")
    axes = [picture.add_subplot(rows, _COLUMNS, number + 1) for number in range(count)]
    return picture, axes


def _colour(name: str) -> str:
    return _LEFT if name.startswith("left_") else _RIGHT if name.startswith("right_") else _MIDDLE


def _label(axes: Axes, title: str, unit: str, along: str) -> None:
    axes.set_title(title, fontsize=9)
    axes.set_ylabel(unit, fontsize=8)
    axes.set_xlabel(along, fontsize=8)
    axes.tick_params(labelsize=7)
