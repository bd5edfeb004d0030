"""The frame in which a calibration is given: of the first camera, of the athlete, or of what is known of the scene.

Estimation needs none of it: it happens in the frame of the first camera.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from torchstickcal.arrays import tensor_of
from torchstickcal.errors import CalibrationError
from torchstickcal.geometry import se3
from torchstickcal.metrics import align
from torchstickcal.world.body import Body
from torchstickcal.world.frame import Frame, World, upright_frame
from torchstickcal.world.upright import upright

__all__ = ["WORLDS", "Frame", "World", "athlete_frame", "floor_frame", "frame_of_cameras", "frame_of_points"]

WORLDS = ("camera", "athlete", "floor")
"""The frames that need nothing but the calibration itself."""

_COLLINEAR = 0.02
"""Second extent of known points, as a share of the first, below which they lie on a line."""
_WRONG_SCALE = 0.05
"""How much the distances of known points may differ from those found, as a share of them."""


def athlete_frame(points: Tensor, point_names: Sequence[str] | None, rotations: Tensor) -> Frame:
    """The athlete's frame: z up, x where the athlete faces at first, the origin on the floor below the feet at first.

    Args:
        points: (G, P, 3), metres, NaN where not known.
        point_names: P names.
        rotations: (C, 3, 3), world to camera.

    Raises:
        CalibrationError: if head or ankles are not known.
    """
    body = Body.of(points.cpu(), point_names)
    found = upright(body, rotations.double().cpu())
    facing = torch.linalg.cross(body.left, found.up.expand_as(body.left))
    known = (facing + body.ankles).isfinite().all(-1).nonzero().flatten()
    first = int(known[0]) if len(known) else int(body.ankles.isfinite().all(-1).nonzero()[0])
    forward = facing[first] if len(known) else rotations[0, 2].double().cpu()
    feet = body.ankles[first] * body.height_m
    below = feet + (found.floor - feet @ found.up) * found.up
    return upright_frame(found.up, forward, below, World(
        "athlete",
        "the point of the floor below the feet of the athlete in the first frame",
        "x where the athlete faces in that frame, y to the athlete's left, z up",
        "z", found.std_deg, found.floor_std_m,
    ))  # fmt: skip


def floor_frame(points: Tensor, point_names: Sequence[str] | None, rotations: Tensor, translations: Tensor) -> Frame:
    """The frame of the floor: z up, the origin on the floor below the first camera, x in its viewing direction.

    Arguments and errors as of :func:`athlete_frame`; ``translations`` are (C, 3).
    """
    body = Body.of(points.cpu(), point_names)
    rotations, translations = rotations.double().cpu(), translations.double().cpu()
    found = upright(body, rotations)
    centre = se3.camera_centres(rotations, translations)[0]
    steep = float((rotations[0, 2] @ found.up).abs()) > math.cos(math.radians(5))
    forward = -rotations[0, 1] if steep else rotations[0, 2]
    below = centre + (found.floor - centre @ found.up) * found.up
    return upright_frame(found.up, forward, below, World(
        "floor",
        "the point of the floor below the first camera",
        "x in the viewing direction of the first camera, y to its left, z up; the floor is below the athlete's feet",
        "z", found.std_deg, found.floor_std_m,
    ))  # fmt: skip


def frame_of_points(found: Any, known: Any) -> Frame:
    """The frame in which points have known positions, laid onto them by rotation and translation (least squares, no scale).

    Args:
        found: (n, 3), where the points are, metres, in the frame that there is.
        known: (n, 3), where they are in the frame that is wanted.

    Raises:
        CalibrationError: if there are fewer than three points, if they lie on one line, or if their distances differ.
    """
    found, known = (tensor_of(points, name).double().cpu() for points, name in ((found, "found"), (known, "known")))
    both = (found + known).isfinite().all(-1)
    found, known = found[both], known[both]
    extents = torch.linalg.svdvals(known - known.mean(0)) if len(known) else known
    if len(known) < 3 or float(extents[1]) <= _COLLINEAR * float(extents[0]):
        raise CalibrationError(
            "known points that do not fix a frame",
            where="world",
            got=f"{len(known)} points" + (", on one line" if len(known) >= 3 else ""),
            expected="3 points or more that do not lie on one line",
        )
    ratio = float((found - found.mean(0)).norm() / (known - known.mean(0)).norm())
    if abs(ratio - 1) > _WRONG_SCALE:
        raise CalibrationError(
            "known points are at other distances from each other than those found",
            where="world",
            got=f"distances that are {ratio:.3g} times as long",
            expected="positions in metres, of these points",
        )
    rotation, translation = align(found, known)
    return Frame(rotation, translation, World("points", "that of the known points", "axes of the known points"))


def frame_of_cameras(poses: Mapping[str, tuple[Tensor, Tensor]], known: Mapping[str, tuple[Tensor, Tensor]]) -> Frame:
    """The frame of another calibration with some of the same cameras, which have not been moved since.

    Args:
        poses: rotation (3, 3) and translation (3,) of each camera, world to camera, by name.
        known: the same in the frame that is wanted.

    Raises:
        CalibrationError: if they have no camera in common.
    """
    common = [name for name in poses if name in known]
    if not common:
        raise CalibrationError(
            "no camera in common", where="world", got=", ".join(known), expected=f"some of the cameras {', '.join(poses)}"
        )
    own, other = ([tuple(part.double().cpu() for part in side[name]) for name in common] for side in (poses, known))
    turns = torch.stack([theirs.mT @ mine for (mine, _), (theirs, _) in zip(own, other, strict=True)])
    u, _, vh = torch.linalg.svd(turns.mean(0))
    rotation = u @ torch.diag(torch.tensor([1.0, 1.0, float(torch.det(u @ vh))]).double()) @ vh
    centres, known_centres = (
        se3.camera_centres(*(torch.stack([pose[part] for pose in side]) for part in (0, 1))) for side in (own, other)
    )
    translation = (known_centres - centres @ rotation.mT).mean(0)
    return Frame(rotation, translation, World("calibration", "that of the given calibration", "axes of the given calibration"))
