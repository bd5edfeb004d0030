"""Residuals that are not noise: errors that last, and errors that are always the same."""

from __future__ import annotations

from collections.abc import Iterator

import torch

from torchstickcal.quality.evidence import Evidence
from torchstickcal.quality.finding import Finding, Severity
from torchstickcal.quality.registry import findings

_LASTING_FRAMES = 3.0
_BIASED_SIGMAS = 0.5
_LEAST_FRAMES = 20


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
    m = evidence.kept
    sums = torch.zeros(evidence.cameras, 2, m.points_per_frame, dtype=torch.float64, device=m.pixels.device)
    for columns, found, _ in m.residuals(evidence.state):
        seen = m.visible[0][:, None, columns]
        sums += found[0].double().where(seen, 0.0).unflatten(-1, (-1, m.points_per_frame)).sum(-2)
    count = m.by_frame(m.visible[0]).sum(1)
    mean = sums / count.clamp_min(1)[:, None] / evidence.sigma_px
    enough = (count >= _LEAST_FRAMES)[:, None].expand_as(mean)
    if not bool(enough.any()):
        return
    bias = float(mean[enough].square().mean().sqrt())
    if bias > _BIASED_SIGMAS:
        yield Finding(
            "errors_constant",
            Severity.NOTE,
            f"A part of the keypoints' errors is always the same, {bias:.2g} times their noise: the detector places joints "
            "differently in different views.",
            "Such errors do not become smaller with more frames, but with more directions from which the athlete is seen.",
            figure=bias,
            limit=_BIASED_SIGMAS,
            unit="noise",
        )
