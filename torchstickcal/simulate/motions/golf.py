"""Golf: the full swing of a right-handed player with a club of 1 m. The target is to the left (-x), the ball in front."""

from __future__ import annotations

from dataclasses import replace

from torchstickcal.simulate.motions.base import SPORTS, Action, Posture, tilted_plane

_LEFT, _RIGHT = (-0.22, 0.0, 0.0), (0.22, 0.0, 0.0)

_ADDRESS = Posture(
    forward_m=-0.12, height_m=0.86, pelvis_lean=22, chest_lean=38, chest_side=4, head_nod=48,
    arms_reach_m=0.65, stick_elevation=4, left_foot=_LEFT, right_foot=_RIGHT,
)  # fmt: skip
_TAKEAWAY = replace(_ADDRESS, pelvis_turn=-12, chest_turn=-38, arms_angle=-48, stick_angle=-28, head_turn=-4)
_TOP = replace(
    _ADDRESS, sway_m=0.03, pelvis_turn=-42, chest_turn=-92, chest_lean=34, chest_side=-4, head_turn=-14, head_nod=42,
    arms_angle=-142, arms_elevation=6, arms_reach_m=0.66, stick_angle=-108, stick_elevation=12,
)  # fmt: skip
_LAGGING = replace(
    _ADDRESS, sway_m=-0.06, pelvis_turn=14, chest_turn=-34, chest_side=6, arms_angle=-62, stick_angle=-96, stick_elevation=8
)
_IMPACT = replace(
    _ADDRESS, sway_m=-0.09, forward_m=-0.10, pelvis_turn=36, chest_turn=14, chest_side=10, head_turn=-4,
    arms_angle=8, arms_reach_m=0.65, stick_angle=-8,
)  # fmt: skip
_RELEASE = replace(
    _IMPACT, pelvis_turn=52, chest_turn=44, arms_angle=62, arms_reach_m=0.65, stick_angle=24, right_foot=(0.21, 0.01, 0.02)
)
_FOLLOW = replace(
    _IMPACT, sway_m=-0.12, forward_m=-0.06, height_m=0.89, pelvis_turn=72, pelvis_lean=8, chest_turn=82, chest_lean=18,
    chest_side=6, head_turn=45, head_nod=20, arms_angle=122, arms_reach_m=0.58, stick_angle=62, stick_elevation=6,
    right_foot=(0.18, 0.03, 0.06),
)  # fmt: skip
_FINISH = replace(
    _FOLLOW, sway_m=-0.14, forward_m=-0.03, height_m=0.91, pelvis_turn=84, pelvis_lean=0, chest_turn=108, chest_lean=2,
    chest_side=2, head_turn=78, head_nod=4, arms_angle=156, arms_elevation=16, arms_reach_m=0.42, stick_angle=98,
    stick_elevation=-22, right_foot=(0.15, 0.05, 0.10),
)  # fmt: skip
_CARRY = Posture(
    pelvis_lean=4, chest_lean=8, head_nod=6, arms_angle=25, arms_elevation=-5, arms_reach_m=0.50, stick_angle=20,
    stick_elevation=35,
)  # fmt: skip

SPORTS.register(
    "golf",
    Action(
        stick_m=1.00,
        stick_names=("club_grip", "club_head"),
        grips_m={"left": 0.05, "right": 0.13},
        plane=tilted_plane(34),
        keys=(
            (0.00, _ADDRESS),
            (0.25, _ADDRESS),
            (0.60, _TAKEAWAY),
            (1.15, _TOP),
            (1.33, _LAGGING),
            (1.435, _IMPACT),
            (1.535, _RELEASE),
            (1.72, _FOLLOW),
            (2.10, _FINISH),
            (2.40, _FINISH),
            (2.95, _CARRY),
            (3.55, _CARRY),
        ),
        period_s=4.0,
        walk_s=(2.7, 3.8),
    ),
)
