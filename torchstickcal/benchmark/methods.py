"""What is measured: every configuration and every comparison method, by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import torch

from torchstickcal.benchmark.baselines import BASELINES, Estimate, Inputs, bone_lengths, limb_orientations
from torchstickcal.benchmark.cases import Case
from torchstickcal.config import config_names
from torchstickcal.errors import CalibrationError
from torchstickcal.pipeline.calibrate import calibrate

LIFTER_SIGMA_DEG = 5.0
"""Errors of the limb directions that CalibPerson is given, along each axis: those of a good network."""

_FEW_FRAMES = (5, 10, 20)


@dataclass(frozen=True)
class Method:
    """A way to calibrate.

    Args:
        title: for tables.
        estimate: the method.
        height_in_motion: the height it is given is the true mean distance from head to ankles in this session, which only
            the truth can tell, instead of the athlete's stature.
        frames: only the first of a session that it sees; None for all.
        profiled: whether the memory it needs is measured too, in runs of their own.
    """

    title: str
    estimate: Callable[[Inputs], Estimate]
    height_in_motion: bool = False
    frames: int | None = None
    profiled: bool = False

    def inputs(self, case: Case) -> Inputs:
        """What the method may use of a case."""
        given = Inputs(case.observations, height_m=case.height_m, cube=case.cube)
        names, points = case.observations.point_names, case.truth.points
        if names is None or points is None or "head_top" not in names:
            return replace(given, height_m=None)
        if self.height_in_motion:
            ankles = points[:, [names.index("left_ankle"), names.index("right_ankle")]].mean(1)
            given = replace(given, height_m=float((points[:, names.index("head_top")] - ankles).norm(dim=1).mean()))
        return replace(
            given,
            bone_lengths_m=bone_lengths(points, names),
            orientations=limb_orientations(case.truth.rotations, points, LIFTER_SIGMA_DEG, case.seed, names),
        )


def method(name: str) -> Method:
    """A method by its name.

    Raises:
        CalibrationError: if there is none of that name.
    """
    if name not in METHODS:
        expected = f"one of {', '.join(METHODS)}"
        raise CalibrationError("unknown method", where="--methods", got=repr(name), expected=expected)
    return METHODS[name]


def _configured(inputs: Inputs, config: str) -> Estimate:
    calibration = calibrate(inputs.observations, config)
    return Estimate(calibration.rotations.to(torch.float64), calibration.translations.to(torch.float64), calibration.status)


_TITLES = {
    "default": "torchstickcal, `default`",
    "lbfgs": "torchstickcal, `lbfgs`",
    "paper": "torchstickcal, `paper` (the published method)",
    "without_length": "`paper` without length constraint",
    "without_smoothness": "`paper` without temporal smoothness",
    "stick_only": "Stick, given length",
    "human_height": "Human, true stature",
    "human_guessed_low": "Human, stature - 0.1 m",
    "human_guessed_high": "Human, stature + 0.1 m",
    "human_only": "Human, 1.72 m for everybody",
    "human_bones": "Human, true bone lengths",
    "aruco_cube": "ArUco cube",
    "calib_person": "CalibPerson",
    "extra_calib": "ExtraCalib",
    "kineo": "Kineo",
    "ewand": "eWand",
}
_OF_A_HEIGHT = {"human_height": "Human", "calib_person": "CalibPerson", "extra_calib": "ExtraCalib", "kineo": "Kineo"}
_PROFILED = {"default", "paper"}


def _all_methods() -> dict[str, Method]:
    estimates = BASELINES | {name: partial(_configured, config=name) for name in config_names()}
    known = {name: Method(_TITLES.get(name, name), way, profiled=name in _PROFILED) for name, way in estimates.items()}
    in_motion = {
        f"{name}_in_motion": Method(f"{title}, true mean height in motion", BASELINES[name], height_in_motion=True)
        for name, title in _OF_A_HEIGHT.items()
    }
    shortened = {
        f"default_{frames}_frames": Method(f"`default`, {frames} frames", partial(_configured, config="default"), frames=frames)
        for frames in _FEW_FRAMES
    }
    order = [*_TITLES, *sorted(known.keys() - _TITLES.keys())]
    return {name: known[name] for name in order} | in_motion | shortened


METHODS: dict[str, Method] = _all_methods()
"""The methods by name."""
