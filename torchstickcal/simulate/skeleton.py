"""The athlete's body: 19 joints on bones of constant length, posed by joint rotations and by reaching.

Body axes at rest: x to the athlete's right, y forward, z up, the feet on z = 0.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from torchstickcal.errors import CalibrationError
from torchstickcal.io.session import SPORTS_STICK_SYN_JOINTS

Array = NDArray[np.float64]

JOINTS = SPORTS_STICK_SYN_JOINTS
JOINT_INDEX = {name: index for index, name in enumerate(JOINTS)}
SIDES = ("left", "right")
STANDING_HEIGHT_M = 1.76

PARENTS = {
    "spine": "pelvis",
    "neck": "spine",
    "head": "neck",
    "head_top": "head",
} | {
    f"{side}_{joint}": f"{side}_{parent}" if parent not in {"pelvis", "spine"} else parent
    for side in SIDES
    for joint, parent in (
        ("shoulder", "spine"),
        ("elbow", "shoulder"),
        ("wrist", "elbow"),
        ("hand", "wrist"),
        ("knee", "pelvis"),
        ("shin", "knee"),
        ("ankle", "shin"),
    )
}
"""The joint each joint hangs from. The pelvis is the root; a thigh runs from the pelvis itself, for there are no hip joints."""

_REST = {
    "pelvis": (0.0, 0.0, 0.530),
    "spine": (0.0, 0.0, 0.125),
    "neck": (0.0, 0.0, 0.185),
    "head": (0.0, 0.020, 0.065),
    "head_top": (0.0, -0.015, 0.095),
    "shoulder": (0.110, 0.0, 0.165),
    "elbow": (0.0, 0.0, -0.175),
    "wrist": (0.0, 0.0, -0.148),
    "hand": (0.0, 0.0, -0.055),
    "knee": (0.055, 0.0, -0.245),
    "shin": (0.0, 0.0, -0.120),
    "ankle": (0.0, 0.0, -0.126),
}
"""From parent to joint, standing with hanging arms, in body heights; of the right side where there are two."""


@dataclass(frozen=True)
class Skeleton:
    """Bones of an athlete of given standing height, in the usual proportions of adults.

    Args:
        height_m: from the floor to ``head_top``.
    """

    height_m: float = STANDING_HEIGHT_M

    def __post_init__(self) -> None:
        if not 0.5 <= self.height_m <= 2.5:
            raise CalibrationError("not a person's height", where="height_m", got=self.height_m, expected="0.5 to 2.5 metres")

    @cached_property
    def offsets_m(self) -> Array:
        """From parent to joint at rest, (19, 3); for the pelvis, from the floor."""
        rows = []
        for joint in JOINTS:
            x, y, z = _REST[joint.removeprefix("left_").removeprefix("right_")]
            rows.append((-x if joint.startswith("left_") else x, y, z))
        return self.height_m * np.array(rows)

    def bone_m(self, joint: str) -> float:
        """Length of the bone that ends in a joint."""
        return float(np.linalg.norm(self.offsets_m[JOINT_INDEX[joint]]))

    @property
    def thigh_m(self) -> float:
        """Pelvis to knee."""
        return self.bone_m("right_knee")

    @property
    def shank_m(self) -> float:
        """Knee to ankle, straight through the shin."""
        return self.bone_m("right_shin") + self.bone_m("right_ankle")

    @property
    def upper_arm_m(self) -> float:
        """Shoulder to elbow."""
        return self.bone_m("right_elbow")

    @property
    def forearm_m(self) -> float:
        """Elbow to wrist."""
        return self.bone_m("right_wrist")

    @property
    def hand_m(self) -> float:
        """Wrist to hand."""
        return self.bone_m("right_hand")

    @property
    def ankle_height_m(self) -> float:
        """Of an ankle above the sole."""
        return float(
            sum(self.offsets_m[JOINT_INDEX[joint], 2] for joint in ("pelvis", "right_knee", "right_shin", "right_ankle"))
        )

    def forward(self, pelvis: Array, rotations: Array) -> Array:
        """Joints (T, 19, 3) of a pelvis at (T, 3) and joint rotations (T, 19, 3, 3).

        A joint's rotation turns everything that hangs from it, relative to its parent's frame at rest.
        """
        points = np.empty((*pelvis.shape[:-1], len(JOINTS), 3))
        turned = np.empty_like(rotations)
        points[:, 0], turned[:, 0] = pelvis, rotations[:, 0]
        for joint, name in enumerate(JOINTS[1:], 1):
            parent = JOINT_INDEX[PARENTS[name]]
            points[:, joint] = points[:, parent] + turned[:, parent] @ self.offsets_m[joint]
            turned[:, joint] = turned[:, parent] @ rotations[:, joint]
        return points


def bend(root: Array, goal: Array, first_m: float, second_m: float, towards: Array) -> Array:
    """The middle joint (T, 3) of a limb of two bones from a root to a goal, (T, 3) each.

    The law of cosines places it on a circle about the line from root to goal; ``towards`` (T, 3) picks the point on it.

    Raises:
        CalibrationError: if the goal is out of reach.
    """
    line = goal - root
    distance = np.linalg.norm(line, axis=-1, keepdims=True)
    cosine = (first_m**2 + distance**2 - second_m**2) / (2 * first_m * distance)
    if not (np.abs(cosine) <= 1).all():
        raise CalibrationError(
            "a limb cannot reach",
            where="bend",
            got=f"{distance.min():.3f} to {distance.max():.3f} m",
            expected=f"{abs(first_m - second_m):.3f} to {first_m + second_m:.3f} m from root to goal",
        )
    along = line / distance
    side = unit(towards - (towards * along).sum(-1, keepdims=True) * along)
    return root + first_m * (cosine * along + np.sqrt(1 - cosine**2) * side)


def unit(vectors: Array) -> Array:
    """Vectors (..., 3) scaled to length 1."""
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def rotation(axis: int, degrees: Array) -> Array:
    """Rotations (T, 3, 3) about a coordinate axis by angles (T,)."""
    cosine, sine = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    first, second = (axis + 1) % 3, (axis + 2) % 3
    matrices = np.zeros((*np.shape(degrees), 3, 3))
    matrices[..., axis, axis] = 1.0
    matrices[..., first, first] = matrices[..., second, second] = cosine
    matrices[..., second, first], matrices[..., first, second] = sine, -sine
    return matrices
