"""Swings and their phases, from the motion of the stick alone. Each sport has rules; all of them are written in words.

All rules but that of the impact, and that of the takeaway in baseball, use how fast the stick turns, which a walking athlete
does not change.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from torchstickcal.analysis.interpolation import at
from torchstickcal.analysis.stick import StickMotion
from torchstickcal.errors import CalibrationError
from torchstickcal.registry import suggestion

Array = NDArray[np.float64]

EVENTS = ("takeaway", "top", "impact", "finish")
"""What divides a swing: address | backswing | downswing | follow-through."""

ONSET = 0.10
"""Share of the largest turn rate of a swing at which the downswing begins."""
ENDED = 0.05
"""Share of the largest turn rate of a swing at which the follow-through ends."""
FAST_AGAIN = 0.3
"""Share of the largest turn rate by which the stick turned faster before a moment, for that moment to be between two swings."""
BEGUN = 0.20
"""Share of the largest turn rate of the backswing at which it begins."""
CARRIED = 0.30
"""Share of the largest speed of the stick in the backswing at which it begins where the stick is carried. A batter who stands
moves the bat at up to 20 %."""
BACKSWING_DEG = 10.0
"""How far the stick is turned from where it is at the top when the search for the takeaway begins. Where it is carried, its end
is as far away."""
STOPPED = 0.10
"""Share of the largest turn rate at which a cut has been stopped."""
SAME_ACTION = 0.6
"""A swing's largest turn rate is at least this share of that of the fastest swing."""
APART_S = 1.0
"""Peaks that are nearer to each other belong to one swing: a cut and the raising of the sword before it."""
_LONGEST_BACKSWING_S = 3.0

Search = Callable[["_Swing"], float]


@dataclass(frozen=True)
class Sport:
    """The rule by which the impact of a swing is found."""

    rule: str
    impact: Search
    needs_up: bool = False
    stands: bool = False
    """whether the athlete stands until the swing, and carries the stick back rather than turns it: the takeaway is then found
    by the speed of the whole stick"""


@dataclass(frozen=True, eq=False)
class _Swing:
    """One estimate of a swing, for the rules: all arrays (T, ...)."""

    times: Array
    rate: Array
    tip: Array
    speed: Array
    up: Array | None
    peak: int
    takeaway_s: float
    top_s: float
    finish_s: float

    def between(self, first_s: float, last_s: float) -> NDArray[np.intp]:
        return np.flatnonzero((self.times >= first_s) & (self.times <= last_s))


def _fastest(swing: _Swing) -> float:
    frames = swing.between(swing.top_s, swing.finish_s)
    return lowest_at(swing.times, -swing.speed, frames)


def _through_address(swing: _Swing) -> float:
    at_address = at(swing.times, swing.tip, swing.takeaway_s)
    frames = swing.between(swing.top_s, swing.finish_s)
    return lowest_at(swing.times, np.square(swing.tip - at_address).sum(-1), frames)


def _lowest_point(swing: _Swing) -> float:
    assert swing.up is not None
    frames = swing.between(swing.top_s, swing.finish_s)
    return lowest_at(swing.times, swing.tip @ swing.up, frames)


def _stopped(swing: _Swing) -> float:
    return _falls_below(swing.times, swing.rate, swing.peak, STOPPED * swing.rate[swing.peak])


SPORTS: dict[str, Sport] = {
    "any": Sport("the end of the stick is fastest", _fastest),
    "golf": Sport("the club's head is nearest to where it was at the takeaway, where the ball lies", _through_address),
    "baseball": Sport("the end of the bat is fastest", _fastest, stands=True),
    "hockey": Sport("the blade is lowest", _lowest_point, needs_up=True),
    "kendo": Sport(f"the cut is stopped: the shinai turns at {100 * STOPPED:.0f} % of its largest rate", _stopped),
}
"""The rules for the impact by sport."""

RULES = {
    "swing": f"around each peak of the stick's turn rate of at least {100 * SAME_ACTION:.0f} % of the largest one, if no "
    f"higher peak is within {APART_S:g} s",
    "takeaway": f"the last time before the backswing at which the stick turned at less than {100 * BEGUN:.0f} % of the largest "
    "rate in it; in baseball, where the bat is carried back and hardly turns: at which the bat moved at less than "
    f"{100 * CARRIED:.0f} % of its largest speed in it, as the root mean square over the points of the bat",
    "top": f"the last time before the peak at which the stick turned at less than {100 * ONSET:.0f} % of the peak's rate; if "
    "it never did since the backswing, the moment at which it turned slowest",
    "finish": f"the first time after the peak at which the stick turns at less than {100 * ENDED:.0f} % of the peak's rate",
}
"""The rules for the other events, the same for all sports."""

NOT_FOUND = {
    "takeaway": "no address found: before the backswing the stick is never slow in the recording, or it is not seen",
    "top": "no top found: before it is fastest the stick is never slow in the recording, or it is not seen",
    "impact": "no impact found: its rule needs another event, and this was not found",
    "finish": "no finish found: after it was fastest the stick never stops in the recording, or it is not seen",
}
"""What is said where an event is not found."""


def sport_named(name: str) -> Sport:
    """The rules of a sport.

    Raises:
        CalibrationError: if there are none.
    """
    if name not in SPORTS:
        expected = f"one of {', '.join(SPORTS)}"
        raise CalibrationError(
            "no rules for a sport", where="sport", got=repr(name), expected=expected, remedy=suggestion(name, SPORTS)
        )
    return SPORTS[name]


