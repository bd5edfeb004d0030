"""Frames at an end of the session that contradict the others because the camera moved far, or lost frames, before or after."""

from __future__ import annotations

from collections.abc import Iterator

from torchstickcal.quality.ends import ChangeAtEnd
from torchstickcal.quality.evidence import Evidence
from torchstickcal.quality.far import moved_far
from torchstickcal.quality.finding import Finding, Severity
from torchstickcal.quality.registry import findings


@findings("ends", "cameras that moved far, or lost frames, near an end of the session", direct=True)
def ends(evidence: Evidence) -> Iterator[Finding]:
    """Of each camera whose frames at an end were set aside: why, where that is known."""
    for camera, change in evidence.changes_at_end.items():
        if change.later:
            yield _at_another_time(evidence, camera, change)
            continue
        there = change.placed.rotation, change.placed.translation
        here = evidence.state.rotations[0, camera], evidence.state.translations[0, camera]
        before, after = (there, here) if change.at_start else (here, there)
        finding = moved_far(evidence, camera, change.frame, before, after, f"; the {_which(change)} were set aside")
        if finding is not None:
            yield finding


def _at_another_time(evidence: Evidence, camera: int, change: ChangeAtEnd) -> Finding:
    name, lag = evidence.camera(camera), abs(change.later)
    word = "later" if change.later > 0 else "earlier"
    last = evidence.observations.num_frames - 1
    return Finding(
        "clock_apart",
        Severity.SERIOUS,
        f"{name}: its {_which(change)} show what the other cameras see {lag} {'frame' if lag == 1 else 'frames'} {word}, and "
        "were set aside: frames were lost, or its clock jumped.",
        "Put an empty frame where each frame was lost, or cut the videos there.",
        cameras=(name,),
        frames=(0, change.frame - 1) if change.at_start else (change.frame, last),
        figure=float(lag),
        unit="frames",
        is_cause=True,
    )


def _which(change: ChangeAtEnd) -> str:
    return f"{change.frames} {'first' if change.at_start else 'last'} frames"
