"""What a detector found in some sessions of known rigs, and what is true of them."""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from torch import Tensor


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
    poses = torch.cat([found.rotations, found.translations[..., None]], -1)[:, :, None, None]
    rays = (found.keypoints - found.intrinsics[:, :, None, None, :2, 2]) / found.intrinsics[:, :, None, None, :2, :2].diagonal(
        dim1=-2, dim2=-1
    )
    known = found.keypoints.isfinite().all(-1)
    planes = (rays[..., None].nan_to_num() * poses[..., 2:, :] - poses[..., :2, :]) * known[
        ..., None, None
    ]  # (B, C, F, P, 2, 4)
    weights = torch.ones_like(found.score)
    for _ in range(4):
        weighted = planes * weights[..., None, None]
        normal = torch.einsum("bcfpik,bcfpil->bfpkl", weighted, planes)
        ridge = 1e-9 * torch.eye(3, dtype=normal.dtype)
        points = -torch.linalg.solve(normal[..., :3, :3] + ridge, normal[..., :3, 3])
        local = (poses[..., :3] @ points[:, None, ..., None])[..., 0] + poses[..., 3]
        image = local @ found.intrinsics[:, :, None].mT
        image = image[..., :2] / image[..., 2:]
        squared = (image - found.keypoints).square().sum(-1).nan_to_num()
        weights = (1 / (1 + squared / 25)) / local[..., 2].square()
    return image
