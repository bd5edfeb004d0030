"""Sticks: two tracked points and the known distance between them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from torchstickcal.errors import ObservationError
from torchstickcal.registry import suggestion

_LONGEST_STICK_M = 10.0
_SHORTEST_IN_MM = 300.0


@dataclass(frozen=True)
class Stick:
    """A rigid stick: two tracked points and the known distance between them.

    Args:
        start: one end, as the index of a point or as its name.
        end: the other end.
        length_m: length in metres.
        sigma_m: standard deviation of the length, metres: how well it was measured and how rigid the stick is. A limb that
            stands in for a stick is known to a few centimetres at best.

    Raises:
        ObservationError: if the ends are the same, or the length or its deviation are no lengths in metres.

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

    def __post_init__(self) -> None:
        if self.start == self.end:
            raise ObservationError(
                "a stick needs two different ends", where="Stick", got=f"start = end = {self.start!r}", expected="two points"
            )
        for name, value in (("length_m", self.length_m), ("sigma_m", self.sigma_m)):
            if not (math.isfinite(value) and value > 0):
                raise ObservationError("not a length", where=f"Stick.{name}", got=value, expected="metres, above 0")
        if self.length_m > _LONGEST_STICK_M:
            unit, factor = ("millimetres", 1000) if self.length_m >= _SHORTEST_IN_MM else ("centimetres", 100)
            raise ObservationError(
                f"stick length looks like {unit}",
                where="Stick.length_m",
                got=self.length_m,
                expected=f"metres, at most {_LONGEST_STICK_M:g}",
                remedy=f"Divide by {factor}: {self.length_m / factor:g} m.",
            )

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
