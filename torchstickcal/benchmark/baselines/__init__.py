"""The comparison methods of the paper's tables, each on the same inputs."""

from __future__ import annotations

from functools import partial

from torchstickcal.benchmark.baselines.aruco_cube import aruco_cube
from torchstickcal.benchmark.baselines.base import BONES, Baseline, Estimate, Inputs, MissingInputError
from torchstickcal.benchmark.baselines.calib_person import calib_person
from torchstickcal.benchmark.baselines.ewand import ewand
from torchstickcal.benchmark.baselines.extra_calib import extra_calib
from torchstickcal.benchmark.baselines.human import human_bones, human_height
from torchstickcal.benchmark.baselines.kineo import kineo
from torchstickcal.benchmark.baselines.simulated_inputs import bone_lengths, limb_orientations
from torchstickcal.benchmark.baselines.stick import stick_only

__all__ = [
    "BASELINES",
    "BONES",
    "Baseline",
    "Estimate",
    "Inputs",
    "MissingInputError",
    "bone_lengths",
    "limb_orientations",
]

BASELINES: dict[str, Baseline] = {
    "human_height": human_height,
    "human_guessed_low": partial(human_height, offset_m=-0.1),
    "human_guessed_high": partial(human_height, offset_m=0.1),
    "human_bones": human_bones,
    "stick_only": stick_only,
    "aruco_cube": aruco_cube,
    "calib_person": calib_person,
    "extra_calib": extra_calib,
    "kineo": kineo,
    "ewand": ewand,
}
"""The methods by name."""
