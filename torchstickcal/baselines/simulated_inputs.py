"""Inputs of the comparison methods, made from a known truth."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from torchstickcal import se3
from torchstickcal.baselines.base import BONES, Array, Cube
from torchstickcal.cameras import Intrinsics
from torchstickcal.io.session import SPORTS_STICK_SYN_JOINTS

_CUBE_EDGE_M = 0.3
_MARKER_SHARE = 0.8
_MAX_OBLIQUENESS_DEG = 75.0


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


def cube_views(
    true_rotations: Tensor,
    true_translations: Tensor,
    intrinsics: Intrinsics,
    image_size: Tensor | Sequence[int],
    centre: Array,
    sigma_px: float,
    seed: int,
) -> Cube:
    """An upright cube with an edge of 0.3 m, a marker of 0.24 m on each of its six faces, as the cameras see it.

    A marker is seen where its face is turned towards the camera, by less than 75 degrees from facing it, and all its four
    corners lie inside the image.

    Args:
        true_rotations: (C, 3, 3) and true_translations: (C, 3), world to camera.
        intrinsics: of the C cameras.
        image_size: width and height in pixels, (2,) or (C, 2).
        centre: (3,), of the cube in the world, metres.
        sigma_px: noise of a corner along each axis.
        seed: of the noise.
    """
    normals = np.concatenate([np.eye(3), -np.eye(3)])
    first_axis, second_axis = np.roll(normals, 1, axis=1), np.roll(normals, 2, axis=1)
    half = _CUBE_EDGE_M / 2
    turns = [(-1, -1), (1, -1), (1, 1), (-1, 1)]
    square = np.stack([a * first_axis + b * second_axis for a, b in turns], axis=1)
    corners = half * (normals[:, None] + _MARKER_SHARE * square)
    in_cameras = torch.from_numpy(corners.reshape(-1, 3) + centre) @ true_rotations.mT + true_translations[:, None]
    pixels = intrinsics.project(in_cameras)
    to_camera = se3.camera_centres(true_rotations, true_translations).numpy()[:, None] - (centre + half * normals)
    facing = (to_camera * normals).sum(-1) > np.cos(np.deg2rad(_MAX_OBLIQUENESS_DEG)) * np.linalg.norm(to_camera, axis=-1)
    size = torch.as_tensor(image_size, dtype=torch.float64).expand(len(pixels), 2)[:, None]
    inside = ((pixels >= 0) & (pixels <= size - 1)).all(-1) & (in_cameras[..., 2] > 0)
    seen = facing & inside.unflatten(1, (6, 4)).all(-1).numpy()
    noise = sigma_px * np.random.default_rng(seed).standard_normal(pixels.shape)
    keypoints = np.where(np.repeat(seen, 4, axis=1)[..., None], pixels.numpy() + noise, np.nan)
    return Cube(corners.reshape(-1, 3), keypoints)
