"""A figure of the sticks' lengths over time."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from torchstickcal.result import Calibration
from torchstickcal.show.look import COLOURS
from torchstickcal.show.tables import printable, stick_name

_SPREAD = 0.99
"""Share of the lengths that the axes show."""


def stick_figure(calibration: Calibration) -> Figure:
    """The reconstructed length of each stick over time, as its deviation from the given one, and where there is none.

    The lengths took part in the calibration: they are nearer to the given one than those of other frames would be.
    """
    count = max(1, len(calibration.sticks))
    figure = Figure(figsize=(9, 1.2 + 2.2 * count), layout="constrained")
    times = None if calibration.times is None else calibration.times.double().cpu().numpy()
    places = np.arange(len(calibration.points)) if times is None else times
    for number, stick in enumerate(calibration.sticks):
        axes = figure.add_subplot(count, 1, number + 1)
        errors_mm = 1000 * (calibration.stick_lengths_m[:, number].detach().double().cpu().numpy() - stick.between_m)
        known = np.isfinite(errors_mm)
        tolerance_mm = 1000 * stick.sigma_m
        axes.axhspan(-tolerance_mm, tolerance_mm, color=COLOURS["used"].light, alpha=0.12, linewidth=0, label="given ± std")
        axes.axhline(0, color=COLOURS["used"].light, linewidth=0.8)
        axes.plot(places[known], errors_mm[known], ".", markersize=3, color=COLOURS["stick"].light, label="reconstructed")
        limit = 1.25 * max(float(np.quantile(np.abs(errors_mm[known]), _SPREAD)) if known.any() else 1.0, tolerance_mm, 0.01)
        missing = places[~known]
        axes.plot(
            missing,
            np.full(len(missing), -limit),
            "|",
            color=COLOURS["aside"].light,
            label="an end is not known",
            clip_on=False,
        )
        axes.set(ylim=(-limit, limit), ylabel="length - given (mm)", xlabel="frame" if times is None else "time (s)")
        axes.set_title(f"{printable(stick_name(calibration, number))}, {stick.length_m:g} m", fontsize=9, parse_math=False)
        axes.legend(fontsize=7, loc="upper right", ncols=3)
    if not calibration.sticks:
        figure.text(0.5, 0.5, "no stick", ha="center")
    return figure
