"""Joint angles, phases and the consistency of repeated golf swings, against the truth: three figures and their numbers.

    python examples/swings_of_a_golfer.py --out pictures

A golfer swings three times in front of four cameras. The keypoints of body and club have independent errors of 3 px. The
cameras are calibrated with nothing else, and the swings are analysed. Lines are estimates, with bands of two standard
deviations; dots are the truth.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch
from accuracy_of_the_analysis import Scene, all_angles, apart, scene
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from torchstickcal import calibrate
from torchstickcal.analysis import ANGLES, EVENTS, Analysis, analyse, multiple_correlation
from torchstickcal.analysis.phases import SPORTS, events_of, swing_peaks
from torchstickcal.analysis.repeats import SHARES, normalised
from torchstickcal.analysis.stick import StickMotion

Array = NDArray[np.float64]

SHOWN = ("left_elbow_flexion", "right_elbow_flexion", "left_shoulder_elevation", "right_knee_flexion", "trunk_lean", "x_factor")
REPEATED = ("left_elbow_flexion", "trunk_turn", "pelvis_turn", "x_factor", "stick_turn_rate", "tip_speed")
PHASES = {"backswing": "#9ecae1", "downswing": "#fdae6b", "follow-through": "#a1d99b"}
FPS, SECONDS, SIGMA_PX, TINY_S = 120.0, 12.2, 3.0, 1e-4


def true_motion(truth: Scene, times: Array) -> StickMotion:
    points, later, before = (truth.points(times + shift)[:, -2:] for shift in (0.0, TINY_S, -TINY_S))
    velocity = (later - before) / (2 * TINY_S)
    length = np.linalg.norm(points[:, 1] - points[:, 0], axis=-1)
    rate = np.linalg.norm(velocity[:, 1] - velocity[:, 0], axis=-1) / length
    return StickMotion(*(part[None] for part in (points[:, 0], points[:, 1], velocity[:, 0], velocity[:, 1], rate)))


def true_events(truth: Scene, up: Array) -> Array:
    """Times of the events of each swing by the same rules, (swings, 4)."""
    times = np.arange(0.0, truth.times[-1], 1 / 1000)
    motion = true_motion(truth, times)
    peaks = swing_peaks(times, motion.turn_rate[0])
    return np.array([events_of(times, motion, peak, SPORTS["golf"], up) for peak in peaks])


def true_curves(truth: Scene, names: tuple[str, ...], up: Array) -> dict[str, Array]:
    motion = true_motion(truth, truth.times)
    curves = all_angles(names, truth.points(truth.times), up)
    return curves | {"tip_speed": motion.tip_speed[0], "stick_turn_rate": np.degrees(motion.turn_rate[0])}


def label(axes: Axes, title: str, along: str, unit: str) -> None:
    axes.set_title(title, fontsize=9)
    axes.set_xlabel(along, fontsize=8)
    axes.set_ylabel(unit, fontsize=8)
    axes.tick_params(labelsize=7)


def panels(rows: int, columns: int) -> tuple[Figure, list[Axes]]:
    picture = Figure(figsize=(4.0 * columns, 2.5 * rows), layout="tight")
    return picture, [picture.add_subplot(rows, columns, number + 1) for number in range(rows * columns)]


def angles_picture(found: Analysis, true: dict[str, Array], first_s: float, last_s: float) -> Figure:
    picture, grid = panels(2, 3)
    shown = (found.times >= first_s) & (found.times <= last_s)
    for axes, name in zip(grid, SHOWN, strict=True):
        curve, times = found.curves[name], found.times[shown]
        low, high = (curve.values + side * 2 * curve.std for side in (-1, 1))
        axes.fill_between(times, low[shown], high[shown], alpha=0.3)
        axes.plot(times, curve.values[shown], linewidth=1)
        axes.plot(times[::6], true[name][shown][::6], "k.", markersize=2)
        error = apart(curve.values, true[name])
        label(axes, f"{name.replace('_', ' ')} (RMS error {np.sqrt(np.nanmean(error**2)):.2f}°)", "time (s)", "degrees")
    return picture


def phases_picture(found: Analysis, true: dict[str, Array], events: Array) -> Figure:
    picture, grid = panels(1, len(found.swings))
    for axes, swing, exact in zip(grid, found.swings, events, strict=True):
        times = [swing.events[event].value for event in EVENTS]
        shown = (found.times > times[0] - 0.3) & (found.times < times[-1] + 0.3)
        for (phase, colour), first, last in zip(PHASES.items(), times, times[1:], strict=False):
            axes.axvspan(first, last, color=colour, alpha=0.5, label=phase)
        for moment in exact:
            axes.axvline(moment, color="k", linewidth=0.7, linestyle=":")
        axes.plot(found.times[shown], found.curves["tip_speed"].values[shown], "k", linewidth=1)
        axes.plot(found.times[shown][::6], true["tip_speed"][shown][::6], "k.", markersize=2)
        peak = swing.figures["peak_tip_speed"]
        label(axes, f"tip speed, largest {peak.value:.1f} ± {peak.std:.1f} m/s", "time (s)", "m/s")
    grid[0].legend(fontsize=7, loc="upper left")
    return picture


def true_correlation(truth: Scene, curve: Array, events: Array, turns: bool) -> float:
    curve = np.unwrap(curve, period=360) if turns else curve
    swings = np.array([normalised(truth.times, curve, moments[0], moments[-1]) for moments in events])
    return multiple_correlation(swings - swings[:, :1] if turns else swings)


def consistency_picture(found: Analysis, correlations: dict[str, float]) -> Figure:
    picture, grid = panels(2, 3)
    for axes, name in zip(grid, REPEATED, strict=True):
        repeated = found.repeated[name]
        axes.fill_between(SHARES, repeated.mean - repeated.spread, repeated.mean + repeated.spread, alpha=0.3)
        axes.plot(SHARES, repeated.mean, linewidth=1)
        title = f"{name.replace('_', ' ')}, CMC {repeated.correlation.value:.4f} (true {correlations[name]:.4f})"
        label(axes, title, "swing (%)", repeated.unit)
    return picture


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("--out", type=Path, default=Path("pictures"), help="folder for the figures (default: pictures)")
    arguments.add_argument("--seed", type=int, default=17, help="of the swings and of the noise (default: 17)")
    options = arguments.parse_args()
    torch.set_num_threads(1)
    truth = scene("golf", options.seed, FPS, SIGMA_PX, SIGMA_PX, SECONDS)
    calibration = calibrate(truth.observations)
    found = analyse(calibration, "golf")
    up = truth.rotations[0] @ [0.0, 0.0, 1.0]
    true = true_curves(truth, calibration.point_names or (), up)
    events = true_events(truth, up)
    correlations = {
        name: true_correlation(truth, true[name], events, name in ANGLES and ANGLES[name].turns) for name in REPEATED
    }
    options.out.mkdir(parents=True, exist_ok=True)
    first, last = (found.swings[0].events[event].value for event in (EVENTS[0], EVENTS[-1]))
    for name, picture in (
        ("swing-angles", angles_picture(found, true, first - 0.2, last + 0.2)),
        ("swing-phases", phases_picture(found, true, events)),
        ("swing-consistency", consistency_picture(found, correlations)),
    ):
        picture.savefig(options.out / f"{name}.png", dpi=90)
    for name in SHOWN:
        error = apart(found.curves[name].values, true[name])
        stated = np.sqrt(np.nanmean(np.square(found.curves[name].std)))
        print(f"{name:26} RMS error {np.sqrt(np.nanmean(error**2)):.2f} deg, stated {stated:.2f} deg")
    for number, (swing, exact) in enumerate(zip(found.swings, events, strict=True), start=1):
        off = ", ".join(
            f"{event} {1000 * (swing.events[event].value - moment):+.1f} +- {1000 * swing.events[event].std:.1f}"
            for event, moment in zip(EVENTS, exact, strict=True)
        )
        print(f"swing {number}: errors of the events in ms: {off}")
        inside = (truth.times >= exact[1]) & (truth.times <= exact[3])
        peak, exact_peak = swing.figures["peak_tip_speed"], true["tip_speed"][inside].max()
        print(f"         largest tip speed {peak.value:.2f} +- {peak.std:.2f} m/s, true {exact_peak:.2f} m/s")
    for name in REPEATED:
        value = found.repeated[name].correlation
        print(f"{name:26} CMC {value.value:.4f} +- {value.std:.4f}, true {correlations[name]:.4f}")


if __name__ == "__main__":
    main()
