"""Rigid transforms on plain matrices, for loops where a Lie-group object would cost more than the arithmetic.

Tangents are ordered (translation, rotation) and act on the world's side, ``T <- T Exp(tangent)``: the convention of
:class:`torchstickcal.Extrinsics`, whose exponential is kornia's. No gradient is needed here.
"""

from __future__ import annotations

import torch
from torch import Tensor


def hat(vectors: Tensor) -> Tensor:
    """Cross-product matrices ``[v]x`` (..., 3, 3) of vectors (..., 3)."""
    x, y, z = vectors.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(-1, (3, 3))


def vee(matrices: Tensor) -> Tensor:
    """Vectors (..., 3) of cross-product matrices (..., 3, 3), of a general matrix those of its skew part."""
    skew = (matrices - matrices.mT) / 2
    return torch.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], dim=-1)


def exp(tangents: Tensor) -> tuple[Tensor, Tensor]:
    """Exponential map of SE(3): tangents (..., 6) to rotations (..., 3, 3) and translations (..., 3)."""
    translation, rotation = tangents[..., :3], tangents[..., 3:]
    angle_squared = (rotation * rotation).sum(-1)[..., None, None]
    angle = angle_squared.sqrt()
    small = angle_squared < 1e-8
    safe = torch.where(small, torch.ones_like(angle), angle)
    a = torch.where(small, 1 - angle_squared / 6, safe.sin() / safe)
    b = torch.where(small, 0.5 - angle_squared / 24, (1 - safe.cos()) / safe**2)
    c = torch.where(small, 1 / 6 - angle_squared / 120, (safe - safe.sin()) / safe**3)
    skew = hat(rotation)
    skew_squared = skew @ skew
    identity = torch.eye(3, dtype=tangents.dtype, device=tangents.device)
    left_jacobian = identity + b * skew + c * skew_squared
    return identity + a * skew + b * skew_squared, (left_jacobian @ translation[..., None])[..., 0]


def moved(rotations: Tensor, translations: Tensor, points: Tensor) -> Tensor:
    """``R X + t`` (B, C, 3, N) of points (B, 3, N) under C transforms (B, C, 3, 3), (B, C, 3)."""
    stacked = torch.baddbmm(translations.flatten(1)[..., None], rotations.flatten(1, 2), points)
    return stacked.unflatten(1, (-1, 3))


def retract(rotations: Tensor, translations: Tensor, tangents: Tensor) -> tuple[Tensor, Tensor]:
    """``T Exp(tangent)`` for transforms given as rotations (..., 3, 3) and translations (..., 3)."""
    step_rotation, step_translation = exp(tangents)
    return rotations @ step_rotation, translations + (rotations @ step_translation[..., None])[..., 0]


def camera_centres(rotations: Tensor, translations: Tensor) -> Tensor:
    """Centres ``-R^T t`` (..., 3) in the world, of cameras ``x_cam = R X + t``."""
    return -(rotations.mT @ translations[..., None])[..., 0]
