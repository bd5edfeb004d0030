"""The points of detectors: their names, in one convention, by the names of the skeletons."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from pathlib import Path

from torchstickcal.errors import CalibrationError
from torchstickcal.io.sports_stick_syn import SPORTS_STICK_SYN_JOINTS
from torchstickcal.registry import suggestion
from torchstickcal.untrusted import read_toml, reading


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
