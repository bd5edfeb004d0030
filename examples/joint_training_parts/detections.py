"""What a detector found in some sessions of known rigs, and what is true of them."""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from torch import Tensor

_ROUNDS, _SOFT_PX, _TINY = 4, 5.0, 1e-9


@dataclass(frozen=True)
class Detections:
    """Of B sessions. Pixels are those of the whole images."""

    keypoints: Tensor
    """(B, C, F, P, 2), pixels"""
    score: Tensor
    """(B, C, F, P), the detector's own confidence, 0 to 1"""
    seen: Tensor
    """(B, C, F, P, n), what can be seen of each keypoint in its image, as numbers"""
    labels: Tensor
    """(B, C, F, P, 2), where the points are in the images, pixels"""
    true: Tensor
    """(B, C, F, P, 2), where they would be if the cameras were synchronised, pixels"""
    intrinsics: Tensor
    """(B, C, 3, 3)"""
    rotations: Tensor
    """(B, C, 3, 3), true, world to camera"""
    translations: Tensor
    """(B, C, 3), true, metres"""
    stick_m: Tensor
    """(B, 1), length of the stick"""

    def __len__(self) -> int:
        return len(self.keypoints)

    def __getitem__(self, index: slice | Tensor) -> Detections:
        return Detections(*(getattr(self, field.name)[index] for field in fields(self)))


def reprojections(found: Detections) -> Tensor:
    """Keypoints (B, C, F, P, 2) on which all views agree: triangulated with the true cameras and projected again.

    Each view counts for less, the farther its keypoint is from the last reprojection.
    """
    agreed, depth = found.keypoints, torch.ones_like(found.score)
    for _ in range(_ROUNDS):
        squared = (agreed - found.keypoints).square().sum(-1)
        agreed, depth = _reprojected(found, 1 / ((1 + squared / _SOFT_PX**2) * depth.square()))
    return agreed


def _reprojected(found: Detections, weights: Tensor) -> tuple[Tensor, Tensor]:
    """Pixels (B, C, F, P, 2) and depths (B, C, F, P) of points that are triangulated by weighted least squares.

    The residuals are distances from the rays; divided by the depth they are angles.
    """
    rotations, translations = found.rotations[:, :, None, None], found.translations[:, :, None, None]
    matrices = found.intrinsics[:, :, None]
    rays = found.keypoints - matrices[..., :2, 2, None].mT
    rays = rays / matrices.diagonal(dim1=-2, dim2=-1)[..., None, :2]
    across = rays[..., None] * rotations[..., 2:, :] - rotations[..., :2, :]  # (B, C, F, P, 2, 3)
    offset = translations[..., :2] - rays * translations[..., 2:]
    known = found.keypoints.isfinite().all(-1)[..., None]
    weighted = across.where(known[..., None], 0.0) * weights.where(known[..., 0], 0.0)[..., None, None]
    normal = torch.einsum("bcfpik,bcfpil->bfpkl", weighted, across.nan_to_num()) + _TINY * torch.eye(3, dtype=rays.dtype)
    points = torch.linalg.solve(normal, torch.einsum("bcfpik,bcfpi->bfpk", weighted, offset.nan_to_num()))
    local = (rotations @ points[:, None, ..., None])[..., 0] + translations
    image = local @ matrices.mT
    return image[..., :2] / image[..., 2:], local[..., 2]
