"""The vertical and the floor, from a body that stands, from where its feet stand, and from cameras that stand upright.

Each says where up is, with an error of its own. A body leans, but is balanced over its feet on average. The places where feet
stand lie in a plane, as far as they are apart. Most cameras stand upright or on their side, so that one axis of their image is
horizontal; how well they do is seen from how well they agree. That the head is above the feet is never given up.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from torchstickcal.world.body import Body, moved_around

_CAMERA_DEG, _CAMERA_CASES = 1.3, 3
"""How far from upright cameras are before they are compared, and as many cameras as this counts for."""
_STEEP = 0.8
"""Largest share of a camera's viewing direction along the vertical: one that looks down has no upright."""
_FOOTHOLD, _CELL = 0.019, 0.125
"""How far from the floor a standing foot is, and the size of a place on which it stands, in heights of the body."""
_LEAST_STAY = 0.03
"""Share of the frames in which a foot is at one place, from which on it stands there."""
_STILL = 0.01
"""How far a standing foot moves within a few frames, in heights of the body."""
_CUT = 3.0
"""Scale of the robust kernel, in standard deviations."""
_ROUNDS = 15
_FURTHEST_FROM_BODY = math.cos(math.radians(45))
_LOW = 0.15
"""Quantile of a foot's heights at which it stands."""
_FLOOR = 0.007
"""How well it is known how high a joint of a standing foot is, in heights of the body."""


class Upright(NamedTuple):
    """Where up is, and the floor."""

    up: Tensor
    """(3,), unit vector"""
    std_deg: float
    """standard deviation of the angle to the true vertical"""
    floor: float
    """of points on the floor, the component along ``up``, metres"""
    floor_std_m: float


def upright(body: Body, rotations: Tensor) -> Upright:
    """The vertical and the floor of a session.

    Args:
        body: the athlete.
        rotations: (C, 3, 3), world to camera.
    """
    first = _unit(torch.nanmedian(_directions(body.head - body.ankles), dim=0).values)
    up, std_deg = first, body.balance_deg
    for _ in range(_ROUNDS):
        along = _across(up)
        systems = [_balance(body, up, along), _cameras(rotations, up, along), _footholds(body, up, along)]
        information = sum((system[0] for system in systems), torch.zeros(2, 2, dtype=torch.float64))
        step = torch.linalg.solve(information, sum((system[1] for system in systems), torch.zeros(2, dtype=torch.float64)))
        up = _unit(up + step @ along)
        std_deg = math.degrees(float(torch.linalg.inv(information).diagonal().sum().sqrt()))
    if float(up @ first) < _FURTHEST_FROM_BODY:
        up, std_deg = first, math.degrees(math.acos(_FURTHEST_FROM_BODY))
    floor = min(_low(track @ up) - height for height, track in body.feet)
    floor_std = math.hypot(_FLOOR, math.radians(std_deg) * _reach(body, up))
    return Upright(up, std_deg, floor * body.height_m, floor_std * body.height_m)


def _balance(body: Body, up: Tensor, along: Tensor) -> tuple[Tensor, Tensor]:
    """Information (2, 2) and its product with the step (2,) that the balance of the body asks for."""
    balance = body.balance(up)
    mean = _unit(_directions(balance[balance.isfinite().all(-1)]).mean(0))
    precision = 1 / math.radians(body.balance_deg) ** 2
    return precision * torch.eye(2, dtype=torch.float64), precision * along @ (mean - up)


def _cameras(rotations: Tensor, up: Tensor, along: Tensor) -> tuple[Tensor, Tensor]:
    """The same of the cameras: one axis of each image is horizontal."""
    level = rotations[(rotations[:, 2] @ up).abs() < _STEEP]
    heights = level[:, :2] @ up
    axes = level[torch.arange(len(level)), heights.abs().argmin(1)]
    residuals = axes @ up
    weights = torch.ones_like(residuals)
    scale_2 = math.radians(_CAMERA_DEG) ** 2
    for _ in range(3):
        squares = (weights * residuals.square()).sum()
        cases = (weights.sum() - 2).clamp_min(0)
        scale_2 = float((_CAMERA_CASES * math.radians(_CAMERA_DEG) ** 2 + squares) / (_CAMERA_CASES + cases))
        weights = 1 / (1 + residuals.square() / (_CUT**2 * scale_2)).square()
    rows = axes @ along.mT
    return rows.mT @ (weights[:, None] * rows) / scale_2, -rows.mT @ (weights * residuals) / scale_2


def _footholds(body: Body, up: Tensor, along: Tensor) -> tuple[Tensor, Tensor]:
    """The same of the places where feet stand, which lie in one plane."""
    places = [place for height, track in body.feet for place in _places(track - height * up, up, along)]
    if len(places) < 2:
        return torch.zeros(2, 2, dtype=torch.float64), torch.zeros(2, dtype=torch.float64)
    points = torch.stack(places)
    heights, flat = points @ up, points @ along.mT
    weights, residuals = torch.ones_like(heights), heights
    for _ in range(3):
        residuals = heights - (weights * heights).sum() / weights.sum()
        weights = 1 / (1 + residuals.square() / (_CUT * _FOOTHOLD) ** 2).square()
    rows = flat - (weights[:, None] * flat).sum(0) / weights.sum()
    precision = weights / _FOOTHOLD**2
    return rows.mT @ (precision[:, None] * rows), -rows.mT @ (precision * residuals)


def _places(track: Tensor, up: Tensor, along: Tensor) -> list[Tensor]:
    """Points (3,) at which a foot (G, 3) stands: the lowest in each place in which it stays."""
    total = int(track.isfinite().all(-1).sum())
    known = track[(moved_around(track) < _STILL) & track.isfinite().all(-1)]
    cells = (known @ along.mT / _CELL).floor().long()
    found: list[Tensor] = []
    for cell in cells.unique(dim=0):
        inside = known[(cells == cell).all(1)]
        if len(inside) >= max(2, _LEAST_STAY * total):
            low = _low(inside @ up)
            found.append(inside.mean(0) + (low - inside.mean(0) @ up) * up)
    return found


def _low(heights: Tensor) -> float:
    """The height at which a foot stands."""
    return float(heights[heights.isfinite()].quantile(_LOW))


def _reach(body: Body, up: Tensor) -> float:
    """Root mean square of the distances of the ankles from their middle along the floor."""
    flat = body.ankles[body.ankles.isfinite().all(-1)]
    flat = flat - (flat @ up)[:, None] * up
    return float((flat - flat.mean(0)).square().sum(-1).mean().sqrt())


def _directions(vectors: Tensor) -> Tensor:
    return vectors / vectors.norm(dim=-1, keepdim=True)


def _unit(vector: Tensor) -> Tensor:
    return vector / vector.norm()


def _across(up: Tensor) -> Tensor:
    """Two unit vectors (2, 3) at right angles to one and to each other."""
    other = torch.eye(3, dtype=up.dtype)[int(up.abs().argmin())]
    first = _unit(torch.linalg.cross(up, other))
    return torch.stack([first, torch.linalg.cross(up, first)])
