"""Parts of the body whose lengths follow from the body height.

A body that bends and walks is never as long as it is tall, but its bones keep their lengths. So the height is compared with
the lengths of shanks, thighs and trunk, and of neck and head where the top of the head is known. The lengths are those of an
average adult, as shares of the height (Winter, Biomechanics and Motor Control of Human Movement, after Drillis and Contini).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from torchstickcal.errors import ObservationError
from torchstickcal.skeletons import conventional, point_named

HEIGHT_STD = 0.03
"""Standard deviation of the scale that a height gives, as a share of it: people differ from the average by about 2 %, and what
a detector calls a joint is not exactly where it is."""

_HEAD = {"head_top": 1.0} | {
    f"{side}_{point}": share for point, share in (("ear", 0.93), ("eye", 0.936)) for side in ("left", "right")
}
_HEAD |= {"nose": 0.915, "head": 0.95}
_FEET = {"ankle": 0.039, "heel": 0.02}
"""How high points of the head and of the feet are when a body stands upright."""
BETWEEN_HEAD_AND_ANKLES = 0.961
"""From the ankles to the top of the head, as a share of the height."""
_SHANK, _THIGH, _THIGH_FROM_MIDDLE, _TRUNK, _NECK_AND_HEAD = 0.246, 0.245, 0.25, 0.288, 0.182
_SHANK_TO_HEEL = 0.267


def standing_in(name: str, point_names: Sequence[str] | None) -> tuple[str, float]:
    """A point of the head or of a foot that takes the place of one that a skeleton lacks, and by how much it is higher, as a
    share of the body height; the point itself where it is there, or where nothing can take its place.

    Example:
        >>> standing_in("head_top", ["nose", "left_ankle"])
        ('nose', -0.085)
    """
    given = {conventional(other): other for other in reversed(point_names or ())}
    wanted = conventional(name)
    side, _, joint = wanted.partition("_")
    heights = _HEAD if wanted in _HEAD else {}
    if joint in _FEET:
        heights = {f"{side}_{other}": height for other, height in _FEET.items()}
    if wanted in given or not heights:
        return point_named(name, point_names or ()), 0.0
    for other, height in heights.items():
        if other in given:
            return given[other], round(height - heights[wanted], 6)
    return name, 0.0


class Segment(NamedTuple):
    """A part of the body: from the middle of some points to the middle of others."""

    start: tuple[int, ...]
    end: tuple[int, ...]
    share: float
    """its length, as a share of the height"""
    rigid: bool
    """whether it always has this length; else it has it when the body stands upright"""


def segments_of(point_names: Sequence[str] | None) -> list[Segment]:
    """The parts of a body among named points; the whole body from head to feet if no part of it is known.

    Raises:
        ObservationError: if head or feet are not known either.
    """
    index = {conventional(name): number for number, name in enumerate(point_names or ())}

    def found(*names: str) -> tuple[int, ...]:
        """The points of some names, or none if one of them is missing."""
        return tuple(index[name] for name in names) if all(name in index for name in names) else ()

    segments: list[Segment] = []

    def add(start: tuple[int, ...], end: tuple[int, ...], share: float, times: int = 1, rigid: bool = True) -> None:
        segments.extend([Segment(start, end, share, rigid)] * times if start and end else [])

    middle = found("left_hip", "right_hip") or found("pelvis") or found("hip")
    shoulders = found("left_shoulder", "right_shoulder")
    for side in ("left", "right"):
        hip, knee, ankle, heel = (found(f"{side}_{joint}") for joint in ("hip", "knee", "ankle", "heel"))
        add(hip or middle, knee, _THIGH if hip else _THIGH_FROM_MIDDLE)
        add(knee, ankle or heel, _SHANK if ankle else _SHANK_TO_HEEL)
    add(shoulders, middle, _TRUNK, times=2)  # twice, as there are two legs: then a hip that is too high or too low does no harm
    add(found("head_top") or (found("head") if "nose" in index else ()), shoulders, _NECK_AND_HEAD, times=2)
    if not segments:
        heads = [name for name in _HEAD if name in index]
        feet = [joint for joint in _FEET if found(f"left_{joint}", f"right_{joint}")]
        for head, joint in zip(heads[:1], feet[:1], strict=False):
            add(found(head), found(f"left_{joint}", f"right_{joint}"), _HEAD[head] - _FEET[joint], rigid=False)
    if not segments:
        raise ObservationError(
            "the body height says nothing of these points",
            where="height_m",
            got=", ".join(point_names or ()) or "points without names",
            expected="shoulders, hips, knees and ankles, or a head and ankles or heels, by these names",
            remedy="Name the points with --skeleton.",
        )
    return segments
