"""A camera that moved far during the session, so that its two places are found one by one."""

from __future__ import annotations

from torch import Tensor

from torchstickcal.geometry import se3
from torchstickcal.metrics import rotation_angle
from torchstickcal.quality.evidence import Evidence
from torchstickcal.quality.finding import Finding, Severity

FARTHEST_DEG, _FARTHEST_SHARE = 45.0, 0.3
"""Largest change of a camera that is a motion of it, the shift as a share of the rig; beyond, it shows something else."""


def moved_far(
    evidence: Evidence, camera: int, frame: int, before: tuple[Tensor, Tensor], after: tuple[Tensor, Tensor], note: str = ""
) -> Finding | None:
    """That a camera was at two places, rotation (3, 3) and translation (3,) each; None if they are farther apart than it moves.

    Args:
        evidence: of the session.
        camera: which.
        frame: the first one at the second place.
        before: the first place.
        after: the second.
        note: what else is said.
    """
    name = evidence.camera(camera)
    angle = float(rotation_angle(after[0] @ before[0].mT).rad2deg())
    shift = float((se3.camera_centres(*after) - se3.camera_centres(*before)).norm())
    if angle > FARTHEST_DEG or shift > _FARTHEST_SHARE * evidence.rig_m:
        return None
    return Finding(
        "camera_moved",
        Severity.SERIOUS,
        f"{name} moved by {angle:.2g} degrees and {1000 * shift:.2g} mm between frames {frame - 1} and {frame} (± 2){note}.",
        "Calibrate the frames before and after it separately (Observations.with_camera_split).",
        cameras=(name,),
        frames=(frame, evidence.observations.num_frames - 1),
        figure=angle,
        unit="deg",
        is_cause=True,
    )