def swing_peaks(times: Array, rate: Array) -> list[int]:
    """Frames at which the stick turns fastest, one for each swing.

    Example:
        >>> times = np.arange(0, 8, 0.01)
        >>> rate = 30 * np.exp(-((times - 2) / 0.1) ** 2) + 28 * np.exp(-((times - 6) / 0.1) ** 2)
        >>> [float(times[peak]) for peak in swing_peaks(times, rate)]
        [2.0, 6.0]
    """
    known = np.nan_to_num(rate, nan=0.0)
    largest, peaks, taken = known.max(initial=0.0), [], np.zeros(len(known), dtype=bool)
    while largest > 0:
        peak = int(np.where(taken, 0.0, known).argmax())
        if taken[peak] or known[peak] < SAME_ACTION * largest:
            break
        slow = known < ENDED * known[peak]
        before, after = np.flatnonzero(slow[:peak]), np.flatnonzero(slow[peak:])
        first, last = (before[-1] if len(before) else 0), (peak + after[0] if len(after) else len(known) - 1)
        if all(abs(times[peak] - times[other]) >= APART_S for other in peaks):
            peaks.append(peak)
        taken[first : last + 1] = True
    return sorted(peaks)


def events_of(times: Array, motion: StickMotion, peak: int, sport: Sport, up: Array | None, number: int = 0) -> Array:
    """The times (4,) of :data:`EVENTS` around a peak, for one of the estimates; NaN for what is not seen."""
    rate, tip, speed = motion.turn_rate[number], motion.tip[number], motion.tip_speed[number]
    reach = np.flatnonzero(np.abs(times - times[peak]) < 0.05)
    peak = int(reach[np.nanargmax(rate[reach])])
    top = _top(times, rate, peak)
    finish = _falls_below(times, rate, peak, ENDED * rate[peak])
    if sport.stands:
        length_m = float(np.nanmedian(np.linalg.norm(tip - motion.start[number], axis=-1)))
        takeaway = _takeaway(times, motion.whole_speed[number], tip / length_m, top, CARRIED)
    else:
        stick = tip - motion.start[number]
        takeaway = _takeaway(times, rate, stick / np.linalg.norm(stick, axis=-1, keepdims=True), top, BEGUN)
    if sport.needs_up and up is None:
        sport = SPORTS["any"]
    if not np.isfinite([top, finish]).all():
        return np.array([takeaway, top, np.nan, finish])
    impact = sport.impact(_Swing(times, rate, tip, speed, up, peak, takeaway, top, finish))
    return np.array([takeaway, top, impact, finish])


def _takeaway(times: Array, fast: Array, place: Array, top_s: float, begun: float) -> float:
    """Back from the top over the backswing, to where the stick moved much more slowly than since.

    Args:
        times: (T,). fast: how fast it turned or moved, (T,).
        place: its direction, or the place of its end in lengths of the stick, (T, 3). top_s: time of the top.
        begun: share of the largest of ``fast`` at which the backswing begins.
    """
    if not np.isfinite(top_s):
        return np.nan
    frame = int(np.searchsorted(times, top_s)) - 1
    away, largest = np.linalg.norm(place - place[frame], axis=-1), 0.0
    while frame >= 0 and times[frame] > top_s - _LONGEST_BACKSWING_S and np.isfinite(fast[frame]):
        if largest or away[frame] > 2 * np.sin(np.radians(BACKSWING_DEG) / 2):
            largest = max(largest, fast[frame])
        if fast[frame] < begun * largest:
            return _crossing(times, fast, frame, begun * largest)
        frame -= 1
    return np.nan


def _top(times: Array, rate: Array, peak: int) -> float:
    """Back from the peak to where the stick turned slowly, or to the slowest moment before it turned fast again."""
    slowest = peak
    for frame in range(peak - 1, -1, -1):
        if not np.isfinite(rate[frame]):
            return np.nan
        if rate[frame] < ONSET * rate[peak]:
            return _crossing(times, rate, frame, ONSET * rate[peak])
        if rate[frame] < rate[slowest]:
            slowest = frame
        if rate[frame] > rate[slowest] + FAST_AGAIN * rate[peak]:
            return lowest_at(times, rate, np.array([slowest]))
    return np.nan


def _falls_below(times: Array, values: Array, peak: int, level: float) -> float:
    for frame in range(peak + 1, len(values)):
        if not np.isfinite(values[frame]):
            return np.nan
        if values[frame] < level:
            return _crossing(times, values, frame - 1, level)
    return np.nan


def _crossing(times: Array, values: Array, frame: int, level: float) -> float:
    """The time between a frame and the next one at which values (T,) cross a level."""
    before, after = values[frame], values[frame + 1]
    share = (level - before) / (after - before) if after != before else 0.5
    return float(times[frame] + share * (times[frame + 1] - times[frame]))


def lowest_at(times: Array, values: Array, frames: NDArray[np.intp]) -> float:
    """The time of the lowest of values (T,) in some frames, between frames by a parabola."""
    if not len(frames) or np.isnan(values[frames]).all():
        return np.nan
    frame = int(frames[np.nanargmin(values[frames])])
    if not 0 < frame < len(values) - 1:
        return float(times[frame])
    before, here, after = values[frame - 1 : frame + 2]
    bend = before - 2 * here + after
    if not bend > 0:
        return float(times[frame])
    return float(times[frame] + 0.25 * (before - after) / bend * (times[frame + 1] - times[frame - 1]))
