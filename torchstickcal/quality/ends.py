"""Frames of a camera that were set aside at an end of the session: why they contradict the others.

All keypoints of such frames contradict the other cameras, as if they showed another person. The same happens where the camera
moved far, and where frames of its video were lost. Each is tried, and said only where the keypoints then agree closely.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchstickcal.geometry.cameras import Intrinsics
from torchstickcal.quality.resection import Resection, at_later_frames, placed_at, resected

_LEAST_FRAMES, _RUN_SHARE = 3, 0.9
"""Number of frames at an end that say why they were set aside, and their share of all frames that were set aside."""
_LATEST = 15
"""Most frames by which those at an end are looked for at another time."""
_AGREEING_SHARE, _NEAR_SIGMAS = 0.75, 2.5
"""Share of the keypoints that agree by an explanation, and their median distance from the points in noise, from which on it is
one. Another person in a similar pose is farther off."""
_CLEARLY_LESS = 0.8
"""Median distance at another time over that at the times before and after, where that time is the only one that fits."""


class ChangeAtEnd(NamedTuple):
    """Why frames at an end of the session were set aside."""

    frame: int
    """the first frame after the change"""
    at_start: bool
    """whether the frames before it were set aside, rather than those from it on"""
    frames: int
    """how many were"""
    later: int
    """frames by which they belong to later ones of the other cameras; 0 where the camera was at another place"""
    placed: Resection
    """the camera as it was in these frames"""


def change_at_end(
    set_aside: Tensor, points: Tensor, keypoints: Tensor, sigma_px: Tensor, camera: Intrinsics, pose: tuple[Tensor, Tensor]
) -> ChangeAtEnd | None:
    """The change that explains frames which were set aside at an end; None where there are none, or nothing explains them.

    Args:
        set_aside: (F,), the frames.
        points: (3, F, P), by the other cameras, metres; NaN where not known.
        keypoints: (F, P, 2), of the camera; NaN where not seen.
        sigma_px: (P,), noise of each point's keypoints.
        camera: its intrinsics, (1,).
        pose: where it is in the other frames, rotation (3, 3) and translation (3,).
    """
    count, total = int(set_aside.sum()), len(set_aside)
    seen = keypoints.isfinite().all(-1).any(-1)
    for at_start in (True, False):
        others = (~set_aside & seen).nonzero().flatten()
        if count < _LEAST_FRAMES or not len(others):
            return None
        frame = int(others[0]) if at_start else int(others[-1]) + 1
        run = slice(0, frame) if at_start else slice(frame, total)
        if int(set_aside[run].sum()) < _RUN_SHARE * count:
            continue
        chosen = torch.zeros_like(set_aside)
        chosen[run] = set_aside[run]
        later, placed = _explained(chosen, points, keypoints, sigma_px, camera, pose)
        if placed is not None:
            return ChangeAtEnd(frame, at_start, int(chosen.sum()), later, placed)
    return None


def _explained(
    chosen: Tensor, points: Tensor, keypoints: Tensor, sigma_px: Tensor, camera: Intrinsics, pose: tuple[Tensor, Tensor]
) -> tuple[int, Resection | None]:
    """Another time, by frames, or else another place of the camera."""

    def placed(later: int, moved: bool) -> Resection | None:
        at_time = at_later_frames(points, later)
        known = at_time.isfinite().all(0) & keypoints.isfinite().all(-1) & chosen[:, None]
        seen = at_time[:, known], keypoints[known].mT, sigma_px.expand(known.shape)[known], camera
        return resected(*seen) if moved else placed_at(*seen, pose)

    at_times = {later: found for later in range(-_LATEST, _LATEST + 1) if later and (found := placed(later, False)) is not None}
    if at_times:
        best = min(at_times, key=lambda later: at_times[later].distance_sigmas)
        beside = [at_times[later].distance_sigmas for later in (best - 2, best + 2) if later in at_times]
        alone = all(at_times[best].distance_sigmas < _CLEARLY_LESS * distance for distance in beside)
        if _fits(at_times[best]) and alone and abs(best) < _LATEST:
            return best, at_times[best]
    elsewhere = placed(0, True)
    return 0, elsewhere if elsewhere is not None and _fits(elsewhere) else None


def _fits(placed: Resection) -> bool:
    return placed.share > _AGREEING_SHARE and placed.distance_sigmas < _NEAR_SIGMAS
