"""Figures of the benchmark: violin plots of the errors, box plots of the run times, effect of the number of frames."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, StrMethodFormatter

from torchstickcal.benchmark.methods import METHODS
from torchstickcal.benchmark.run import Row

_COLOURS = {"human_height": "#d1495b", "human_height_in_motion": "#e8a33d", "paper": "#4a9d77", "default": "#1f5fa8"}
"""The methods that are drawn, with their colours."""
_QUANTITIES: dict[str, Callable[[Row], float | None]] = {
    "rotation error (deg)": lambda row: row.rotation_deg,
    "translation error (m)": lambda row: row.translation_m,
}
_BOUNDS: dict[str, Callable[[Row], float | None]] = {
    "rotation error (deg)": lambda row: row.bound_rotation_deg,
    "translation error (m)": lambda row: row.bound_translation_m,
}


def figures(rows: Sequence[Row]) -> dict[str, tuple[str, Figure]]:
    """The figures for which something was measured, with their captions, by name."""
    noisy = [row for row in rows if row.noise_px is not None]
    made = {
        "errors_by_cameras": (
            "Errors by number of cameras; each dot is a session. Dashed: mean Cramér-Rao bound.",
            _violins(rows, "cameras", lambda row: row.cameras),
        ),
        "errors_by_noise": (
            "Errors by noise of the keypoints; each dot is a session. Dashed: mean Cramér-Rao bound.",
            _violins(noisy, "noise (px)", lambda row: row.noise_px),
        ),
        "run_time": (
            "Run time by number of cameras: median, quartiles, and whiskers up to 1.5 times the interquartile range.",
            _boxes(rows),
        ),
        "frames": (
            "Mean error of `default` by number of frames and of cameras. Dashed: mean Cramér-Rao bound.",
            _effect_of_frames(rows),
        ),
    }
    return {name: (caption, figure) for name, (caption, figure) in made.items() if figure is not None}


def _violins(rows: Sequence[Row], label: str, key: Callable[[Row], float | None]) -> Figure | None:
    """Violin plots of both errors, grouped by a key; None if there is nothing to draw."""
    drawn = [row for row in rows if row.method in _COLOURS and row.rotation_deg is not None and row.cameras]
    methods = [name for name in _COLOURS if any(row.method == name for row in drawn)]
    groups = sorted({value for row in drawn if (value := key(row)) is not None})
    if not groups:
        return None
    figure = Figure(figsize=(10, 4), layout="constrained")
    width = 0.8 / len(methods)
    for axes, (quantity, value) in zip(figure.subplots(1, 2), _QUANTITIES.items(), strict=True):
        for number, name in enumerate(methods):
            for position, group in enumerate(groups):
                errors = [found for row in drawn if row.method == name and key(row) == group and (found := value(row))]
                _violin(axes, errors, position + (number - (len(methods) - 1) / 2) * width, width, _COLOURS[name])
        for position, group in enumerate(groups):
            bounds = [bound for row in drawn if key(row) == group and (bound := _BOUNDS[quantity](row))]
            if bounds:
                axes.hlines(
                    np.mean(bounds), position - 0.45, position + 0.45, colors="0.2", linestyles=(0, (4, 2)), linewidth=1.0
                )
        axes.set_yscale("log")
        axes.set_xticks(range(len(groups)), [f"{group:g}" for group in groups])
        axes.set_xlabel(label)
        axes.set_ylabel(quantity)
        axes.grid(axis="y", color="0.9", linewidth=0.6)
        axes.set_axisbelow(True)
    _legend(figure, methods)
    return figure


def _violin(axes: Axes, errors: Sequence[float], position: float, width: float, colour: str) -> None:
    """A violin on a logarithmic axis: the kernel density of the logarithms, the values as dots, and the median."""
    if not errors:
        return
    logs = np.log10(errors)
    spread = logs.std() * len(logs) ** -0.2
    offsets = np.zeros(len(logs))
    if spread > 1e-6:
        at = np.linspace(logs.min(), logs.max(), 120)
        density = np.exp(-0.5 * ((at[:, None] - logs) / spread) ** 2).sum(1)
        half = 0.46 * width * density / density.max()
        axes.fill_betweenx(10**at, position - half, position + half, color=colour, alpha=0.35, linewidth=0)
        offsets = 0.5 * np.interp(logs, at, half) * np.cos(2.4 * np.arange(len(logs)))
    axes.scatter(position + offsets, errors, s=5, color=colour, linewidths=0, alpha=0.8)
    axes.hlines(np.median(errors), position - 0.35 * width, position + 0.35 * width, colors=colour, linewidth=1.6)


def _boxes(rows: Sequence[Row]) -> Figure | None:
    """Box plots of the run time by number of cameras; None if there is nothing to draw."""
    profiled = [name for name in _COLOURS if METHODS[name].profiled]
    timed = [row for row in rows if row.seconds is not None and row.method in profiled]
    cameras = sorted({row.cameras for row in timed})
    methods = [name for name in profiled if any(row.method == name for row in timed)]
    if not timed:
        return None
    figure = Figure(figsize=(6.5, 3.6), layout="constrained")
    axes = figure.subplots()
    for number, name in enumerate(methods):
        times = [[row.seconds or 0.0 for row in timed if row.method == name and row.cameras == count] for count in cameras]
        positions = np.arange(len(cameras)) + 0.4 * (number - (len(methods) - 1) / 2)
        boxes = axes.boxplot([t or [np.nan] for t in times], positions=positions, widths=0.32, patch_artist=True, sym=".")
        for part in boxes["boxes"]:
            part.set(facecolor=_COLOURS[name], alpha=0.45, edgecolor=_COLOURS[name])
        for part in boxes["medians"]:
            part.set(color="0.1")
    axes.set_xticks(range(len(cameras)), [str(count) for count in cameras])
    axes.set_ylim(bottom=0)
    axes.set_xlabel("cameras")
    axes.set_ylabel("time (s)")
    axes.grid(axis="y", color="0.9", linewidth=0.6)
    axes.set_axisbelow(True)
    _legend(figure, methods)
    return figure


def _effect_of_frames(rows: Sequence[Row]) -> Figure | None:
    """Mean errors and bounds by number of frames, a line for each number of cameras; None for a single number of frames."""
    lengths = {name for name, method in METHODS.items() if name == "default" or method.frames is not None}
    solved = [row for row in rows if row.method in lengths and row.rotation_deg is not None]
    cameras = sorted({row.cameras for row in solved})
    if len({row.frames for row in solved}) < 2:
        return None
    figure = Figure(figsize=(10, 3.6), layout="constrained")
    for axes, (quantity, value) in zip(figure.subplots(1, 2), _QUANTITIES.items(), strict=True):
        for number, count in enumerate(cameras):
            colour = f"C{number}"
            of = [row for row in solved if row.cameras == count]
            for get, style in ((value, {"marker": "o", "markersize": 4}), (_BOUNDS[quantity], {"linestyle": (0, (4, 2))})):
                line = {
                    frames: np.mean(known)
                    for frames in sorted({row.frames for row in of})
                    if (known := [found for row in of if row.frames == frames and (found := get(row)) is not None])
                }
                label = f"{count} cameras" if get is value else None
                axes.plot(list(line), list(line.values()), color=colour, label=label, **style)
        axes.set_xscale("log")
        axes.set_yscale("log")
        frames = sorted({row.frames for row in solved})
        axes.set_xticks(frames, [str(number) for number in frames])
        axes.minorticks_off()
        axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axes.set_xlabel("frames")
        axes.set_ylabel(f"mean {quantity}")
        axes.grid(color="0.9", linewidth=0.6)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=len(labels), frameon=False)
    return figure


def _legend(figure: Figure, methods: Sequence[str]) -> None:
    axes = figure.axes[0]
    handles = [axes.fill_between([], [], color=_COLOURS[name], alpha=0.6) for name in methods]
    titles = [METHODS[name].title.replace("`", "") for name in methods]
    figure.legend(handles, titles, loc="outside upper center", ncols=min(len(titles), 4), frameon=False, fontsize="small")
