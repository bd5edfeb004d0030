"""Rigid transforms on plain matrices, for loops where a Lie-group object would cost more than the arithmetic.

Tangents are ordered (translation, rotation) and act on the world's side, ``T <- T Exp(tangent)``: the convention of
:class:`torchstickcal.Extrinsics`, whose exponential is kornia's. No gradient is needed here.
"""

from __future__ import annotations

import math

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
    angle = rotation.norm(dim=-1)[..., None, None]
    # sin(x) / x, (1 - cos(x)) / x^2 and (1 - sin(x) / x) / x^2; rounding errors of the last are multiplied by x^2
    a, b = torch.sinc(angle / math.pi), torch.sinc(angle / (2 * math.pi)).square() / 2
    c = (1 - a) / angle.square().clamp_min(1e-30)
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
