"""Sticks: two tracked points and the known distance between them."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from torchstickcal.arrays import index_of, items_of, name_of, number_of
from torchstickcal.errors import ObservationError, quoted
from torchstickcal.registry import suggestion

_LONGEST_STICK_M = 10.0
_SHORTEST_STICK_M = 1e-3
_LEAST_SIGMA_M = 1e-9
_SHORTEST_IN_MM = 300.0


@dataclass(frozen=True)
class Stick:
    """A rigid stick: two tracked points and the known distance between them.

    Args:
        start: one end, as the index of a point or as its name.
        end: the other end.
        length_m: length in metres.
        sigma_m: standard deviation of the length, metres: how well it was measured and how rigid the stick is. Its error is the
            same in all frames and enters the scale's deviation. A limb that stands in for a stick is known to a few centimetres
            at best.
        start_offset_m, end_offset_m: how far inside the stick the detected point lies from its true end, metres, where this is
            the same in all frames: a grip that the hands hide. Negative beyond the end. None for one of them if it is not
            known: the stick then takes no part in the scale, and the offset is estimated, if another stick sets the scale.
            Nothing can tell the offset of the only stick from its length.

    Raises:
        ObservationError: if the ends are no points or the same one, if the length, its deviation or an offset are no lengths in
            metres, if the offsets leave nothing of the length, or if both are unknown.

    Example:
        >>> Stick(19, 20, 1.0)
        Stick(start=19, end=20, length_m=1.0, sigma_m=0.001)
        >>> Stick("right_knee", "right_ankle", 0.42, sigma_m=0.02)
        Stick(start='right_knee', end='right_ankle', length_m=0.42, sigma_m=0.02)
    """

    start: int | str
    end: int | str
    length_m: float
    sigma_m: float = 0.001
    start_offset_m: float | None = field(default=0.0, repr=False)
    end_offset_m: float | None = field(default=0.0, repr=False)

    def __post_init__(self) -> None:
        for name in ("start", "end"):
            object.__setattr__(self, name, _end_of(getattr(self, name), f"Stick.{name}"))
        if self.start == self.end:
            raise ObservationError(
                "a stick needs two different ends", where="Stick", got=f"start = end = {self.start!r}", expected="two points"
            )
        for name, least, most in (
            ("length_m", _SHORTEST_STICK_M, sys.float_info.max),
            ("sigma_m", _LEAST_SIGMA_M, _LONGEST_STICK_M),
        ):
            length = number_of(
                getattr(self, name),
                f"Stick.{name}",
                what="not a length",
                expected=f"one number, metres, {least:g} to {_LONGEST_STICK_M:g}",
                least=least,
                most=most,
                several="Give each stick its own Stick.",
            )
            object.__setattr__(self, name, length)
        if self.length_m > _LONGEST_STICK_M:
            unit, factor = ("millimetres", 1000) if self.length_m >= _SHORTEST_IN_MM else ("centimetres", 100)
            raise ObservationError(
                f"stick length looks like {unit}",
                where="Stick.length_m",
                got=self.length_m,
                expected=f"metres, at most {_LONGEST_STICK_M:g}",
                remedy=f"Divide by {factor}: {self.length_m / factor:g} m.",
            )
        self._check_offsets()

    def _check_offsets(self) -> None:
        for name in ("start_offset_m", "end_offset_m"):
            if getattr(self, name) is None:
                continue
            expected = f"one number, metres, {-_LONGEST_STICK_M:g} to {_LONGEST_STICK_M:g}, or None if it is not known"
            given, most = getattr(self, name), _LONGEST_STICK_M
            offset = number_of(given, f"Stick.{name}", what="not an offset", expected=expected, least=-most, most=most)
            object.__setattr__(self, name, offset)
        if self.start_offset_m is None and self.end_offset_m is None:
            raise ObservationError(
                "both offsets of a stick are unknown",
                where="Stick",
                got="start_offset_m = end_offset_m = None",
                expected="one unknown offset",
                remedy="Put a mark on the stick and give each end its own Stick, from the mark to the end.",
            )
        if self.between_m < _SHORTEST_STICK_M:
            raise ObservationError(
                "the offsets leave nothing of a stick",
                where="Stick",
                got=f"offsets {self.start_offset_m!r}, {self.end_offset_m!r} of {self.length_m:g} m",
                expected="offsets that are shorter than the stick",
            )

    @property
    def between_m(self) -> float:
        """The distance between the detected points, metres: the length without the known offsets.

        Example:
            >>> round(Stick("grip", "head", 1.1, start_offset_m=0.12).between_m, 3)
            0.98
        """
        return self.length_m - (self.start_offset_m or 0.0) - (self.end_offset_m or 0.0)

    @property
    def unknown_end(self) -> int | str | None:
        """The end whose offset is not known; None where both are known."""
        if self.start_offset_m is None:
            return self.start
        return self.end if self.end_offset_m is None else None

    @property
    def ends(self) -> tuple[int, int]:
        """Both ends as indices of points.

        Raises:
            ObservationError: if an end is a name; :class:`Observations` turns names into indices.
        """
        if isinstance(self.start, str) or isinstance(self.end, str):
            raise ObservationError(
                "a stick's end is a name", where="Stick.ends", got=f"{self.start!r}, {self.end!r}", expected="indices of points"
            )
        return self.start, self.end

    def located(self, point_names: Sequence[str] | None) -> Stick:
        """The stick with its ends as indices of points.

        Raises:
            ObservationError: if an end is a name that no point has.
        """
        start, end = (point_index(end, point_names) if isinstance(end, str) else end for end in (self.start, self.end))
        return replace(self, start=start, end=end)


def scale_sticks(sticks: Sequence[Stick]) -> list[Stick]:
    """The sticks that set the scale: those without an unknown offset, or all where every stick has one."""
    return [stick for stick in sticks if stick.unknown_end is None] or list(sticks)


def point_index(name: str, point_names: Sequence[str] | None) -> int:
    """The index of a named point.

    Raises:
        ObservationError: if no point has the name.
    """
    if point_names is None or name not in point_names:
        known = f"one of {', '.join(point_names)}" if point_names else "an index, since the points have no names"
        remedy = suggestion(name, point_names) if point_names else "Give point_names."
        raise ObservationError("no such point", where="point_names", got=repr(name), expected=known, remedy=remedy)
    return list(point_names).index(name)


def located_sticks(sticks: Any, point_names: Sequence[str] | None) -> tuple[Stick, ...]:
    """One stick or several, with their ends as indices of points.

    Raises:
        ObservationError: if they are no sticks, if an end is a name that no point has, or if two have the same ends.
    """
    expected = "Stick(start, end, length_m), or a list of them"
    given = [sticks] if isinstance(sticks, Stick) else items_of(sticks)
    if given is None:
        remedy = "Give an empty list if the scale comes from elsewhere." if sticks is None else ""
        raise ObservationError("not a stick", where="sticks", got=quoted(sticks), expected=expected, remedy=remedy)
    located: list[Stick] = []
    for number, stick in enumerate(given):
        where = f"sticks[{number}]"
        if not isinstance(stick, Stick):
            raise ObservationError("not a stick", where=where, got=quoted(stick), expected=expected)
        located.append(stick.located(point_names))
        start, end = located[-1].ends
        if any({start, end} == set(other.ends) for other in located[:-1]):
            raise ObservationError(
                "two sticks have the same ends", where=where, got=f"start {start}, end {end}", expected="a stick once"
            )
    return tuple(located)


def check_ends(sticks: Sequence[Stick], points: int) -> None:
    """Refuse sticks whose ends are not among so many points.

    Raises:
        ObservationError: if there is one.
    """
    for number, stick in enumerate(sticks):
        start, end = stick.ends
        if not (0 <= start < points and 0 <= end < points):
            raise ObservationError(
                "a stick's end is not a tracked point",
                where=f"sticks[{number}]",
                got=f"start {start}, end {end}",
                expected=f"indices from 0 to {points - 1}",
            )


def _end_of(end: Any, where: str) -> int | str:
    """A stick's end as a plain number or text."""
    if isinstance(end, str):
        return name_of(end)
    index = index_of(end)
    if index is None:
        raise ObservationError("not a point", where=where, got=quoted(end), expected="the index or the name of one point")
    return index
