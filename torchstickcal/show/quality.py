"""The verdict with its findings and the acceptance test, as a text for people."""

from __future__ import annotations

from torchstickcal.quality.finding import Finding, Severity
from torchstickcal.quality.verdict import Acceptance, Quality, Verdict
from torchstickcal.show.look import TERMINAL_COLOURS, share, wrapped

_MEANINGS = {
    Verdict.GOOD: "nothing speaks against the result",
    Verdict.USABLE: "the result can be used with care",
    Verdict.POOR: "the result is probably wrong, or much less precise than it could be",
    Verdict.FAILED: "the result, or a part of it, must not be used",
}


def colour_of(verdict: Verdict) -> str:
    """Parameters of a terminal's sequence SGR: green, yellow or red."""
    return TERMINAL_COLOURS[verdict]


def meaning_of(verdict: Verdict) -> str:
    """What a verdict means, in some words."""
    return _MEANINGS[verdict]


def reasons_text(quality: Quality, notes: bool = False) -> str:
    """The findings, and the acceptance test with the sentence about a length of 1 m; empty if there is nothing to say.

    Args:
        quality: of a calibration.
        notes: whether findings that do not change the verdict are shown too.
    """
    lines = [line for one in quality.findings if notes or one.severity > Severity.NOTE for line in _shown(one)]
    if quality.acceptance is not None:
        lines += [*([""] if lines else []), *_accepted(quality.acceptance)]
    return "\n".join(lines)


def _shown(finding: Finding) -> list[str]:
    text = f"{finding.severity.name.lower()}: {finding.text} [{finding.code}]"
    return wrapped(text, "  ", "    ")


def _accepted(acceptance: Acceptance) -> list[str]:
    lines = [acceptance.sentence]
    for one in acceptance.lengths:
        x, y, z = one.volume_m
        lines.append(
            f"{one.stick}, in {one.frames} frames that took no part{_wrong(one.wrong)}: largest error "
            f"{1000 * one.largest_m:+.2f} mm, mean error {1000 * one.mean_m:+.2f} mm, standard deviation "
            f"{1000 * one.std_m:.2f} mm; {share(one.inside)} inside their 95 % intervals; volume {x:.2g} x {y:.2g} x {z:.2g} m"
        )
    lines.append(
        f"reprojection {acceptance.reprojection_px:.2f} px ({acceptance.reprojection_mrad:.2f} mrad), rays "
        f"{1000 * acceptance.ray_distance_m:.1f} mm from their points"
    )
    known = [px for px in acceptance.left_out_px if px == px]
    if known:
        lines.append(f"each camera predicted by the others: {', '.join(f'{px:.2f}' for px in acceptance.left_out_px)} px")
    if acceptance.focal_sentence:
        lines.append(acceptance.focal_sentence)
    return [part for line in lines for part in wrapped(line)]


def _wrong(count: int) -> str:
    return f" ({count} of them wrong, and left out here)" if count else ""
