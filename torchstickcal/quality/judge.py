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
    found = [finding for family in FAMILIES.values() if not family.tries for finding in family.look(evidence)]
    wrong = any(finding.severity >= Severity.SERIOUS for finding in found)
    if wrong and not (evidence.consistent and any(finding.is_cause for finding in found)):
        found += [finding for family in FAMILIES.values() if family.tries for finding in family.look(evidence)]
    return Quality.of(found, evidence.acceptance)
