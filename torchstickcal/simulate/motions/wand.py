"""Calibration wand of 0.5 m, waved slowly with the right hand through the space in front of the athlete."""

from __future__ import annotations

from dataclasses import replace

from torchstickcal.simulate.motions.base import SPORTS, Action, Posture, tilted_plane

_FRONT = Posture(arms_elevation=-10, arms_reach_m=0.50, stick_elevation=35)
_RIGHT_LOW = replace(
    _FRONT, chest_turn=-14, head_turn=-18, arms_angle=-50, arms_elevation=-34, stick_angle=-35, stick_elevation=-5
)
_RIGHT_HIGH = replace(
    _FRONT, chest_turn=-16, head_turn=-18, head_nod=-14, arms_angle=-46, arms_elevation=38, stick_angle=-22, stick_elevation=65
)
_LEFT_HIGH = replace(
    _FRONT, chest_turn=16, head_turn=18, head_nod=-14, arms_angle=20, arms_elevation=34, stick_angle=38, stick_elevation=42
)
_LEFT_LOW = replace(
    _FRONT, chest_turn=18, head_turn=18, head_nod=8, arms_angle=20, arms_elevation=-36, stick_angle=40, stick_elevation=-20
)

SPORTS.register(
    "wand",
    Action(
        stick_m=0.50,
        stick_names=("wand_grip", "wand_tip"),
        grips_m={"right": 0.05},
        plane=tilted_plane(90),
        keys=(
            (0.0, _FRONT),
            (0.8, _RIGHT_LOW),
            (1.6, _RIGHT_HIGH),
            (2.5, _LEFT_LOW),
            (3.3, _LEFT_HIGH),
            (4.2, _RIGHT_LOW),
            (5.1, _LEFT_HIGH),
            (5.9, _RIGHT_HIGH),
        ),
        period_s=6.6,
        walk_s=(0.2, 6.2),
    ),
)
