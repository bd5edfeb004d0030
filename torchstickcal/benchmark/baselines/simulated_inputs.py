"""Inputs of the comparison methods, made from a known truth."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from torch import Tensor

from torchstickcal.benchmark.baselines.base import BONES, Array
from torchstickcal.io.session import SPORTS_STICK_SYN_JOINTS


def limb_orientations(
    true_rotations: Tensor, points: Tensor, sigma_deg: float, seed: int, names: Sequence[str] = SPORTS_STICK_SYN_JOINTS
) -> Array:
    """Directions (C, F, B, 3) of the limbs ``BONES`` in each camera's frame, as a learned lifter of single views gives them.

    Every camera's direction in every frame has an error of its own, of ``sigma_deg`` along each of the two axes across it.

    Args:
        true_rotations: (C, 3, 3), world to camera.
        points: (F, P, 3), the first of them named by ``names``.
        sigma_deg: standard deviation.
        seed: of the errors.
        names: the joints' names.
    """
    starts, ends = ([list(names).index(bone[end]) for bone in BONES] for end in (0, 1))
    limbs = (points[:, ends] - points[:, starts]).numpy()
    directions = np.einsum("cij,fbj->cfbi", true_rotations.numpy(), limbs / np.linalg.norm(limbs, axis=-1, keepdims=True))
    errors = np.deg2rad(sigma_deg) * np.random.default_rng(seed).standard_normal(directions.shape)
    disturbed = directions + errors - (errors * directions).sum(-1, keepdims=True) * directions
    return disturbed / np.linalg.norm(disturbed, axis=-1, keepdims=True)


def bone_lengths(points: Tensor, names: Sequence[str]) -> dict[tuple[str, str], float]:
    """Mean length over the session of the limbs ``BONES``, of points (F, P, 3) in the order of ``names``, metres."""
    index = list(names).index
    return {
        (start, end): float((points[:, index(end)] - points[:, index(start)]).norm(dim=1).nanmean()) for start, end in BONES
    }
