"""Cameras that moved during the session."""

from __future__ import annotations

from collections.abc import Iterator

from torchstickcal.quality.evidence import Evidence
from torchstickcal.quality.finding import Finding, Severity
from torchstickcal.quality.moved import Motion
from torchstickcal.quality.registry import findings

_HARMLESS_DEG, _HARMLESS_SHARE = 0.2, 0.002
"""A change that is smaller than this angle, and this share of the rig, makes the cameras wrong by less than 1 %."""
_LEAST_DRIFT = 150.0
"""Evidence of a drift. Errors of a detector that depend on where the athlete is look alike where he walks along a path."""
_RIVAL_SHARE = 0.7
"""Evidence against another camera, as a share, from which on it is not certain which of both moved."""


@findings("motion", "cameras that moved during the session", small=True)
def motion(evidence: Evidence) -> Iterator[Finding]:
    """The camera that moved, when and how far. A lens or a clock that is wrong looks alike, and explains more where it is."""
    found = evidence.motion
    if found is None:
        return
    least = max(found.least, _LEAST_DRIFT) if found.gradual else found.least
    if found.evidence < least or not evidence.explains_most("motion"):
        return
    name = evidence.camera(found.camera)
    like_shift_m = _like_shift_m(evidence, found)
    shift_m = like_shift_m if found.like_turn else found.shift_m
    harmless = found.rotation_deg < _HARMLESS_DEG and shift_m < _HARMLESS_SHARE * evidence.rig_m
    doubt = found.rival > _RIVAL_SHARE * found.evidence
    which = f"{name}, or a camera beside it," if doubt else name
    last = evidence.observations.num_frames - 1
    if found.like_turn:
        like_shift = f", or shifted by {1000 * like_shift_m:.2g} mm across its axis" if like_shift_m else ""
        amount = f"as if turned by {found.rotation_deg:.2g} degrees{like_shift}"
    else:
        amount = f"by {found.rotation_deg:.2g} degrees and {1000 * shift_m:.2g} mm"
    if found.gradual:
        meaning = f"{which} drifted during the session, {amount} from its beginning to its end."
        advice = "Fix the camera, and calibrate it again; a lens or a clock that is wrong can look alike."
        frames = (0, last)
    else:
        meaning = f"{which} moved {amount}, between frames {found.frame - 1} and {found.frame} (± {max(1, found.frame_error)})."
        advice = "Calibrate the frames before and after it separately (Observations.with_camera_split)."
        frames = (found.frame, last)
    yield Finding(
        "camera_drifted" if found.gradual else "camera_moved",
        Severity.CAUTION if harmless or (found.gradual and doubt) else Severity.SERIOUS,
        meaning,
        advice,
        cameras=(name,),
        frames=frames,
        figure=found.evidence**0.5,
        limit=least**0.5,
        unit="standard deviations",
        is_cause=True,
    )


def _like_shift_m(evidence: Evidence, found: Motion) -> float:
    """The shift of a camera that moves its image as its turn does, at the distance of its points, metres; 0 for a turn that is
    mostly about its axis, which no shift is like."""
    turn = evidence.state.rotations[0, found.camera] @ found.tangent[3:]
    across = float(turn[:2].norm())
    distances = (evidence.points - evidence.centres[found.camera][:, None, None]).norm(dim=0)
    return across * float(distances.nanmedian()) if across > abs(float(turn[2])) else 0.0
