"""The paper's measure of success: rotation and translation errors of cameras after a rigid alignment without scale."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchstickcal.arrays import tensor_of
from torchstickcal.errors import ObservationError
from torchstickcal.geometry import se3

_COLLINEAR = 1e-6


@dataclass(frozen=True)
class PoseErrors:
    """Errors of each camera."""

    rotation_deg: Tensor
    """(..., C)"""
    translation_m: Tensor
    """(..., C), distance of the camera centres"""
    aligned_by: str = "camera centres"
    """what was laid onto the truth before the comparison, by a rotation and a translation without scale"""

    @property
    def mean_rotation_deg(self) -> float:
        """Mean over the cameras."""
        return float(self.rotation_deg.mean())

    @property
    def mean_translation_m(self) -> float:
        """Mean over the cameras."""
        return float(self.translation_m.mean())


def pose_errors(rotations: Any, translations: Any, true_rotations: Any, true_translations: Any) -> PoseErrors:
    """Errors of estimated poses (..., C, 3, 3), (..., C, 3), world to camera, against the true ones (C, 3, 3), (C, 3).

    The estimated camera centres are laid onto the true ones by the rotation and translation of least squares (Kabsch and
    Umeyama, no scale). Where the true centres lie on one line, as two cameras always do, they leave a rotation open, and
    the first camera's pose serves for the alignment instead. Computed in float64, of tensors, arrays or lists.

    Raises:
        ObservationError: if they are not numbers, or their shapes do not fit.
    """
    given = {
        "rotations": rotations,
        "translations": translations,
        "true_rotations": true_rotations,
        "true_translations": true_translations,
    }
    r, t, r_true, t_true = (tensor_of(value, name).double().cpu() for name, value in given.items())
    cameras = len(r_true) if r_true.ndim else 0
    expected = ((*r.shape[:-3], cameras, 3, 3), (*r.shape[:-3], cameras, 3), (cameras, 3, 3), (cameras, 3))
    if not cameras or (r.shape, t.shape, r_true.shape, t_true.shape) != expected:
        raise ObservationError(
            "poses have the wrong shape",
            where=", ".join(given),
            got=", ".join(str(tuple(value.shape)) for value in (r, t, r_true, t_true)),
            expected="(..., C, 3, 3), (..., C, 3), (C, 3, 3), (C, 3)",
        )
    centres, true_centres = se3.camera_centres(r, t), se3.camera_centres(r_true, t_true)
    spread = torch.linalg.svdvals(true_centres - true_centres.mean(0))
    if spread[1] <= _COLLINEAR * spread[0]:
        rotation = r_true[0].mT @ r[..., 0, :, :]
        offset = true_centres[0] - (rotation @ centres[..., 0, :, None])[..., 0]
        aligned_by = "pose of the first camera, rotation and translation, no scale (the camera centres lie on one line)"
    else:
        rotation, offset = align(centres, true_centres)
        aligned_by = f"all {cameras} camera centres, rotation and translation, no scale"
    return PoseErrors(
        rotation_deg=rotation_angle(r_true @ rotation[..., None, :, :] @ r.mT).rad2deg(),
        translation_m=(centres @ rotation.mT + offset[..., None, :] - true_centres).norm(dim=-1),
        aligned_by=aligned_by,
    )


def align(source: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    """The rotations (..., 3, 3) and translations (..., 3) that lay points (..., N, 3) onto others by least squares."""
    centre, target_centre = source.mean(-2), target.mean(-2)
    u, _, vh = torch.linalg.svd((target - target_centre[..., None, :]).mT @ (source - centre[..., None, :]))
    sign = torch.ones_like(centre)
    sign[..., 2] = torch.det(u @ vh).sign()
    rotation = u @ (sign[..., None] * vh)
    return rotation, target_centre - (rotation @ centre[..., None])[..., 0]


def rotation_angle(rotations: Tensor) -> Tensor:
    """Angles (...) of rotations (..., 3, 3), radians; exact near zero, where an arc cosine loses half the digits."""
    trace = rotations.diagonal(dim1=-2, dim2=-1).sum(-1)
    return torch.atan2(2 * se3.vee(rotations).norm(dim=-1), trace - 1)
