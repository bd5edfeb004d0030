"""Which points a detector may take for each other: left and right of the body, of its parts, and the ends of a stick."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

_WORDS = re.compile(r"[A-Z]+(?=[A-Z][a-z])|[A-Z]?[a-z]+|[A-Z]+|[^A-Za-z]+")
_OTHER_SIDE = {"left": "right", "right": "left", "l": "r", "r": "l"}
_PARTS = {
    "arms": ("shoulder", "elbow", "wrist", "hand", "arm", "finger", "thumb", "index", "middle", "ring", "pinky", "palm"),
    "legs": ("hip", "thigh", "knee", "shin", "ankle", "foot", "toe", "heel", "leg"),
    "face": ("eye", "ear", "mouth", "cheek", "temple"),
}

_MARGIN_OF_PARTS = 12.0
"""Parts of the body are exchanged alone more rarely than all of it."""


@dataclass(frozen=True)
class Exchange:
    """Points that a detector may take for each other, all at once.

    Args:
        what: for messages, in the plural.
        pairs: of points; no point is in two of them.
        margin: least evidence with which it is undone, the logarithm of a ratio of likelihoods.
    """

    what: str
    pairs: tuple[tuple[int, int], ...]
    margin: float = 6.0
    whole: bool = True
    """False for a part of another exchange"""


def exchanges(point_names: Sequence[str] | None, sticks: Sequence[tuple[int, int]]) -> list[Exchange]:
    """What may be exchanged in a session, in the order in which it is to be looked for.

    Args:
        point_names: of the points. Without names nothing is known of the body, and only the ends of sticks may be exchanged.
        sticks: the ends of each.

    Example:
        >>> names = ("nose", "left_wrist", "right_wrist", "left_knee", "right_knee", "butt", "tip")
        >>> for exchange in exchanges(names, [(5, 6)]):
        ...     print(exchange.what, exchange.pairs)
        left and right of the body ((1, 2), (3, 4))
        left and right of the arms ((1, 2),)
        left and right of the legs ((3, 4),)
        the ends of the stick butt - tip ((5, 6),)
    """
    names = point_names or ()
    body = mirrored_pairs(names)
    found = [Exchange("left and right of the body", body)] if body else []
    parts = {f"left and right of the {part}": tuple(p for p in body if _part_of(names[p[0]]) == part) for part in _PARTS}
    partner, held = dict(body), {frozenset(ends) for ends in sticks}
    for ends in sticks:
        if all(end in partner for end in ends) and frozenset(partner[end] for end in ends) in held:
            parts[f"the sticks that {names[ends[0]]} and {names[partner[ends[0]]]} belong to"] = tuple(
                (end, partner[end]) for end in ends
            )
    found += [Exchange(what, pairs, _MARGIN_OF_PARTS, whole=False) for what, pairs in parts.items() if pairs and pairs != body]
    for start, end in sticks:
        if not names or not (_part_of(names[start]) and _part_of(names[end])):  # a limb that stands in for a stick has none
            label = f" {names[start]} - {names[end]}" if names else f" of points {start} and {end}"
            found.append(Exchange(f"the ends of the stick{label}", ((start, end),)))
    return found


def mirrored_pairs(names: Sequence[str]) -> tuple[tuple[int, int], ...]:
    """The pairs of points whose names differ in nothing but the side.

    Sides are the words "left" and "right" or the letters L and R, at any place in a name.

    Example:
        >>> mirrored_pairs(["left_hip", "right_hip", "nose", "RKnee", "LKnee", "wrist.R", "wrist.L", "leg"])
        ((0, 1), (4, 3), (6, 5))
    """
    places = {name: place for place, name in enumerate(names)}
    pairs: dict[int, int] = {}
    for place, name in enumerate(names):
        partners = [places[other] for side, other in _mirrored(name) if side in ("left", "l") and other in places]
        if partners and not {place, partners[0]} & {*pairs, *pairs.values()}:
            pairs[place] = partners[0]
    return tuple(pairs.items())


def _mirrored(name: str) -> list[tuple[str, str]]:
    """The sides that a name may say, each with the name of the other side."""
    words = _WORDS.findall(name)
    found: list[tuple[str, str]] = []
    for place, word in enumerate(words):
        for side, other in _OTHER_SIDE.items():
            whole = word.lower() == side
            if whole or (word.lower().startswith(side) and (place == 0 or len(side) > 1)):
                changed = _cased(other, word[: len(side)]) + word[len(side) :]
                found.append((side, "".join([*words[:place], changed, *words[place + 1 :]])))
    return found


def _cased(text: str, like: str) -> str:
    return text.upper() if like.isupper() else text.capitalize() if like[0].isupper() else text


def _part_of(name: str) -> str | None:
    """The part of the body that a point belongs to, by the words of its name."""
    endings = [word.lower() for word in _WORDS.findall(name)]
    return next((part for part, words in _PARTS.items() if any(word.endswith(words) for word in endings)), None)
