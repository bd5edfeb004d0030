"""The judgement of a calibration: all findings, and the verdict that follows."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import torch

from torchstickcal.pipeline.inference import inference_of
from torchstickcal.quality.evidence import Evidence
from torchstickcal.quality.finding import Finding, Severity
from torchstickcal.quality.registry import FAMILIES, Family
from torchstickcal.quality.verdict import Acceptance, Quality
from torchstickcal.workers import on_worker

_NOISY_MRAD = 5.0
"""Noise of the keypoints above which causes are tried even where another was found: good detectors have 1 to 4. So they are
where several things are wrong, which may have one cause."""
_NOISY_OF_THREE_MRAD = 3.5
"""The same with three cameras: there the points give way to a camera that shows something else. It makes noise, and few of its
keypoints disagree."""


def judged(evidence: Evidence) -> Quality:
    """The findings on a session, and the acceptance test. Causes are tried only where something is wrong."""
    return on_worker(evidence.state.points.device, _judged_in_mode, evidence)


def _judged_in_mode(evidence: Evidence) -> Quality:
    with inference_of(evidence.observations, evidence.config, (family.look for family in FAMILIES.values())):
        return _judged(evidence)


def _judged(evidence: Evidence) -> Quality:
    found = {family: _findings(family, evidence) for family in FAMILIES.values() if not family.tries}
    large = [finding for family, own in found.items() if not family.small for finding in own]
    small = [finding for family, own in found.items() if family.small for finding in own]
    if not evidence.consistent and any(finding.is_cause for finding in large):
        small = [_as_effect(finding) for finding in small]
    causes: list[Finding] = []
    if _worth_trying(evidence, found):
        causes = [finding for family in FAMILIES.values() if family.tries for finding in _findings(family, evidence)]
    if any(finding.is_cause for finding in causes):
        large, small = list(_as_effects(found)), []
    return Quality.of([*causes, *large, *small], _acceptance(evidence))


def _worth_trying(evidence: Evidence, found: dict[Family, list[Finding]]) -> bool:
    """Whether something is wrong, or may be, that no finding explains."""
    unexplained = evidence.off_centre | evidence.set_aside_at_end
    if any(camera not in evidence.changes_at_end for camera in unexplained.nonzero().flatten().tolist()):
        return True
    every = [finding for own in found.values() for finding in own]
    wrong = any(finding.severity >= Severity.SERIOUS or finding.code == "camera_doubtful" for finding in every)
    wrong |= bool((evidence.misfits | evidence.hidden).any())
    wrong |= evidence.cameras == 3 and evidence.noise_mrad > _NOISY_OF_THREE_MRAD
    explaining = [family for family, own in found.items() if any(finding.is_cause for finding in own)]
    serious = [family for family, own in found.items() if any(finding.severity >= Severity.SERIOUS for finding in own)]
    alone = len(serious) < 2 and evidence.noise_mrad < _NOISY_MRAD
    explained = any(family.direct or (alone and (evidence.consistent or not family.small)) for family in explaining)
    return wrong and not explained


def _as_effects(found: dict[Family, list[Finding]]) -> Iterator[Finding]:
    """What is found beside a cause that a trial found: no small errors, and what is fatal is an effect of this cause, unless it
    follows from what was given."""
    for family, own in found.items():
        for finding in own if not family.small else ():
            yield finding if family.direct or finding.severity < Severity.FATAL else _as_effect(finding)


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
