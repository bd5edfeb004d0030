"""The athlete's body: 19 joints connected by bones of constant length, posed by joint rotations and inverse kinematics.

Body axes: x to the athlete's right, y forward, z up, the soles on z = 0. The rest pose stands upright with hanging arms.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from torchstickcal.errors import CalibrationError
from torchstickcal.io import SPORTS_STICK_SYN_JOINTS
from torchstickcal.lazy import cached_property

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
"""The parent of each joint. The pelvis is the root; there are no hip joints, so a thigh starts at the pelvis."""

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
"""Vector from the parent to the joint in the rest pose, in body heights; for paired joints that of the right side."""


@dataclass(frozen=True)
class Skeleton:
    """Bones of an athlete of given height, in the usual proportions of adults.

    Args:
        height_m: standing height, from the floor to ``head_top``, metres.

    Raises:
        CalibrationError: if the height is not that of a person (0.5 to 2.5 m).
    """

    height_m: float = STANDING_HEIGHT_M

    def __post_init__(self) -> None:
        if not 0.5 <= self.height_m <= 2.5:
            raise CalibrationError(
                "not the height of a person",
                where="height_m",
                got=self.height_m,
                expected="0.5 to 2.5 metres",
            )

    @cached_property
    def offsets_m(self) -> Array:
        """Vectors from parent to joint in the rest pose (19, 3), metres; for the pelvis, from the floor."""
        rows = []
        for joint in JOINTS:
            x, y, z = _REST[joint.removeprefix("left_").removeprefix("right_")]
            rows.append((-x if joint.startswith("left_") else x, y, z))
        return self.height_m * np.array(rows)

    def bone_m(self, joint: str) -> float:
        """Length of the bone from the parent of a joint to the joint, metres."""
        return float(np.linalg.norm(self.offsets_m[JOINT_INDEX[joint]]))

    @property
    def thigh_m(self) -> float:
        """Length from pelvis to knee, metres."""
        return self.bone_m("right_knee")

    @property
    def shank_m(self) -> float:
        """Length from knee to ankle, in a straight line through the shin, metres."""
        return self.bone_m("right_shin") + self.bone_m("right_ankle")

    @property
    def upper_arm_m(self) -> float:
        """Length from shoulder to elbow, metres."""
        return self.bone_m("right_elbow")

    @property
    def forearm_m(self) -> float:
        """Length from elbow to wrist, metres."""
        return self.bone_m("right_wrist")

    @property
    def hand_m(self) -> float:
        """Length from wrist to hand, metres."""
        return self.bone_m("right_hand")

    @property
    def ankle_height_m(self) -> float:
        """Height of an ankle above the sole, metres."""
        return float(
            sum(self.offsets_m[JOINT_INDEX[joint], 2] for joint in ("pelvis", "right_knee", "right_shin", "right_ankle"))
        )

    def forward(self, pelvis: Array, rotations: Array) -> Array:
        """Forward kinematics.

        Args:
            pelvis: positions (T, 3), metres.
            rotations: of each joint relative to its parent, (T, 19, 3, 3); that of the pelvis is from body to world.

        Returns:
            Positions of the joints (T, 19, 3), metres.
        """
        points = np.empty((*pelvis.shape[:-1], len(JOINTS), 3))
        to_world = np.empty_like(rotations)
        points[:, 0], to_world[:, 0] = pelvis, rotations[:, 0]
        for joint, name in enumerate(JOINTS[1:], 1):
            parent = JOINT_INDEX[PARENTS[name]]
            points[:, joint] = points[:, parent] + to_world[:, parent] @ self.offsets_m[joint]
            to_world[:, joint] = to_world[:, parent] @ rotations[:, joint]
        return points


def bend(root: Array, goal: Array, first_m: float, second_m: float, towards: Array) -> Array:
    """Inverse kinematics of a limb of two bones: the position of its middle joint (knee or elbow).

    By the law of cosines the middle joint is on a circle around the line from root to goal.

    Args:
        root: (T, 3), pelvis or shoulder. goal: (T, 3), ankle or wrist.
        first_m: length of the bone at the root, metres. second_m: of the bone at the goal.
        towards: direction (T, 3) in which the middle joint points; it selects the point of the circle.

    Returns:
        Positions (T, 3).

    Raises:
        CalibrationError: if the goal is too far from the root, or too close to it.
    """
    line = goal - root
    distance = np.linalg.norm(line, axis=-1, keepdims=True)
    cosine = (first_m**2 + distance**2 - second_m**2) / (2 * first_m * distance)
    if not (np.abs(cosine) <= 1).all():
        raise CalibrationError(
            "a hand or foot of the simulated athlete is out of reach",
            where="key postures",
            got=f"{distance.min():.3f} to {distance.max():.3f} m",
            expected=f"{abs(first_m - second_m):.3f} to {first_m + second_m:.3f} m from shoulder to wrist or pelvis to ankle",
        )
    along = line / distance
    side = unit(towards - (towards * along).sum(-1, keepdims=True) * along)
    return root + first_m * (cosine * along + np.sqrt(1 - cosine**2) * side)


def unit(vectors: Array) -> Array:
    """Vectors (..., 3) scaled to length 1."""
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def rotation(axis: int, degrees: Array) -> Array:
    """Rotations (T, 3, 3) about a coordinate axis (0, 1 or 2) by angles (T,)."""
    cosine, sine = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    first, second = (axis + 1) % 3, (axis + 2) % 3
    matrices = np.zeros((*np.shape(degrees), 3, 3))
    matrices[..., axis, axis] = 1.0
    matrices[..., first, first] = matrices[..., second, second] = cosine
    matrices[..., second, first], matrices[..., first, second] = sine, -sine
    return matrices
