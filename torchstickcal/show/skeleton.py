"""Which points are joined by bones when an athlete is drawn, by the names of the points."""

from __future__ import annotations

import itertools
from collections.abc import Sequence


def _limbs(side: str) -> tuple[tuple[str, ...], ...]:
    """Of the left or the right half of the body."""
    return (
        ("nose", f"{side}_eye", f"{side}_ear"),
        ("neck", f"{side}_shoulder", f"{side}_elbow", f"{side}_wrist", f"{side}_hand|{side}_hand_root|{side}_index"),
        ("pelvis|hip", f"{side}_hip", f"{side}_knee", f"{side}_shin", f"{side}_ankle", f"{side}_heel"),
        (f"{side}_ankle", f"{side}_big_toe|{side}_foot_index", f"{side}_small_toe"),
        (f"{side}_shoulder", f"{side}_hip"),
    )


_CHAINS = (
    ("head_top", "head|nose", "neck", "spine", "pelvis|hip"),
    *_limbs("left"),
    *_limbs("right"),
    ("left_shoulder", "right_shoulder"),
    ("left_hip", "right_hip"),
)
"""Points that follow each other along the body. A point that a detector lacks is passed over; of several names with a bar
between them the first known one is taken."""


def bones_of(names: Sequence[str] | None) -> list[tuple[int, int]]:
    """Pairs of points that are joined, by their indices; none without names.

    Example:
        >>> bones_of(["left_wrist", "left_shoulder", "left_elbow", "club_head"])
        [(1, 2), (2, 0)]
    """
    index = {name: number for number, name in enumerate(names or ())}
    bones: dict[tuple[int, int], None] = {}
    for chain in _CHAINS:
        known = [
            next(index[name] for name in place.split("|") if name in index)
            for place in chain
            if index.keys() & {*place.split("|")}
        ]
        bones |= dict.fromkeys(itertools.pairwise(known))
    return list(bones)
