"""Cameras that moved during the session."""

from __future__ import annotations

from collections.abc import Iterator

from torchstickcal.quality.evidence import CONSTANT_SIGMAS, Evidence
from torchstickcal.quality.finding import Finding, Severity
from torchstickcal.quality.moved import LEAST_EVIDENCE
from torchstickcal.quality.registry import findings

_HARMLESS_DEG, _HARMLESS_SHARE = 0.2, 0.002
"""A change that is smaller than this angle, and this share of the rig, makes the cameras wrong by less than 1 %."""
_LEAST_DRIFT = 150.0
"""Evidence of a drift. Errors of a detector that depend on where the athlete is look alike where he walks along a path."""
_OWN_EVIDENCE, _CLEAR_EVIDENCE, _STRONG_EVIDENCE = 24.0, 45.0, 75.0
"""Evidence against the camera beyond that against the best other camera, that it needs where it is not certain which camera
moved, or a part of the errors of the keypoints is always the same; unless its evidence is clear, or in the second case strong.
Errors of a detector that change with the athlete's pose pull at all cameras at the same time."""
_RIVAL_SHARE = 0.7
"""Evidence against another camera, as a share, from which on it is not certain which of both moved."""


@findings("motion", "cameras that moved during the session", small=True)
def motion(evidence: Evidence) -> Iterator[Finding]:
    """The camera that moved, when and how far. A lens or a clock that is wrong looks alike, and explains more where it is."""
    found = evidence.motion
    if found is None or found.evidence < LEAST_EVIDENCE or not evidence.explains_most("motion"):
        return
    name = evidence.camera(found.camera)
    harmless = found.rotation_deg < _HARMLESS_DEG and found.shift_m < _HARMLESS_SHARE * evidence.rig_m
    amount = f"by {found.rotation_deg:.2g} degrees and {1000 * found.shift_m:.2g} mm"
    doubt = found.rival > _RIVAL_SHARE * found.evidence
    varying = evidence.constant_errors_sigmas < CONSTANT_SIGMAS
    alone = found.evidence > found.rival + _OWN_EVIDENCE or (varying and not doubt)
    strong = found.evidence > (_CLEAR_EVIDENCE if varying else _STRONG_EVIDENCE)
    if found.evidence < _LEAST_DRIFT if found.gradual else not (alone or strong):
        return
    which = f"{name}, or a camera beside it," if doubt else name
    last = evidence.observations.num_frames - 1
    if found.gradual:
        meaning = f"{which} drifted during the session, {amount} from its beginning to its end."
        advice = "Fix the camera, and calibrate it again; a lens or a clock that is wrong can look alike."
        frames = (0, last)
    else:
        meaning = f"{which} moved {amount} between frames {found.frame - 1} and {found.frame} (± 2)."
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
        limit=LEAST_EVIDENCE**0.5,
        unit="standard deviations",
        is_cause=True,
    )
