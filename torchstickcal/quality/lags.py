"""Whether a camera's frames belong to other frames of the others, by the points in which the rays of the others meet."""

from __future__ import annotations

import torch
from torch import Tensor

from torchstickcal.pipeline.relabel.views import RayViews
from torchstickcal.quality.evidence import Evidence

_MOST_FRAMES, _LARGEST_LAG = 600, 15
_AGREEING_SHARE = 0.5
"""Least share of each camera's keypoints that must agree with the others for the points to say anything."""
_LEAST_KEYPOINTS = 50
_QUANTILE, _CLEARLY_LESS = 0.75, 0.75
"""Quantile of the squared distances, large enough for points that move; and what it is at another lag, over that of equal
frames, from which on the frames are apart."""


def frames_are_apart(evidence: Evidence) -> bool | None:
    """Whether the keypoints of some camera clearly fit the points of the other cameras better some frames earlier or later.

    None where that cannot be said: with two cameras, or where the cameras agree too little.
    """
    m = evidence.measurements
    if evidence.cameras < 3 or float(evidence.agreement.min()) < _AGREEING_SHARE or m.frames < 3 * _LARGEST_LAG:
        return None
    start = max(0, (m.frames - _MOST_FRAMES) // 2)
    frames = torch.arange(start, min(start + _MOST_FRAMES, m.frames), device=m.pixels.device)
    views = RayViews.of(m, evidence.state, evidence.sigma_px, frames)
    return any(_is_apart(views, camera) for camera in range(evidence.cameras))


def _is_apart(views: RayViews, camera: int) -> bool:
    points = views.points([other for other in range(len(views.rays)) if other != camera])
    one = slice(camera, camera + 1)
    alone = RayViews(views.rays[one], views.weights[one], views.rotations[one], views.translations[one], views.sigma[one])
    squared = {lag: _distance_at(alone, points, lag) for lag in range(-_LARGEST_LAG, _LARGEST_LAG + 1)}
    return min(squared.values()) < _CLEARLY_LESS * squared[0]


def _distance_at(alone: RayViews, points: Tensor, lag: int) -> float:
    """A quantile of one camera's squared distances from the points some frames earlier; infinite where few are known."""
    count = points.shape[1] - abs(lag)
    own, theirs = slice(max(lag, 0), max(lag, 0) + count), slice(max(-lag, 0), max(-lag, 0) + count)
    seen = alone.at_frames(own)
    squared = seen.squared_distances(points[:, theirs])[0]
    known = (seen.weights[0] > 0) & points[:, theirs].isfinite().all(0)
    return float(squared[known].quantile(_QUANTILE)) if int(known.sum()) >= _LEAST_KEYPOINTS else torch.inf
