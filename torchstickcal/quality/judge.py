"""The judgement of a calibration: all findings, and the verdict that follows."""

from __future__ import annotations

from dataclasses import replace

import torch

from torchstickcal.quality.evidence import Evidence
from torchstickcal.quality.finding import Finding, Severity
from torchstickcal.quality.registry import FAMILIES, Family
from torchstickcal.quality.verdict import Acceptance, Quality
from torchstickcal.workers import on_worker

_NOISY_MRAD = 5.0
"""Noise of the keypoints above which causes are tried even where another was found: good detectors have 1 to 4. So they are
where several things are wrong, which may have one cause."""


def judged(evidence: Evidence) -> Quality:
    """The findings on a session, and the acceptance test. Causes are tried only where something is wrong."""
    return on_worker(evidence.state.points.device, _judged, evidence)


def _judged(evidence: Evidence) -> Quality:
    first = [family for family in FAMILIES.values() if not family.tries]
    found = {family: _findings(family, evidence) for family in first}
    if not evidence.consistent and any(f.is_cause for family, own in found.items() if not family.small for f in own):
        found = {family: [_as_effect(f) for f in own] if family.small else own for family, own in found.items()}
    every = [finding for own in found.values() for finding in own]
    wrong = any(finding.severity >= Severity.SERIOUS for finding in every)
    large = any(finding.is_cause for family, own in found.items() if not family.small for finding in own)
    serious = [family for family, own in found.items() if any(f.severity >= Severity.SERIOUS for f in own)]
    single = evidence.noise_mrad < _NOISY_MRAD and len(serious) < 2
    explained = single and (large or (evidence.consistent and any(f.is_cause for f in every)))
    doubtful = any(finding.code == "camera_doubtful" for finding in every)
    if bool(evidence.off_centre.any()) or ((wrong or doubtful) and not explained):
        causes = [finding for family in FAMILIES.values() if family.tries for finding in _findings(family, evidence)]
        if causes:
            every = [finding for family, own in found.items() if not family.small for finding in own]
        every = causes + every
    return Quality.of(every, _acceptance(evidence))


def _as_effect(finding: Finding) -> Finding:
    """A small error beside a large one, among cameras that do not agree: it may be nothing but an effect of the large one."""
    return replace(finding, is_cause=False)


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
