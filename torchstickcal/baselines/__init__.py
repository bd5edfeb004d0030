"""The comparison methods of the paper's tables, each on the same inputs."""

from __future__ import annotations

from functools import partial

from torchstickcal.baselines.aruco_cube import aruco_cube
from torchstickcal.baselines.base import BONES, Baseline, Estimate, Inputs, MissingInputError
from torchstickcal.baselines.calib_person import calib_person
from torchstickcal.baselines.ewand import ewand
from torchstickcal.baselines.extra_calib import extra_calib
from torchstickcal.baselines.human import human_bones, human_height
from torchstickcal.baselines.kineo import kineo
from torchstickcal.baselines.simulated_inputs import bone_lengths, limb_orientations
from torchstickcal.baselines.stick import stick_only

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
