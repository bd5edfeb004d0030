"""What the points of a body say of the vertical: head, feet, the centre of mass, left and right."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchstickcal.errors import CalibrationError
from torchstickcal.skeletons import conventional

_HEAD = ("head_top", "head", "nose", "left_ear", "right_ear", "left_eye", "right_eye")
_FEET = {"ankle": 0.044, "heel": 0.019, "big_toe": 0.013, "small_toe": 0.013, "foot_index": 0.013}
"""Points of a foot, and their heights above the floor when it stands flat, in heights of the head above the ankles."""
_HIPS = ("hip", "pelvis")
_MASS = {"head": 0.08, "shoulder": 0.28, "hip": 0.36, "knee": 0.14, "ankle": 0.07, "elbow": 0.04, "wrist": 0.03}
"""Shares of the mass of a body, put into its joints."""
_ARMS = ("elbow", "wrist")
_LEAST_SHARE = 0.5
"""Share of the frames in which an arm must be known to count."""
_ANKLE_TO_MIDDLE = 0.03
"""How far the middle of a foot is in front of its ankle, as a share of the same height."""
_LIFTED, _LIFTED_SCALE = 0.12, 0.02
"""Difference of height from which a foot carries less than the other: more than an error of the vertical explains."""
_STEP, _MOVED = 3, 0.02
"""Frames before and after in which a foot that carries moves less than so many of these heights."""
_BALANCE_DEG, _LEAN_DEG = 2.5, 8.0
"""How far from the vertical the mean lines from the feet to the centre of mass and to the head are, with a swing's lean."""
_UPRIGHT = 0.9
"""Quantile of the distances of the head from the ankles that is that height."""


@dataclass(frozen=True, eq=False)
class Body:
    """An athlete in G frames, NaN where not known."""

    height_m: float
    """of the head above the ankles where the body is upright, metres"""
    head: Tensor
    """(G, 3), in these heights, as all lengths below"""
    ankles: Tensor
    """(G, 3), the middle between both"""
    both_ankles: Tensor
    """(2, G, 3), left and right"""
    mass: Tensor
    """(G, 3), the centre of mass, or the head where too little of the body is known"""
    balance_deg: float
    """how far from the vertical the mean line from the feet to it is"""
    left: Tensor
    """(G, 3), from right to left"""
    feet: tuple[tuple[float, Tensor], ...]
    """points of the feet (G, 3), each with its height above the floor when the foot stands flat"""

    @staticmethod
    def of(points: Tensor, names: Sequence[str] | None) -> Body:
        """The body among points (G, P, 3), by their names in any spelling.

        Raises:
            CalibrationError: if head or ankles are not among them, or are never known together.
        """
        tracks = zip(map(conventional, names or ()), points.double().unbind(1), strict=False)
        track = {name: positions for name, positions in tracks if bool(positions.isfinite().any())}

        def middle(*joints: str) -> Tensor | None:
            """The middle of left and right of the first of some joints that is there, or the joint itself."""
            for joint in joints:
                if f"left_{joint}" in track and f"right_{joint}" in track:
                    return (track[f"left_{joint}"] + track[f"right_{joint}"]) / 2
                if joint in track:
                    return track[joint]
            return None

        head = next((track[name] for name in _HEAD if name in track), None)
        ankles = middle("ankle")
        apart = torch.zeros(0) if head is None or ankles is None else (head - ankles).norm(dim=-1)
        apart = apart[apart.isfinite() & (apart > 0)]
        if head is None or ankles is None or not len(apart):
            raise CalibrationError(
                "no standing body",
                where="world",
                got="no head" if head is None else "no ankles" if ankles is None else "no frame with a head above ankles",
                expected="points called head_top, head or nose, and left_ankle and right_ankle, known in the same frames",
            )
        height_m = float(apart.quantile(_UPRIGHT))
        track, head, ankles = (
            {name: positions / height_m for name, positions in track.items()},
            head / height_m,
            ankles / height_m,
        )
        trunk = [joint for joint in ("hip", "shoulder") if {f"left_{joint}", f"right_{joint}"} <= set(track)]
        left = _known_mean([track[f"left_{joint}"] - track[f"right_{joint}"] for joint in trunk or ["ankle"]])
        joints = {name: middle(*_HIPS) if name == "hip" else head if name == "head" else middle(name) for name in _MASS}
        needed = {name: joint for name, joint in joints.items() if joint is not None}
        for arm in _ARMS:
            if arm in needed and float(needed[arm].isfinite().all(-1).double().mean()) < _LEAST_SHARE:
                del needed[arm]
        masses = torch.stack([_MASS[name] * joint for name, joint in needed.items()]).sum(0)
        mass = masses / sum(map(_MASS.__getitem__, needed))
        whole = {"head", "shoulder", "hip", "ankle"} <= set(needed) and bool(mass.isfinite().any())
        both = torch.stack([track.get(f"{side}_ankle", ankles) for side in ("left", "right")])
        feet = tuple(
            (height, track[f"{side}_{point}"])
            for point, height in _FEET.items()
            for side in ("left", "right")
            if f"{side}_{point}" in track
        )
        return Body(height_m, head, ankles, both, *((mass, _BALANCE_DEG) if whole else (head, _LEAN_DEG)), left, feet)

    def balance(self, up: Tensor) -> Tensor:
        """From the ground below the feet to the centre of mass (G, 3); a foot that is lifted carries less.

        Args:
            up: (3,), the vertical as far as it is known.
        """
        heights = self.both_ankles @ up
        lifted = heights - heights.amin(0)
        moved = torch.stack([moved_around(ankle) for ankle in self.both_ankles]).nan_to_num()
        carried = torch.sigmoid((_LIFTED - lifted) / _LIFTED_SCALE) / (moved.square() + _MOVED**2)
        carried = carried / carried.sum(0)
        forward = torch.linalg.cross(self.left, up.expand_as(self.left))
        toes = _ANKLE_TO_MIDDLE * forward / forward.norm(dim=-1, keepdim=True)
        return self.mass - (carried[..., None] * self.both_ankles).sum(0) - toes.nan_to_num()


def moved_around(track: Tensor) -> Tensor:
    """How far a point (G, 3) moves within a few frames around each one, (G,); NaN where that is not known."""
    moved = torch.full_like(track[:, 0], torch.nan)
    moved[_STEP:-_STEP] = (track[2 * _STEP :] - track[: -2 * _STEP]).norm(dim=-1)
    return moved


def _known_mean(vectors: list[Tensor]) -> Tensor:
    """The mean of vectors (G, 3), of those that are known in each frame."""
    return torch.stack(vectors).nanmean(0)
