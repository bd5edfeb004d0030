"""Figures of the paper that belong to no single method: Yang et al., "Multi-Camera Self-Calibration in Sports Motion Capture".

FG 2026. All are of its 160 sequences. The errors that it reports for a method stand where the method is defined.
"""

from __future__ import annotations

from torchstickcal.benchmark.baselines import PublishedErrors

NOT_RUN: dict[str, PublishedErrors | None] = {"HSfM": PublishedErrors(0.193, 0.117), "MapAnything": None, "VGGT": None}
"""Methods that need images and trained weights, with the errors that the paper reports, if any."""

MEMORY_MB: dict[int, tuple[float, float, float]] = {
    3: (0.08, 0.2, 1.5),
    4: (0.09, 0.2, 2.1),
    5: (0.11, 0.2, 2.6),
    6: (0.13, 0.3, 3.2),
    7: (0.14, 0.3, 3.8),
    8: (0.16, 0.4, 4.4),
    9: (0.18, 0.4, 5.0),
    10: (0.19, 0.5, 5.6),
}
"""By number of cameras: input, typical and worst peak memory of the last adjustment, megabytes."""

MEDIAN_SECONDS: dict[int, float] = {3: 21.0, 10: 39.0}
"""By number of cameras: median run time, seconds, where the text or a figure of the paper gives it."""
