"""The points of detectors: their names, in one convention, by the names of the skeletons."""

from __future__ import annotations

import re
from collections.abc import Sequence

SPORTS_STICK_SYN_JOINTS = (
    "pelvis", "spine", "right_shoulder", "left_shoulder", "neck", "head", "head_top",
    "right_elbow", "right_wrist", "right_hand", "left_elbow", "left_wrist", "left_hand",
    "right_knee", "right_shin", "right_ankle", "left_knee", "left_shin", "left_ankle",
)  # fmt: skip
"""The 19 joints of Sports-Stick-Syn. The files do not name them; the names are chosen by the bones' lengths and positions."""


def _sides(*names: str) -> tuple[str, ...]:
    """Each name on the left and on the right."""
    return tuple(f"{side}_{name}" for name in names for side in ("left", "right"))


def _hand(side: str) -> tuple[str, ...]:
    fingers = ("thumb", "index", "middle", "ring", "pinky")
    return (f"{side}_hand_root", *(f"{side}_{finger}_{joint}" for finger in fingers for joint in range(1, 5)))


_COCO_17 = ("nose", *_sides("eye", "ear", "shoulder", "elbow", "wrist", "hip", "knee", "ankle"))
_FOOT = ("big_toe", "small_toe", "heel")

SKELETONS: dict[str, tuple[str, ...]] = {
    "coco-17": _COCO_17,
    "halpe-26": (*_COCO_17, "head", "neck", "hip", *_sides(*_FOOT)),
    "body-25": (
        "nose", "neck", "right_shoulder", "right_elbow", "right_wrist", "left_shoulder", "left_elbow", "left_wrist",
        "hip", "right_hip", "right_knee", "right_ankle", "left_hip", "left_knee", "left_ankle",
        "right_eye", "left_eye", "right_ear", "left_ear",
        *(f"{side}_{name}" for side in ("left", "right") for name in _FOOT),
    ),
    "body-25b": (*_COCO_17, "neck", "head_top", *(f"{side}_{name}" for side in ("left", "right") for name in _FOOT)),
    "coco-wholebody": (
        *_COCO_17,
        *(f"{side}_{name}" for side in ("left", "right") for name in _FOOT),
        *(f"face_{number}" for number in range(68)),
        *_hand("left"),
        *_hand("right"),
    ),
    "blazepose-33": (
        "nose", "left_eye_inner", "left_eye", "left_eye_outer", "right_eye_inner", "right_eye", "right_eye_outer",
        *_sides("ear", "mouth"),
        *_sides("shoulder", "elbow", "wrist", "pinky", "index", "thumb", "hip", "knee", "ankle", "heel", "foot_index"),
    ),
    "sports-stick-syn": SPORTS_STICK_SYN_JOINTS,
}  # fmt: skip
"""The names of the points of each skeleton, in the order of the detector."""

_OTHER_NAMES: dict[str, str] = {
    "l": "left", "r": "right", "sho": "shoulder", "elb": "elbow", "wri": "wrist", "ank": "ankle",
    "bigtoe": "big_toe", "smalltoe": "small_toe", "headtop": "head_top", "midhip": "hip", "mid_hip": "hip",
    "upper_neck": "neck", "upperneck": "neck",
}  # fmt: skip
_WORD = re.compile(r"[A-Z]+(?=[A-Z][a-z])|[A-Z]?[a-z]+|[A-Z]+|\d+|[^\W\d_]+")
_JOINTS = {name.removeprefix("left_") for names in SKELETONS.values() for name in names if name.startswith("left_")}


def conventional(name: str) -> str:
    """A name of a point as the skeletons write it: words in lower case, the side first.

    Example:
        >>> [conventional(name) for name in ("RKnee", "ankle_left", "r_sho", "LBigToe", "lelbow", "club head")]
        ['right_knee', 'left_ankle', 'right_shoulder', 'left_big_toe', 'left_elbow', 'club_head']
    """
    words: list[str] = [_OTHER_NAMES.get(word, word) for word in map(str.lower, _WORD.findall(name))]
    if len(words) == 1 and words[0][:1] in ("l", "r") and words[0][1:] in _JOINTS:
        words = [_OTHER_NAMES[words[0][0]], words[0][1:]]
    sides = [word for word in words if word in ("left", "right")]
    if len(sides) == 1:
        words = [*sides, *(word for word in words if word not in sides)]
    joined = "_".join(words) or name
    return _OTHER_NAMES.get(joined, joined)


def point_named(name: str, names: Sequence[str]) -> str:
    """The point that is meant by a name: the one of exactly this name, else the only one of the same conventional name.

    The name itself where there is none; whoever looks it up then says so.

    Example:
        >>> point_named("RKnee", ["left_knee", "right_knee"]), point_named("tip", ["left_knee", "right_knee"])
        ('right_knee', 'tip')
    """
    alike = [other for other in names if conventional(other) == conventional(name)]
    return name if name in names or len(alike) != 1 else alike[0]
