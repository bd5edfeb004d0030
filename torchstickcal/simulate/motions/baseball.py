"""Baseball: the swing of a right-handed batter with a bat of 0.86 m. The pitcher is to the left (-x), home plate in front."""

from __future__ import annotations

from dataclasses import replace

from torchstickcal.simulate.motions.base import SPORTS, Action, Posture, tilted_plane

_LEFT, _RIGHT = (-0.22, 0.0, 0.0), (0.26, 0.0, 0.0)
_STRIDDEN = (-0.38, 0.02, 0.0)

_STANCE = Posture(
    sway_m=0.05, forward_m=-0.08, height_m=0.84, pelvis_turn=-8, pelvis_lean=14, chest_turn=-14, chest_lean=22, head_turn=72,
    head_nod=4, arms_angle=-46, arms_elevation=16, arms_reach_m=0.32, stick_angle=-78, stick_elevation=52,
    left_foot=_LEFT, right_foot=_RIGHT,
)  # fmt: skip
_LOAD = replace(
    _STANCE, sway_m=0.12, pelvis_turn=-24, chest_turn=-36, head_turn=74, arms_angle=-72, arms_elevation=14, arms_reach_m=0.38,
    stick_angle=-66, stick_elevation=48, left_foot=(-0.20, 0.04, 0.16),
)  # fmt: skip
_STRIDE = replace(
    _LOAD, sway_m=0.00, height_m=0.81, pelvis_turn=-4, chest_turn=-34, arms_angle=-80, arms_reach_m=0.42, stick_angle=-70,
    stick_elevation=38, left_foot=_STRIDDEN,
)  # fmt: skip
_SLOT = replace(
    _STRIDE, sway_m=-0.05, height_m=0.80, pelvis_turn=40, chest_turn=4, chest_side=6, head_turn=50, head_nod=18, arms_angle=-46,
    arms_elevation=-6, arms_reach_m=0.40, stick_angle=-104, stick_elevation=8,
)  # fmt: skip
_CONTACT = replace(
    _SLOT, sway_m=-0.09, pelvis_turn=70, chest_turn=52, chest_side=10, head_turn=22, head_nod=30, arms_angle=16,
    arms_elevation=-24, arms_reach_m=0.56, stick_angle=-14, stick_elevation=-14, right_foot=(0.25, 0.01, 0.02),
)  # fmt: skip
_EXTENSION = replace(
    _CONTACT, pelvis_turn=80, chest_turn=78, chest_side=6, arms_angle=62, arms_elevation=-10, arms_reach_m=0.58, stick_angle=28,
    stick_elevation=-4, right_foot=(0.23, 0.03, 0.04),
)  # fmt: skip
_FOLLOW = replace(
    _EXTENSION, height_m=0.83, pelvis_turn=86, chest_turn=104, chest_side=0, head_turn=45, head_nod=12, arms_angle=118,
    arms_elevation=14, arms_reach_m=0.44, stick_angle=88, stick_elevation=22, right_foot=(0.20, 0.05, 0.07),
)  # fmt: skip
_FINISH = replace(
    _FOLLOW, pelvis_turn=88, chest_turn=112, chest_lean=10, head_turn=62, arms_angle=136, arms_elevation=24, arms_reach_m=0.36,
    stick_angle=112, stick_elevation=-14,
)  # fmt: skip
_CARRY = Posture(
    pelvis_lean=4, chest_lean=8, head_nod=6, arms_angle=10, arms_elevation=-32, arms_reach_m=0.48, stick_angle=40,
    stick_elevation=20, left_foot=_LEFT, right_foot=_RIGHT,
)  # fmt: skip

SPORTS.register(
    "baseball",
    Action(
        stick_m=0.86,
        stick_names=("bat_knob", "bat_tip"),
        grips_m={"left": 0.05, "right": 0.13},
        plane=tilted_plane(75),
        keys=(
            (0.00, _STANCE),
            (0.30, _STANCE),
            (0.70, _LOAD),
            (1.05, _STRIDE),
            (1.20, _SLOT),
            (1.32, _CONTACT),
            (1.415, _EXTENSION),
            (1.58, _FOLLOW),
            (1.85, _FINISH),
            (2.15, _FINISH),
            (2.65, _CARRY),
            (3.10, _CARRY),
        ),
        period_s=3.6,
        walk_s=(2.4, 3.4),
    ),
)
