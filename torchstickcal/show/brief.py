"""A calibration in one line, and as a small table for notebooks: the verdict first."""

from __future__ import annotations

from html import escape

from torchstickcal.quality.finding import Severity
from torchstickcal.result import Calibration
from torchstickcal.show.look import COLOURS
from torchstickcal.show.quality import meaning_of
from torchstickcal.show.tables import camera_facts, camera_table, printable


def brief_text(calibration: Calibration) -> str:
    """One line: verdict, size, how right a length is."""
    cameras, frames, points = calibration.inliers.shape
    verdict, acceptance = calibration.quality.verdict, calibration.quality.acceptance
    known = acceptance is not None and acceptance.metre_m < float("inf")
    right = f", 1 m is right to ± {1000 * acceptance.metre_m:.3g} mm" if acceptance is not None and known else ""
    return f"<Calibration: {verdict}, {cameras} cameras, {frames} frames, {points} points{right}>"


def brief_html(calibration: Calibration) -> str:
    """Verdict, findings that matter, the acceptance sentence and the table of the cameras, every text escaped."""
    quality = calibration.quality
    colour = COLOURS[quality.verdict.value].light
    findings = "".join(f"<li>{escape(printable(one.text))}</li>" for one in quality.findings if one.severity > Severity.NOTE)
    sentence = f"<p>{escape(quality.acceptance.sentence)}</p>" if quality.acceptance is not None else ""
    return (
        f'<div><p><b style="color:{colour}">{quality.verdict}</b>: {escape(meaning_of(quality.verdict))}</p>'
        f"{f'<ul>{findings}</ul>' if findings else ''}{sentence}{camera_table(camera_facts(calibration)).html()}</div>"
    )
