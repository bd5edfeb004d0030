"""The judgement of a calibration: all findings, and the verdict that follows."""

from __future__ import annotations

from torchstickcal.quality.evidence import Evidence
from torchstickcal.quality.finding import Severity
from torchstickcal.quality.registry import FAMILIES
from torchstickcal.quality.verdict import Quality
from torchstickcal.workers import on_worker


def judged(evidence: Evidence) -> Quality:
    """The findings on a session, and the acceptance test. Causes are tried only where something is wrong."""
    return on_worker(evidence.state.points.device, _judged, evidence)


def _judged(evidence: Evidence) -> Quality:
    first = [family for family in FAMILIES.values() if not family.tries]
    found = {family: list(family.look(evidence)) for family in first}
    every = [finding for own in found.values() for finding in own]
    wrong = any(finding.severity >= Severity.SERIOUS for finding in every)
    large = any(finding.is_cause for family, own in found.items() if not family.small for finding in own)
    told = large or (evidence.consistent and any(finding.is_cause for finding in every))
    doubtful = any(finding.code == "camera_doubtful" for finding in every)
    if (wrong or doubtful) and not told:
        causes = [finding for family in FAMILIES.values() if family.tries for finding in family.look(evidence)]
        if causes:
            every = [finding for family, own in found.items() if not family.small for finding in own]
        every += causes
    return Quality.of(every, evidence.acceptance)
