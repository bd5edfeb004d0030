"""From the points of a recording to angles, phases and figures of its swings, each with its standard deviation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from torchstickcal.analysis.angles import ANGLES, Angle, missing_points, with_derived
from torchstickcal.analysis.interpolation import at
from torchstickcal.analysis.phases import EVENTS, NOT_FOUND, Sport, events_of, lowest_at, sport_named, swing_peaks
from torchstickcal.analysis.repeats import multiple_correlation, normalised
from torchstickcal.analysis.smoothing import smoother
from torchstickcal.analysis.stick import StickMotion
from torchstickcal.analysis.stick_smoothing import StickSmoother
from torchstickcal.analysis.tracks import Tracks, tracks_of
from torchstickcal.errors import CalibrationError
from torchstickcal.io.skeletons import conventional
from torchstickcal.reconstruction import Reconstruction
from torchstickcal.result import Calibration

Array = NDArray[np.float64]

DRAWS = 40
"""How many times the errors are drawn; the standard deviations are then known to 11 %."""
_FINER = 4
"""Moments for each frame at which events are looked for."""
_MOST_UNKNOWN = 0.2
"""Share of the draws in which a figure may be unknown."""


@dataclass(frozen=True)
class Figure:
    """A number with its standard deviation."""

    value: float
    std: float
    unit: str


@dataclass(frozen=True, eq=False)
class Curve:
    """A number over time with its standard deviation."""

    values: Array
    """(T,), NaN where not known"""
    std: Array
    """(T,)"""
    unit: str


@dataclass(frozen=True, eq=False)
class Swing:
    """One swing."""

    events: Mapping[str, Figure]
    """seconds, by the names of :data:`~torchstickcal.analysis.phases.EVENTS`"""
    figures: Mapping[str, Figure]
    """what was measured of the swing"""
    angles: Mapping[str, Mapping[str, Figure]]
    """by the name of the angle, then of the event"""

    @property
    def not_found(self) -> tuple[str, ...]:
        """Events that were not found; their times, and what depends on them, are NaN."""
        return tuple(name for name, figure in self.events.items() if np.isnan(figure.value))


@dataclass(frozen=True, eq=False)
class Repeated:
    """A curve over repeated swings, at 101 equal steps from takeaway to finish."""

    mean: Array
    """(101,)"""
    std: Array
    """(101,), standard deviation of the mean by errors of keypoints and cameras"""
    spread: Array
    """(101,), standard deviation between the swings; contains the errors too"""
    correlation: Figure
    """coefficient of multiple correlation"""
    unit: str


@dataclass(frozen=True, eq=False)
class Analysis:
    """What :func:`analyse` finds."""

    times: Array
    """(T,), seconds"""
    curves: Mapping[str, Curve]
    """angles in degrees, and ``tip_speed`` and ``stick_turn_rate``, by name"""
    swings: tuple[Swing, ...]
    repeated: Mapping[str, Repeated]
    """by the names of the curves; empty for fewer than two complete swings"""
    sport: str
    notes: tuple[str, ...]
    """what a careful user should know"""


def analyse(
    calibration: Calibration | Reconstruction,
    sport: str = "any",
    *,
    fps: float | None = None,
    up: Sequence[float] | None = None,
    stick: int = 0,
    draws: int = DRAWS,
    seed: int = 0,
) -> Analysis:
    """Angles, stick kinematics, phases and repeated swings of a calibrated session, or of one that was triangulated.

    Points are triangulated frame by frame and smoothed over as many frames as the motion allows. For the
    standard deviations, errors of keypoints, cameras and stick length are drawn at random, and all is calculated again.

    Args:
        calibration: of the session, or what :func:`torchstickcal.triangulate` found in another one. Points need the names of a
            skeleton.
        sport: whose rule for the impact is used: ``golf``, ``baseball``, ``hockey``, ``kendo`` or ``any``.
        fps: frames per second; None for those of the calibration.
        up: the vertical in the frame of the calibration; None to take it from the cameras, if they stand level, or from the
            frame.
        stick: which of the sticks.
        draws: how many times errors are drawn, 2 or more. seed: of the random numbers.

    Raises:
        CalibrationError: for an unknown sport or stick, or without a frame rate.

    Example:
        >>> from torchstickcal import calibrate
        >>> from torchstickcal.simulate import Noise, golf_session
        >>> observations, _ = golf_session(cameras=4, frames=240, noise=Noise(1.0))
        >>> analysis = analyse(calibrate(observations), "golf")
        >>> [swing] = analysis.swings
        >>> {event: round(figure.value, 1) for event, figure in swing.events.items()}
        {'takeaway': 0.3, 'top': 1.2, 'impact': 1.4, 'finish': 2.0}
        >>> swing.figures["peak_tip_speed"].unit, sorted(analysis.curves)[:2]
        ('m/s', ['left_elbow_flexion', 'left_shoulder_elevation'])
    """
    rules = sport_named(sport)
    tracks = tracks_of(calibration, fps, up)
    return analysis_of(tracks, sport, rules, stick, draws, seed)


def analysis_of(tracks: Tracks, sport: str, rules: Sport, stick: int, draws: int, seed: int) -> Analysis:
    """As :func:`analyse`, of tracks."""
    _check(tracks, stick, draws)
    drawn = tracks.drawn(draws, seed)
    motion = _stick_motion(tracks, drawn, stick, seed)
    times, fine = motion.finer(tracks.times, _FINER)
    peaks = swing_peaks(times, fine.turn_rate[0])
    events = np.array(
        [[events_of(times, fine, peak, rules, tracks.up, n) for peak in peaks] for n in range(1 + draws)]
    ).reshape(1 + draws, len(peaks), len(EVENTS))
    angles, notes = _angles(tracks, drawn, events, seed)
    stacked = {**angles, "tip_speed": motion.tip_speed, "stick_turn_rate": np.degrees(motion.turn_rate)}
    units = {name: {"tip_speed": "m/s", "stick_turn_rate": "deg/s"}.get(name, "deg") for name in stacked}
    if rules.needs_up and tracks.up is None:
        notes.append("Without a vertical the impact is where the end of the stick is fastest.")
    swings = tuple(_swing(tracks, motion, stacked, units, events[:, number]) for number in range(len(peaks)))
    return Analysis(
        times=tracks.times,
        curves={name: Curve(values[0], _std(values), units[name]) for name, values in stacked.items()},
        swings=swings,
        repeated=_repeated(tracks.times, stacked, units, events),
        sport=sport,
        notes=(*tracks.notes, *notes, *_about_swings(swings, any(ANGLES[name].turns for name in angles))),
    )


def _check(tracks: Tracks, stick: int, draws: int) -> None:
    if not 0 <= stick < len(tracks.sticks):
        expected = f"0 to {len(tracks.sticks) - 1}" if tracks.sticks else "a recording with a stick"
        raise CalibrationError("no stick of that number", where="stick", got=stick, expected=expected)
    if draws < 2:
        raise CalibrationError("too few draws for a standard deviation", where="draws", got=draws, expected="2 or more")
    if len(tracks.times) < 8:
        raise CalibrationError("too few frames", where="calibration", got=len(tracks.times), expected="8 or more")


def _stick_motion(tracks: Tracks, drawn: Array, stick: int, seed: int) -> StickMotion:
    *_, length_m, sigma_m = tracks.sticks[stick]
    lengths = length_m + sigma_m * np.random.default_rng((seed, 1)).standard_normal(len(drawn))
    lengths[0] = length_m
    return StickSmoother.of(tracks, stick)(drawn, lengths, seed)


def _angles(tracks: Tracks, drawn: Array, events: Array, seed: int) -> tuple[dict[str, Array], list[str]]:
    """The angles (N, T) that the points determine, and sentences about those that are left out."""
    derived = with_derived(tracks.names, tracks.points, tracks.up)
    possible = {name: angle for name, angle in ANGLES.items() if not missing_points(angle, derived)}
    left_out = [name for name in ANGLES if name not in possible]
    index = [number for number, name in enumerate(tracks.names) if conventional(name) in _needed(possible)]
    smooth, _ = smoother(tracks.times, tracks.points[:, index], tracks.variances[:, index])(drawn[:, :, index], seed)
    points = with_derived(tuple(tracks.names[number] for number in index), smooth, tracks.up)
    values = {name: _without_jumps(angle.of(points)) for name, angle in possible.items()}
    turns = [name for name, angle in possible.items() if angle.turns]
    values |= {name: values[name] - _at_first_takeaway(values[name], tracks.times, events) for name in turns}
    notes = [f"Left out, because points are missing: {', '.join(left_out)}."] if left_out else []
    return values, notes


def _needed(angles: Mapping[str, Angle]) -> set[str]:
    """Names of the points that angles need, those from which others are derived included."""
    needs = {need for angle in angles.values() for need in angle.needs}
    derived = {"left_hip", "right_hip", "pelvis", "hip", "left_shoulder", "right_shoulder"} if "trunk" in needs else set()
    return needs | derived


def _without_jumps(degrees: Array) -> Array:
    """Angles (N, T) without jumps of 360 degrees over time, and those of the draws near those of the estimate."""
    estimate, seen = np.full_like(degrees[0], np.nan), np.isfinite(degrees[0])
    estimate[seen] = np.unwrap(degrees[0][seen], period=360.0)
    return estimate + (degrees - estimate + 180.0) % 360.0 - 180.0


def _at_first_takeaway(degrees: Array, times: Array, events: Array) -> Array:
    """The angles (N, 1) at the takeaway of the first complete swing, or in the first frame in which they are known."""
    begins = events[0, :, 0][np.isfinite(events[0, :, 0])]
    if len(begins) and np.isfinite(at(times, degrees[0], begins[0])):
        return at(times, degrees.T, begins[0])[:, None]
    seen = np.flatnonzero(np.isfinite(degrees[0]))
    return degrees[:, seen[:1]] if len(seen) else np.zeros((len(degrees), 1))


def _swing(tracks: Tracks, motion: StickMotion, curves: Mapping[str, Array], units: Mapping[str, str], events: Array) -> Swing:
    """What is measured of a swing with events (N, 4)."""
    found = [_figures(tracks, motion, curves, number, of_draw) for number, of_draw in enumerate(events)]
    figures = {name: _figure(np.array([f[name][0] for f in found]), unit) for name, (_, unit) in found[0].items()}
    at_events = {
        name: {
            event: _figure(np.array([at(tracks.times, v, e[k]) for v, e in zip(values, events, strict=True)]), units[name])
            for k, event in enumerate(EVENTS)
        }
        for name, values in curves.items()
        if units[name] == "deg"
    }
    return Swing({event: _figure(events[:, k], "s") for k, event in enumerate(EVENTS)}, figures, at_events)


def _figures(
    tracks: Tracks, motion: StickMotion, curves: Mapping[str, Array], number: int, events: Array
) -> dict[str, tuple[float, str]]:
    takeaway, top, impact, finish = events
    times, speed = tracks.times, motion.tip_speed[number]
    inside = (times >= top) & (times <= finish)
    peak = float(at(times, speed, lowest_at(times, -speed, np.flatnonzero(inside))))
    found = {
        "backswing": (top - takeaway, "s"),
        "downswing": (impact - top, "s"),
        "tempo": ((top - takeaway) / (impact - top), ""),
        "peak_tip_speed": (peak, "m/s"),
        "impact_tip_speed": (float(np.linalg.norm(at(times, motion.tip_velocity[number], impact))), "m/s"),
    }
    normal, rms_m = _plane(motion.tip[number][inside & (speed >= 0.5 * peak)])
    found["plane_deviation"] = (1000 * rms_m, "mm")
    if tracks.up is not None:
        velocity = at(times, motion.tip_velocity[number], impact)
        found["plane_slope"] = (float(np.degrees(np.arccos(np.clip(abs(normal @ tracks.up), 0, 1)))), "deg")
        found["attack_angle"] = (float(np.degrees(np.arcsin(velocity @ tracks.up / np.linalg.norm(velocity)))), "deg")
    for name in ("x_factor", "x_factor_projected"):
        if name in curves:
            part = curves[name][number][(times >= takeaway) & (times <= impact)]
            largest = float(part[np.nanargmax(np.abs(part))]) if np.isfinite(part).any() else np.nan
            found[f"largest_{name}"] = (largest, "deg")
    return found


def _plane(points: Array) -> tuple[Array, float]:
    """Normal (3,) of the plane that fits points (n, 3) best, and root mean square of their distances from it, metres."""
    known = points[np.isfinite(points).all(-1)]
    if len(known) < 4:
        return np.full(3, np.nan), np.nan
    _, sizes, axes = np.linalg.svd(known - known.mean(0), full_matrices=False)
    return axes[2], float(sizes[2] / np.sqrt(len(known)))


def _repeated(times: Array, curves: Mapping[str, Array], units: Mapping[str, str], events: Array) -> dict[str, Repeated]:
    """The curves over the swings that are complete."""
    complete = [number for number in range(events.shape[1]) if np.isfinite(events[0, number, [0, -1]]).all()]
    if len(complete) < 2:
        return {}
    stacked = np.stack(list(curves.values()), axis=-1)
    swings = np.array(
        [
            [normalised(times, values, of_draw[number, 0], of_draw[number, -1]) for number in complete]
            for values, of_draw in zip(stacked, events, strict=True)
        ]
    )  # (N, G, 101, curves)
    repeated = {}
    for column, name in enumerate(curves):
        of_curve = swings[..., column]
        if name in ANGLES and ANGLES[name].turns:  # athletes who walk begin each swing in another direction
            of_curve = of_curve - of_curve[..., :1]
        correlations = np.array([multiple_correlation(of_draw) for of_draw in of_curve])
        mean = of_curve.mean(1)
        spread = of_curve[0].std(0, ddof=1)
        repeated[name] = Repeated(mean[0], _std(mean), spread, _figure(correlations, ""), units[name])
    return repeated


def _figure(values: Array, unit: str) -> Figure:
    return Figure(float(values[0]), float(_std(values)), unit)


def _std(values: Array) -> Array:
    """Root mean square of the differences of the draws (N - 1, ...) from the estimate; NaN where too many are unknown."""
    squares = np.square(values[1:] - values[0])
    known = np.isfinite(squares)
    count = known.sum(0)
    mean = np.where(known, squares, 0.0).sum(0) / np.maximum(count, 1)
    return np.where(count >= (1 - _MOST_UNKNOWN) * len(squares), np.sqrt(mean), np.nan)


def _about_swings(swings: Sequence[Swing], with_turns: bool) -> list[str]:
    """Sentences about swings and events that were not found, and what has no value or another meaning for this reason."""
    if not swings:
        return ["No swing was found: the stick is not known in enough frames."]
    notes = []
    for number, swing in enumerate(swings, 1):
        notes += [f"Swing {number}: {NOT_FOUND[event]}." for event in swing.not_found]
        unknown = [name for name, figure in swing.figures.items() if np.isnan(figure.value)]
        notes += [f"Swing {number}: without a value are {', '.join(unknown)}."] if unknown else []
    if any(swing.not_found for swing in swings):
        notes.append("Let the recording begin a second before the first swing and end a second after the last one.")
    if with_turns and all("takeaway" in swing.not_found for swing in swings):
        notes.append("Turns of trunk and pelvis are counted from the first frame, because no takeaway was found.")
    return notes
