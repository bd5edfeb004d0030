"""The judgement of a calibration: all findings, and the verdict that follows."""

from __future__ import annotations

import torch

from torchstickcal.quality.evidence import Evidence
from torchstickcal.quality.finding import Finding, Severity
from torchstickcal.quality.registry import FAMILIES, Family
from torchstickcal.quality.verdict import Acceptance, Quality
from torchstickcal.workers import on_worker


def judged(evidence: Evidence) -> Quality:
    """The findings on a session, and the acceptance test. Causes are tried only where something is wrong."""
    return on_worker(evidence.state.points.device, _judged, evidence)


def _judged(evidence: Evidence) -> Quality:
    first = [family for family in FAMILIES.values() if not family.tries]
    found = {family: _findings(family, evidence) for family in first}
    every = [finding for own in found.values() for finding in own]
    wrong = any(finding.severity >= Severity.SERIOUS for finding in every)
    large = any(finding.is_cause for family, own in found.items() if not family.small for finding in own)
    explained = large or (evidence.consistent and any(finding.is_cause for finding in every))
    doubtful = any(finding.code == "camera_doubtful" for finding in every)
    if bool(evidence.off_centre.any()) or ((wrong or doubtful) and not explained):
        causes = [finding for family in FAMILIES.values() if family.tries for finding in _findings(family, evidence)]
        if causes:
            every = [finding for family, own in found.items() if not family.small for finding in own]
        every += causes
    return Quality.of(every, _acceptance(evidence))


def _findings(family: Family, evidence: Evidence) -> list[Finding]:
    """What a family finds; where a system cannot be solved, that this could not be checked."""
    try:
        return list(family.look(evidence))
    except torch.linalg.LinAlgError:
        meaning = f"This could not be checked, because the keypoints determine too little: {family.description}."
        return [Finding("not_checked", Severity.CAUTION, meaning)]


def _acceptance(evidence: Evidence) -> Acceptance | None:
    try:
        return evidence.acceptance
    except torch.linalg.LinAlgError:  # points that are not finite
        return None
