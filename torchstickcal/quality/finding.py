"""A finding: one thing that is known about a result, what it means and what to do."""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass
from typing import Any


class Severity(enum.IntEnum):
    """What a finding means for the result.

    Example:
        >>> Severity.SERIOUS > Severity.CAUTION
        True
    """

    NOTE = 0
    """worth knowing; the result is not affected"""
    CAUTION = 1
    """the result can be used with care"""
    SERIOUS = 2
    """the result is probably wrong, or much less precise than it could be"""
    FATAL = 3
    """the result, or a part of it, must not be used"""


@dataclass(frozen=True)
class Finding:
    """One thing that is known about a result.

    Args:
        code: a stable name, such as ``camera_moved``.
        severity: what it means for the result.
        meaning: one sentence: what was found and what it means.
        advice: one sentence: what to do; empty if there is nothing to do.
        cameras: the names of the cameras that it is about.
        points: the names of the points that it is about.
        frames: the first and the last frame that it is about; None for all.
        figure: the number that was compared with the limit; None if there is none.
        limit: the number beyond which this is said.
        unit: of figure and limit.
        is_cause: whether it explains other findings. Causes are named first.

    Example:
        >>> finding = Finding("camera_moved", Severity.SERIOUS, "cam02 moved.", "Calibrate both parts.", cameras=("cam02",))
        >>> finding.text
        'cam02 moved. Calibrate both parts.'
    """

    code: str
    severity: Severity
    meaning: str
    advice: str = ""
    cameras: tuple[str, ...] = ()
    points: tuple[str, ...] = ()
    frames: tuple[int, int] | None = None
    figure: float | None = None
    limit: float | None = None
    unit: str = ""
    is_cause: bool = False

    def __post_init__(self) -> None:
        for name in ("figure", "limit"):
            object.__setattr__(self, name, _finite(getattr(self, name)))

    @property
    def text(self) -> str:
        """Meaning and advice as one text."""
        return f"{self.meaning} {self.advice}".strip()

    def as_json(self) -> dict[str, Any]:
        """The finding as JSON can hold it; :meth:`from_json` reads it back."""
        return {
            "code": self.code,
            "severity": self.severity.name.lower(),
            "meaning": self.meaning,
            "advice": self.advice,
            "cameras": list(self.cameras),
            "points": list(self.points),
            "frames": None if self.frames is None else list(self.frames),
            "figure": self.figure,
            "limit": self.limit,
            "unit": self.unit,
            "is_cause": self.is_cause,
        }

    @staticmethod
    def from_json(content: dict[str, Any]) -> Finding:
        """A finding from what :meth:`as_json` gave."""
        frames = content["frames"]
        return Finding(
            code=str(content["code"]),
            severity=Severity[str(content["severity"]).upper()],
            meaning=str(content["meaning"]),
            advice=str(content["advice"]),
            cameras=tuple(map(str, content["cameras"])),
            points=tuple(map(str, content["points"])),
            frames=None if frames is None else (int(frames[0]), int(frames[1])),
            figure=None if content["figure"] is None else float(content["figure"]),
            limit=None if content["limit"] is None else float(content["limit"]),
            unit=str(content["unit"]),
            is_cause=bool(content["is_cause"]),
        )


def _finite(value: float | None) -> float | None:
    """A number as JSON can hold it; None for one that is not finite."""
    return float(value) if value is not None and math.isfinite(value) else None
