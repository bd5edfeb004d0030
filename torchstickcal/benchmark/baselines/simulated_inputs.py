"""Inputs of baselines that are made from the truth of a session."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from torch import Tensor

from torchstickcal.benchmark.baselines.base import Array
from torchstickcal.benchmark.baselines.joints import BONES
from torchstickcal.io import SPORTS_STICK_SYN_JOINTS


def limb_orientations(
    true_rotations: Tensor, points: Tensor, sigma_deg: float, seed: int, names: Sequence[str] = SPORTS_STICK_SYN_JOINTS
) -> Array:
    """Directions of the limbs :data:`BONES` in each camera's frame with noise, like those of a monocular 3D pose network.

    Args:
        true_rotations: (C, 3, 3), world to camera.
        points: (F, P, 3); the first of them are the joints.
        sigma_deg: standard deviation of the noise along each of the two axes orthogonal to the direction, degrees; it is
            independent in every camera and frame.
        seed: of the noise.
        names: of the joints.

    Returns:
        Unit vectors (C, F, B, 3).
    """
    starts, ends = ([list(names).index(bone[end]) for bone in BONES] for end in (0, 1))
    limbs = (points[:, ends] - points[:, starts]).numpy()
    directions = np.einsum("cij,fbj->cfbi", true_rotations.numpy(), limbs / np.linalg.norm(limbs, axis=-1, keepdims=True))
    errors = np.deg2rad(sigma_deg) * np.random.default_rng(seed).standard_normal(directions.shape)
    disturbed = directions + errors - (errors * directions).sum(-1, keepdims=True) * directions
    return disturbed / np.linalg.norm(disturbed, axis=-1, keepdims=True)


def bone_lengths(points: Tensor, names: Sequence[str]) -> dict[tuple[str, str], float]:
    """Mean lengths of the limbs :data:`BONES` over the session, metres, by the names of their two joints.

    Args:
        points: (F, P, 3), metres. names: of the points.
    """
    index = list(names).index
    return {
        (start, end): float((points[:, index(end)] - points[:, index(start)]).norm(dim=1).nanmean()) for start, end in BONES
    }
