"""What the body of the athlete says: its height, and whether left and right are exchanged in space."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from torchstickcal.geometry.vectors import lengths
from torchstickcal.quality.evidence import Evidence
from torchstickcal.quality.finding import Finding, Severity
from torchstickcal.quality.handedness import MIRRORED_SHARE, mirrored_share
from torchstickcal.quality.registry import findings

_SEGMENTS = {("knee", "ankle"): 0.246, ("hip", "knee"): 0.245, ("shoulder", "elbow"): 0.186, ("elbow", "wrist"): 0.146}
"""Lengths of segments as shares of the standing height (Drillis and Contini 1966, in Winter's tables)."""
_TALL_M, _SHORT_M = 2.10, 1.35
_TALLEST_M, _SHORTEST_M = 2.4, 1.1
"""Standing heights, by the segments, that are unusual, and those that no athlete has. Heights from a detector's joints are
wrong by up to 8 %."""
_LEAST_FRAMES, _LEAST_LENGTHS = 15, 8
"""Frames in which a limb counts by itself, and lengths of all limbs together that count where no limb does."""


@findings("body", "the athlete's height, and left and right exchanged in space")
def body(evidence: Evidence) -> Iterator[Finding]:
    """Findings about the body."""
    names = evidence.observations.point_names
    if names is None:
        return
    places = {name: index for index, name in enumerate(names)}
    yield from _height(evidence, places)
    yield from _mirrored(evidence)


def height_m(points: Tensor, places: dict[str, int]) -> float | None:
    """The athlete's standing height by the lengths of the limbs; None where no limb is known.

    Args:
        points: (3, F, P), metres, NaN where not known.
        places: index of each named point.
    """
    found: list[Tensor] = []
    for (start, end), share in _SEGMENTS.items():
        for side in ("left", "right"):
            pair = [places.get(f"{side}_{joint}") for joint in (start, end)]
            if None not in pair:
                segments = lengths(points[..., pair[1]] - points[..., pair[0]])
                found.append(segments[segments.isfinite()] / share)
    if known := [heights.median() for heights in found if len(heights) >= _LEAST_FRAMES]:
        return float(torch.stack(known).median())
    together = torch.cat(found) if found else points.new_zeros(0)
    return float(together.median()) if len(together) >= _LEAST_LENGTHS else None


def _height(evidence: Evidence, places: dict[str, int]) -> Iterator[Finding]:
    height = height_m(evidence.points_with_depth, places)
    if height is None or _SHORT_M <= height <= _TALL_M:
        return
    impossible = not _SHORTEST_M <= height <= _TALLEST_M
    yield Finding(
        "athlete_height",
        Severity.SERIOUS if impossible else Severity.CAUTION,
        f"By the lengths of the limbs the athlete is {height:.2f} m tall: if that is not so, the length of the stick, and with "
        "it the scale, is wrong by the same share.",
        "Check the length of the stick, its unit, and which points are its ends.",
        figure=height,
        limit=_TALL_M if height > _TALL_M else _SHORT_M,
        unit="m",
        is_cause=evidence.consistent,
    )


def _mirrored(evidence: Evidence) -> Iterator[Finding]:
    """A scene that is its own mirror image."""
    share = mirrored_share(evidence.points, evidence.observations.point_names)
    if share > MIRRORED_SHARE:
        yield Finding(
            "scene_mirrored",
            Severity.SERIOUS,
            f"In {100 * share:.0f} % of the frames the athlete's right side is on the left: all videos are mirrored, and the "
            "rig is its own mirror image, or the names of left and right are exchanged.",
            "Mirror the keypoints of all cameras, x to width - 1 - x, or exchange the names.",
            figure=share,
            limit=MIRRORED_SHARE,
            unit="share",
            is_cause=evidence.consistent,
        )
