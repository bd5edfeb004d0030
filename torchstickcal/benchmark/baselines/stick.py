"""The stick alone: the project's own calibration on the stick's ends (the paper's ablation)."""

from __future__ import annotations

from torchstickcal.benchmark.baselines.base import Estimate, Inputs
from torchstickcal.pipeline.calibrate import calibrate


def stick_only(inputs: Inputs) -> Estimate:
    """The configuration ``stick_only``."""
    calibration = calibrate(inputs.observations, "stick_only")
    return Estimate(calibration.rotations, calibration.translations, calibration.status)
