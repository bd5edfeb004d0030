"""Kendo: a step and a cut to the head (men) from the middle guard, with a shinai of 1.2 m. The opponent is in front (+y)."""

from __future__ import annotations

from dataclasses import replace

from torchstickcal.simulate.motions.base import SPORTS, Action, Posture

_GUARD = Posture(
    forward_m=0.02, height_m=0.885, pelvis_lean=2, chest_lean=4, arms_angle=-50, arms_reach_m=0.46, stick_angle=74,
    left_foot=(-0.10, -0.20, 0.03), right_foot=(0.10, 0.16, 0.0),
)  # fmt: skip
_PRESS = replace(_GUARD, forward_m=0.10, right_foot=(0.10, 0.26, 0.0), left_foot=(-0.10, -0.14, 0.03))
_RAISED = replace(
    _PRESS, forward_m=0.16, chest_lean=0, arms_angle=58, arms_reach_m=0.46, stick_angle=72, right_foot=(0.10, 0.34, 0.06)
)
_CUTTING = replace(
    _RAISED, forward_m=0.34, chest_lean=6, arms_angle=28, arms_reach_m=0.52, stick_angle=32, right_foot=(0.10, 0.62, 0.05)
)
_STRIKE = replace(
    _CUTTING, forward_m=0.44, height_m=0.86, chest_lean=8, arms_angle=-2, arms_reach_m=0.60, stick_angle=12,
    right_foot=(0.10, 0.72, 0.0), left_foot=(-0.10, 0.02, 0.05),
)  # fmt: skip
_THROUGH = replace(
    _STRIKE, forward_m=0.54, height_m=0.88, chest_lean=5, arms_angle=-5, stick_angle=16, left_foot=(-0.10, 0.34, 0.03)
)
_GUARD_AHEAD = replace(_GUARD, forward_m=0.56, right_foot=(0.10, 0.70, 0.0), left_foot=(-0.10, 0.34, 0.03))
_BACK = replace(_GUARD, forward_m=0.28, right_foot=(0.10, 0.50, 0.02), left_foot=(-0.10, -0.14, 0.05))

SPORTS.register(
    "kendo",
    Action(
        stick_m=1.20,
        stick_names=("shinai_pommel", "shinai_tip"),
        grips_m={"left": 0.04, "right": 0.27},
        plane=((0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
        keys=(
            (0.00, _GUARD),
            (0.30, _GUARD),
            (0.60, _PRESS),
            (0.98, _RAISED),
            (1.10, _CUTTING),
            (1.21, _STRIKE),
            (1.45, _THROUGH),
            (1.85, _GUARD_AHEAD),
            (2.20, _BACK),
            (2.60, _GUARD),
        ),
        period_s=3.6,
        walk_s=(2.6, 3.4),
    ),
)
