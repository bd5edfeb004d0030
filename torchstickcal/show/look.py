"""One look for all that is shown: the colours of figures, TensorBoard, report and terminal, and how numbers are written."""

from __future__ import annotations

import math
import re
import shutil
import textwrap
from typing import NamedTuple

from torchstickcal.quality.verdict import Verdict


class Colour(NamedTuple):
    """A colour on a light and on a dark ground, as CSS and matplotlib write it."""

    light: str
    dark: str

    @property
    def rgb(self) -> tuple[int, int, int]:
        """Red, green and blue on a light ground, 0 to 255."""
        red, green, blue = bytes.fromhex(self.light.removeprefix("#"))
        return red, green, blue


COLOURS = {
    "body": Colour("#33383d", "#d5dae0"),
    "stick": Colour("#d1495b", "#ff7b8b"),
    "used": Colour("#1f5fa8", "#6ea8ee"),
    "aside": Colour("#e06c00", "#ff9d42"),
    "relabelled": Colour("#8250df", "#b894ff"),
    "reprojection": Colour("#0b8a7d", "#3fcfbe"),
    "good": Colour("#1a7f37", "#4ac26b"),
    "usable": Colour("#8a6100", "#e3b341"),
    "poor": Colour("#c2410c", "#ff8b5c"),
    "failed": Colour("#b3261e", "#ff7b72"),
}
"""What has a colour of its own, by its name: the athlete, the stick, keypoints that were used, set aside or relabelled,
projections of points, and the verdicts."""
CAMERA_COLOURS = (
    Colour("#1f77b4", "#5aaeea"), Colour("#c85a00", "#ff9c4a"), Colour("#2a8a3c", "#63c774"), Colour("#8a5cc0", "#bb97ea"),
    Colour("#8c564b", "#c99186"), Colour("#c04e9b", "#f090cc"), Colour("#5f6670", "#a9b1bb"), Colour("#7f8000", "#c5c64a"),
    Colour("#0f8a9c", "#4fc8d8"), Colour("#1f3c78", "#8ea6de"),
)  # fmt: skip
"""Of the cameras, in their order; the eleventh has that of the first again."""
_NARROWEST_TEXT, _WIDEST_TEXT = 40, 118
_BEFORE_UNIT = re.compile(r"(?<=\d) (?=%|(mm|cm|m|px|mrad|deg|ms|s|Hz)\b)")
"""A blank at which no line is broken."""
TERMINAL_COLOURS = {Verdict.GOOD: "32", Verdict.USABLE: "33", Verdict.POOR: "31", Verdict.FAILED: "1;31"}
"""Parameters of a terminal's sequence SGR: green, yellow, red, bold red."""


def camera_colour(number: int) -> Colour:
    """The colour of a camera by its number."""
    return CAMERA_COLOURS[number % len(CAMERA_COLOURS)]


def terminal_width() -> int:
    """Columns that a text for people may have: those of the terminal, within limits; the widest where there is no terminal."""
    return max(_NARROWEST_TEXT, min(_WIDEST_TEXT, shutil.get_terminal_size((_WIDEST_TEXT, 24)).columns))


def wrapped(text: str, first: str = "", others: str = "  ") -> list[str]:
    """A sentence as lines that fit into the terminal, not broken between a number and its unit.

    Args:
        text: the sentence.
        first: what the first line begins with.
        others: what the other lines begin with.

    Example:
        >>> wrapped("The floor is known to ± 11 mm.")
        ['The floor is known to ± 11 mm.']
    """
    whole = _BEFORE_UNIT.sub("\N{NO-BREAK SPACE}", text)
    lines = textwrap.wrap(
        whole, terminal_width(), initial_indent=first, subsequent_indent=others, break_long_words=False, break_on_hyphens=False
    )
    return [line.replace("\N{NO-BREAK SPACE}", " ") for line in lines]


def digits(value: float, significant: int = 3) -> str:
    """A number with some significant digits, without an exponent where a reader can do without; a dash where it is not known.

    Example:
        >>> digits(0.012345), digits(1234.5), digits(float("nan"))
        ('0.0123', '1234', '-')
    """
    if not math.isfinite(value):
        return "-"
    if value == 0:
        return "0"
    magnitude = math.floor(math.log10(abs(value)))
    if not -5 <= magnitude < 7:
        return f"{value:.{significant - 1}e}"
    return f"{value:.{max(0, significant - 1 - magnitude)}f}"


def with_std(value: float, std: float) -> str:
    """A number with its standard deviation, both with the digits that mean something; without it where it is not known or 0.

    Example:
        >>> with_std(1201.8764, 3.12), with_std(0.5, float("nan"))
        ('1201.9 ± 3.1', '0.5')
    """
    if not math.isfinite(value):
        return "-"
    if not math.isfinite(std) or std == 0:
        return f"{value:.6g}"
    decimals = max(0, 1 - math.floor(math.log10(std)))
    return f"{value:.{decimals}f} ± {std:.{decimals}f}" if decimals < 9 else f"{value:.6g} ± {std:.2g}"


def share(value: float) -> str:
    """A share as per cent; a dash where it is not known. Neither 0 nor 100 % is written where it is not so.

    Example:
        >>> share(0.25), share(0.9996), share(float("nan"))
        ('25 %', '99.9 %', '-')
    """
    if not math.isfinite(value):
        return "-"
    if 0 < value < 0.1 or 0.9 < value < 1:
        return f"{min(99.9, max(0.1, 100 * value)):.1f} %"
    return f"{100 * value:.0f} %"
