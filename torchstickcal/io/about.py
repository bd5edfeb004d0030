"""What files say of themselves: the version that wrote them, units, axes, and a date if one is given."""

from __future__ import annotations

import os
from datetime import UTC, datetime
from functools import cache
from importlib.metadata import version

from torchstickcal.world import World

_DATE = "SOURCE_DATE_EPOCH"
"""The environment variable, common to many programs, that holds the date of what is written, in seconds since 1970."""


@cache
def version_of(package: str) -> str:
    """The version of a package, looked up once."""
    return version(package)


def generator() -> str:
    """The program and its version."""
    return f"torchstickcal {version_of('torchstickcal')}"


def date() -> str | None:
    """The date to be written: that of :data:`_DATE`, else none, so that the same input gives the same bytes.

    Example:
        >>> import os
        >>> os.environ["SOURCE_DATE_EPOCH"] = "86400"
        >>> date()
        '1970-01-02T00:00:00+00:00'
        >>> del os.environ["SOURCE_DATE_EPOCH"]
    """
    seconds = os.environ.get(_DATE, "")
    if not seconds.isdecimal() or len(seconds) > 11:
        return None
    return datetime.fromtimestamp(int(seconds), UTC).isoformat()


def axes(world: World | None) -> str:
    """The frame of the world in a sentence."""
    return "The frame is that of the file from which this was converted." if world is None else world.description


def about(unit: str, world: World | None, more: str = "") -> dict[str, str]:
    """What a file says of itself, by key.

    Args:
        unit: of length, in words.
        world: the frame.
        more: a sentence about the axes of the format.
    """
    said = {"generator": generator(), "units": unit, "axes": " ".join(filter(None, [axes(world), more]))}
    written = date()
    return said | ({"date": written} if written else {})


def comments(said: dict[str, str], mark: str = "# ") -> str:
    """The same as lines of comments."""
    return "".join(f"{mark}{key}: {' '.join(text.split())}\n" for key, text in said.items())
