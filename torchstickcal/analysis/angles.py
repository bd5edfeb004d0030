"""Angles of the body by named conventions. Each says what it is, which points it needs, and where its definition is from.

Points are the centres of joints, so that an angle is one that these points determine. What needs markers on the skin, such
as the rotation of a forearm about its own axis, is not here.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from torchstickcal.io.skeletons import conventional

Array = NDArray[np.float64]
Points = Mapping[str, Array]
"""Positions (..., T, 3) of points by their names in the convention of the skeletons, and ``up`` (3,) if it is known"""

WU_2002 = "Wu et al. 2002, J. Biomech. 35: 543-548 (ISB: ankle, hip, spine)"
WU_2005 = "Wu et al. 2005, J. Biomech. 38: 981-992 (ISB: shoulder, elbow, wrist, hand)"
GROOD_1983 = "Grood and Suntay 1983, J. Biomech. Eng. 105: 136-144"
JOYCE_2010 = "Joyce, Burnett and Ball 2010, Sports Biomech. 9: 206-216"
CHEETHAM_2001 = "Cheetham et al. 2001, in Optimising Performance in Golf: 192-199; projected as in McLean 1992"


@dataclass(frozen=True)
class Angle:
    """An angle over time."""

    needs: tuple[str, ...]
    """names of points; ``trunk`` and ``pelvis`` are derived as :func:`with_derived` says, ``up`` is the vertical"""
    definition: str
    source: str
    of: Callable[[Points], Array]
    """positions to degrees (..., T)"""
    turns: bool = False
    """whether it is counted on beyond 180 degrees, and from the first takeaway"""


def _both(name: str, needs: tuple[str, ...], definition: str, source: str, of: Callable[..., Array]) -> dict[str, Angle]:
    """An angle of the left and of the right side; names of points of a side begin with ``~``."""

    def on(side: str) -> Angle:
        names = tuple(need.replace("~", f"{side}_") for need in needs)
        return Angle(names, definition, source, lambda points: of(*(points[need] for need in names)))

    return {f"{side}_{name}": on(side) for side in ("left", "right")}


def _between(first: Array, second: Array) -> Array:
    """Degrees from 0 to 180 between vectors (..., 3), exact for small angles too."""
    cross = np.linalg.norm(np.cross(first, second), axis=-1)
    return np.degrees(np.arctan2(cross, (first * second).sum(-1)))


def _bend(near: Array, joint: Array, far: Array) -> Array:
    return _between(joint - near, far - joint)


def _without(vectors: Array, axis: Array) -> Array:
    """The part of vectors (..., 3) perpendicular to an axis (..., 3) of any length."""
    return vectors - (vectors * axis).sum(-1, keepdims=True) / np.square(axis).sum(-1, keepdims=True) * axis


def _about(axis: Array, first: Array, second: Array) -> Array:
    """Degrees from -180 to 180 by which vectors (..., 3) are turned about an axis from the first to the second."""
    a, b = _without(first, axis), _without(second, axis)
    sine = (np.cross(a, b) * axis).sum(-1) / np.linalg.norm(axis, axis=-1)
    return np.degrees(np.arctan2(sine, (a * b).sum(-1)))


def _heading(line: Array, up: Array) -> Array:
    """Degrees by which the horizontal part of a line is turned about the vertical, from a fixed direction."""
    fixed: Array = np.cross(up, np.eye(3)[np.argmin(np.abs(up))]).astype(np.float64)
    return _about(np.broadcast_to(up, line.shape), np.broadcast_to(fixed, line.shape), line)


def _shoulder_plane(shoulder: Array, elbow: Array, trunk: Array, left: Array, right: Array, outward: float) -> Array:
    """Degrees from the lateral direction to the front."""
    axis, lateral = trunk, outward * (right - left)
    return -outward * _about(-axis, lateral, elbow - shoulder)


ANGLES: dict[str, Angle] = {
    **_both(
        "elbow_flexion", ("~shoulder", "~elbow", "~wrist"),
        "Angle between the long axes of upper arm and forearm; 0 is a straight arm.", WU_2005, _bend,
    ),
    **_both(
        "knee_flexion", ("~hip", "~knee", "~ankle"),
        "Angle between the long axes of thigh and shank; 0 is a straight leg.", f"{GROOD_1983}; {WU_2002}", _bend,
    ),
    **_both(
        "hip_flexion", ("~hip", "~knee", "trunk"),
        "Angle between the thigh and the long axis of the trunk; 0 is standing upright. Bending to the side counts too.",
        f"{WU_2002}, for the trunk in the place of the pelvis, whose tilt two points do not show",
        lambda hip, knee, trunk: _between(knee - hip, -trunk),
    ),
    **_both(
        "shoulder_elevation", ("~shoulder", "~elbow", "trunk"),
        "Angle between the upper arm and the long axis of the trunk, downward; 0 is a hanging arm.",
        f"{WU_2005}: second angle of the order Y-X-Y, relative to the thorax",
        lambda shoulder, elbow, trunk: _between(elbow - shoulder, -trunk),
    ),
    **{
        f"{side}_shoulder_plane": Angle(
            (f"{side}_shoulder", f"{side}_elbow", "trunk", "left_shoulder", "right_shoulder"),
            "Direction in which the upper arm is raised, about the long axis of the trunk: 0 to the side, 90 to the front.",
            f"{WU_2005}: first angle of the order Y-X-Y, relative to the thorax",
            lambda p, side=side, outward=outward: _shoulder_plane(
                p[f"{side}_shoulder"], p[f"{side}_elbow"], p["trunk"], p["left_shoulder"], p["right_shoulder"], outward
            ),
        )
        for side, outward in (("left", -1.0), ("right", 1.0))
    },
    "trunk_lean": Angle(
        ("trunk", "up"), "Angle between the long axis of the trunk and the vertical.", WU_2002,
        lambda p: _between(p["trunk"], np.broadcast_to(p["up"], p["trunk"].shape)),
    ),
    "trunk_turn": Angle(
        ("left_shoulder", "right_shoulder", "up"),
        "Turn of the line through both shoulders about the vertical since the first swing's takeaway, positive to the left.",
        CHEETHAM_2001, lambda p: _heading(p["right_shoulder"] - p["left_shoulder"], p["up"]), turns=True,
    ),
    "pelvis_turn": Angle(
        ("left_hip", "right_hip", "up"),
        "Turn of the line through both hips about the vertical since the takeaway of the first swing, positive to the left.",
        CHEETHAM_2001, lambda p: _heading(p["right_hip"] - p["left_hip"], p["up"]), turns=True,
    ),
    "x_factor": Angle(
        ("left_shoulder", "right_shoulder", "left_hip", "right_hip", "trunk"),
        "Turn of the line through both shoulders relative to that through both hips, about the long axis of the trunk; "
        "positive to the left.",
        f"{JOYCE_2010}: axial rotation of the thorax relative to the pelvis",
        lambda p: _about(p["trunk"], p["right_hip"] - p["left_hip"], p["right_shoulder"] - p["left_shoulder"]),
    ),
    "x_factor_projected": Angle(
        ("left_shoulder", "right_shoulder", "left_hip", "right_hip", "up"),
        "The same in the horizontal plane: turn of the shoulders minus turn of the hips, positive to the left.",
        CHEETHAM_2001,
        lambda p: _about(
            np.broadcast_to(p["up"], p["left_hip"].shape),
            p["right_hip"] - p["left_hip"],
            p["right_shoulder"] - p["left_shoulder"],
        ),
    ),
}  # fmt: skip
"""The angles by name."""


def with_derived(names: tuple[str, ...], points: Array, up: Array | None) -> dict[str, Array]:
    """Points (..., T, P, 3) by their conventional names, with those that are derived.

    ``pelvis`` is the middle between the hips where there are hips, else the point ``pelvis`` or ``hip`` itself. ``trunk`` is
    the vector from the pelvis to the middle between the shoulders.
    """
    found = {conventional(name): points[..., index, :] for index, name in enumerate(names)}
    if "left_hip" in found and "right_hip" in found:
        found["pelvis"] = (found["left_hip"] + found["right_hip"]) / 2
    elif "pelvis" not in found and "hip" in found:
        found["pelvis"] = found["hip"]
    if {"pelvis", "left_shoulder", "right_shoulder"} <= set(found):
        found["trunk"] = (found["left_shoulder"] + found["right_shoulder"]) / 2 - found["pelvis"]
    return found if up is None else found | {"up": up}


def missing_points(angle: Angle, points: Points) -> list[str]:
    """Names of what an angle needs and the points lack."""
    return [need for need in angle.needs if need not in points]
