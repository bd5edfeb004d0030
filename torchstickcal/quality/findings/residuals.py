"""Residuals that are not noise: errors that last, and errors that are always the same."""

from __future__ import annotations

from collections.abc import Iterator

from torchstickcal.quality.evidence import CONSTANT_SIGMAS, Evidence
from torchstickcal.quality.finding import Finding, Severity
from torchstickcal.quality.registry import findings

_LASTING_FRAMES = 3.0


@findings("residuals", "errors of the keypoints that last, or are always the same")
def residuals(evidence: Evidence) -> Iterator[Finding]:
    """Findings about the residuals."""
    times = float(evidence.ended.last_camera_stage.correlation_frames[0].median())
    if times > _LASTING_FRAMES:
        yield Finding(
            "errors_last",
            Severity.NOTE,
            f"The errors of the keypoints are alike for several frames: {times:.0f} frames say as much as one. The "
            "deviations allow for it.",
            figure=times,
            limit=_LASTING_FRAMES,
            unit="frames",
        )
    bias = evidence.constant_errors_sigmas
    if bias > CONSTANT_SIGMAS:
        yield Finding(
            "errors_constant",
            Severity.NOTE,
            f"A part of the keypoints' errors is always the same, {bias:.2g} times their noise: the detector places joints "
            "differently in different views.",
            "Such errors do not become smaller with more frames, but with more directions from which the athlete is seen.",
            figure=bias,
            limit=CONSTANT_SIGMAS,
            unit="noise",
        )
