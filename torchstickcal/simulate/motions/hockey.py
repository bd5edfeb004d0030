"""Ice hockey: stick-handling, then a slap shot, with a stick of 1.6 m. Left hand on top; the goal is to the left (-x)."""

from __future__ import annotations

from dataclasses import replace

from torchstickcal.simulate.motions.base import SPORTS, Action, Posture, tilted_plane

_LEFT, _RIGHT = (-0.24, 0.0, 0.0), (0.24, 0.0, 0.0)

_READY = Posture(
    forward_m=-0.16, height_m=0.78, pelvis_lean=26, chest_lean=40, head_nod=24, arms_reach_m=0.50, arms_elevation=-24,
    stick_elevation=0, left_foot=_LEFT, right_foot=_RIGHT,
)  # fmt: skip
_FOREHAND = replace(_READY, chest_turn=-10, head_turn=-6, arms_angle=-12, stick_angle=-5)
_BACKHAND = replace(_READY, chest_turn=12, head_turn=8, arms_angle=13, stick_angle=5)
_SET = replace(_READY, sway_m=0.04, chest_turn=-14, head_turn=20, arms_angle=-10, stick_angle=-6)
_WIND_UP = replace(
    _READY, sway_m=0.10, forward_m=-0.12, height_m=0.82, pelvis_turn=-32, pelvis_lean=18, chest_turn=-68, chest_lean=30,
    head_turn=10, head_nod=30, arms_angle=-98, arms_elevation=-6, arms_reach_m=0.42, stick_angle=-34, stick_elevation=10,
    left_foot=(-0.26, 0.02, 0.06),
)  # fmt: skip
_DRIVE = replace(
    _WIND_UP, sway_m=-0.02, height_m=0.77, pelvis_turn=6, pelvis_lean=26, chest_turn=-34, chest_lean=40, arms_angle=-54,
    arms_elevation=-16, arms_reach_m=0.48, stick_angle=-36, stick_elevation=4, left_foot=(-0.36, 0.04, 0.0),
)  # fmt: skip
_STRIKE = replace(
    _DRIVE, sway_m=-0.10, height_m=0.75, pelvis_turn=34, chest_turn=12, chest_lean=44, chest_side=-4, arms_angle=6,
    arms_elevation=-22, arms_reach_m=0.50, stick_angle=-6, stick_elevation=0,
)  # fmt: skip
_THROUGH = replace(
    _STRIKE, sway_m=-0.15, pelvis_turn=54, chest_turn=48, head_turn=35, head_nod=20, arms_angle=50, arms_elevation=-16,
    stick_angle=20, right_foot=(0.22, 0.03, 0.03),
)  # fmt: skip
_FOLLOW = replace(
    _THROUGH, height_m=0.80, pelvis_turn=66, pelvis_lean=16, chest_turn=78, chest_lean=28, head_turn=72, head_nod=8,
    arms_angle=88, arms_elevation=-4, arms_reach_m=0.50, stick_angle=34, stick_elevation=4, right_foot=(0.20, 0.05, 0.08),
)  # fmt: skip

SPORTS.register(
    "hockey",
    Action(
        stick_m=1.60,
        stick_names=("stick_butt", "stick_blade"),
        grips_m={"left": 0.05, "right": 0.52},
        plane=tilted_plane(55),
        keys=(
            (0.00, _READY),
            (0.22, _FOREHAND),
            (0.50, _BACKHAND),
            (0.78, _FOREHAND),
            (1.06, _BACKHAND),
            (1.36, _SET),
            (1.90, _WIND_UP),
            (2.07, _DRIVE),
            (2.185, _STRIKE),
            (2.30, _THROUGH),
            (2.54, _FOLLOW),
            (2.80, _FOLLOW),
            (3.30, _READY),
            (3.60, _READY),
        ),
        period_s=4.0,
        walk_s=(2.9, 3.85),
    ),
)
