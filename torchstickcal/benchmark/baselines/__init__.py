"""Baselines: the comparison methods of the benchmark, all on the same inputs.

Each module registers one method or a few variants of it; a new module in this folder is found without being listed anywhere.
"""

from torchstickcal.benchmark.baselines.base import (
    BASELINES,
    Baseline,
    Estimate,
    Inputs,
    Listing,
    MissingInputError,
    PublishedErrors,
    baseline,
)
from torchstickcal.benchmark.baselines.joints import BONES
from torchstickcal.benchmark.baselines.simulated_inputs import bone_lengths, limb_orientations

__all__ = [
    "BASELINES",
    "BONES",
    "Baseline",
    "Estimate",
    "Inputs",
    "Listing",
    "MissingInputError",
    "PublishedErrors",
    "baseline",
    "bone_lengths",
    "limb_orientations",
]
