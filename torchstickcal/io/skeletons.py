"""Skeletons by name: those that are known, and a user's own in a file."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

from torchstickcal.errors import CalibrationError
from torchstickcal.registry import suggestion
from torchstickcal.skeletons import SKELETONS, conventional, point_named
from torchstickcal.untrusted import read_toml, reading

__all__ = ["SKELETONS", "conventional", "point_named", "skeleton", "skeletons_of"]


def skeleton(name: str, points: int | None = None) -> tuple[str, ...]:
    """The names of the points of a skeleton.

    Args:
        name: of a skeleton, a key of :data:`SKELETONS`, in any spelling; or the path of a TOML file with a list ``points``.
        points: how many points the detector gives, if that is known.

    Raises:
        CalibrationError: if there is no such skeleton, or if it has another number of points.
        FileFormatError: if the file holds no list of different names.
        FileNotFoundError: if there is no such file.

    Example:
        >>> skeleton("COCO_17")[:3]
        ('nose', 'left_eye', 'right_eye')
    """
    spelt = {_letters(known): known for known in SKELETONS}
    if _letters(name) in spelt:
        names = SKELETONS[spelt[_letters(name)]]
    elif name.lower().endswith(".toml"):
        names = _own(Path(name))
    else:
        raise CalibrationError(
            "unknown skeleton",
            where="skeleton",
            got=repr(name),
            expected=f"one of {', '.join(SKELETONS)}, or a TOML file with a list `points`",
            remedy=suggestion(name, SKELETONS),
        )
    if points is not None and len(names) != points:
        raise CalibrationError(
            "a skeleton with another number of points",
            where=f"skeleton {name}",
            got=f"{len(names)} names",
            expected=f"{points}, one for each point in the files",
            remedy=_fitting(points),
        )
    return names


def skeletons_of(points: int) -> list[str]:
    """The names of the skeletons with so many points."""
    return [name for name, names in SKELETONS.items() if len(names) == points]


def _fitting(points: int) -> str:
    names = skeletons_of(points)
    return f"These have {points} points: {', '.join(names)}." if names else "Give your own as a TOML file."


def _own(path: Path) -> tuple[str, ...]:
    with reading(path, "a skeleton: a TOML file with a list `points` of different names"):
        names = read_toml(path)["points"]
        if not isinstance(names, list) or not names or not all(isinstance(name, str) for name in names):
            raise TypeError("points that are not a list of names")
        if repeated := _repeated(names):
            raise ValueError(f"two points called {repeated!r}")
        return tuple(names)


def _repeated(names: Iterable[str]) -> str:
    seen: set[str] = set()
    return next((name for name in names if name in seen or seen.add(name)), "")


def _letters(name: str) -> str:
    return re.sub(r"[^a-z0-9]", "", name.lower())
