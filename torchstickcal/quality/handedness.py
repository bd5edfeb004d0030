"""Whether a scene is its own mirror image, by the athlete in it: knees, toes and nose say where forward is."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from torchstickcal.geometry.vectors import lengths

MIRRORED_SHARE = 0.8
"""Share of the frames in which the right side is on the left, from which on a scene is mirrored."""
_LEAST_FRAMES = 15
_CLEAR = 0.2
"""Volume that right, forward and up span, over that of a right-angled box, from which on a frame says something."""


def mirrored_share(points: Tensor, names: Sequence[str] | None) -> float:
    """Share of the frames in which the athlete's right side is on the left; 0 where too little of the body is known.

    Args:
        points: (3, F, P), metres, NaN where not known.
        names: of the points; None where they have none.
    """
    places = {name: index for index, name in enumerate(names or ())}

    def at(name: str) -> Tensor | None:
        return points[..., places[name]] if name in places else None

    def middle(candidates: Sequence[str]) -> Tensor | None:
        known = [place for name in candidates if (place := at(name)) is not None]
        return torch.stack(known).mean(0) if known else None

    shoulders = at("left_shoulder"), at("right_shoulder")
    low = middle(["left_hip", "right_hip"])
    low = low if low is not None else middle(["pelvis", "hip"])
    if shoulders[0] is None or shoulders[1] is None or low is None:
        return 0.0
    right = shoulders[1] - shoulders[0]
    up = (shoulders[0] + shoulders[1]) / 2 - low
    forward = torch.zeros_like(up)
    for side in ("left", "right"):
        hip = at(f"{side}_hip")
        hip = hip if hip is not None else low
        knee, ankle = at(f"{side}_knee"), at(f"{side}_ankle")
        if knee is not None and ankle is not None:
            forward = forward + (knee - (hip + ankle) / 2).nan_to_num()
        toe, heel = at(f"{side}_big_toe"), at(f"{side}_heel")
        if toe is not None and heel is not None:
            forward = forward + (toe - heel).nan_to_num()
    nose, ears = at("nose"), middle(["left_ear", "right_ear"])
    if nose is not None and ears is not None:
        forward = forward + 2 * (nose - ears).nan_to_num()
    handed = (right * torch.linalg.cross(forward, up, dim=0)).sum(0)
    size = lengths(right) * lengths(forward) * lengths(up)
    clear = handed.isfinite() & (handed.abs() > _CLEAR * size) & (size > 0)
    return float((handed[clear] < 0).double().mean()) if int(clear.sum()) >= _LEAST_FRAMES else 0.0
