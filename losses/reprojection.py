"""The reprojection loss: distance in the image between a keypoint and the projection of its 3D point."""

from __future__ import annotations

import torch
from torch import Tensor

from torchstickcal.cameras import Intrinsics
from torchstickcal.losses.base import CameraPointLoss, CameraPointTerms


def reprojection_residuals(
    points: Tensor, rotations: Tensor, translations: Tensor, keypoints: Tensor, intrinsics: Intrinsics | Tensor
) -> Tensor:
    """Projection minus keypoint, in (distorted) pixels; the paper's residuals of stage 1, negated.

    Args:
        points: (F, P, 3), metres, world.
        rotations: (C, 3, 3) and translations: (C, 3), world to camera.
        keypoints: (C, F, P, 2), NaN where not seen.
        intrinsics: cameras with their lenses, or matrices (C, 3, 3) or (3, 3).

    Returns:
        (C, F, P, 2), zero where a keypoint was not seen or its point is not known.
    """
    cameras = _as_intrinsics(intrinsics, rotations)
    seen = keypoints.isfinite().all(-1, keepdim=True) & points.isfinite().all(-1, keepdim=True)
    in_front = torch.tensor([0.0, 0.0, 1.0]).to(points)
    points_cam = torch.einsum("cij,fpj->cfpi", rotations, points.nan_to_num()) + translations[:, None, None]
    projected = cameras.project(torch.where(seen, points_cam, in_front))
    return torch.where(seen, projected - keypoints.nan_to_num(), torch.zeros_like(projected))


class ReprojectionLoss(CameraPointLoss):
    """``weight * sum rho(confidence |r|^2 / sigma^2)`` over all keypoints seen, r of :func:`reprojection_residuals`.

    Args:
        sigma: noise of a keypoint in pixels, one number or one per point (P,).
        weight: factor on the loss.
        kernel: robust kernel; None for least squares.
    """

    def forward(
        self,
        points: Tensor,
        rotations: Tensor,
        translations: Tensor,
        keypoints: Tensor,
        intrinsics: Intrinsics | Tensor,
        confidence: Tensor | None = None,
    ) -> Tensor:
        residuals = reprojection_residuals(points, rotations, translations, keypoints, intrinsics)
        squared = residuals.square().sum(-1) * self.information(residuals)
        return self.total(squared if confidence is None else squared * confidence)

    def cost(self, points_cam: Tensor, pixels: Tensor, information: Tensor, cameras: Intrinsics) -> Tensor:
        x, y = cameras.project_components(*points_cam.unbind(1))
        return self.total(((x - pixels[:, 0]).square() + (y - pixels[:, 1]).square()) * information)

    def linearise(
        self, points_cam: Tensor, rotations: Tensor, pixels: Tensor, information: Tensor, cameras: Intrinsics
    ) -> CameraPointTerms:
        x, y, jacobian = cameras.project_with_jacobian(*points_cam.unbind(1))
        residual = torch.stack([x, y], dim=1).sub_(pixels)
        squared_px = residual.square().sum(1)
        squared = squared_px * information
        weights = self.weight * information * self.kernel.weight(squared)
        world = rotations.mT[:, None] @ jacobian
        weighted = world * weights[:, None, None]
        return CameraPointTerms(
            cost=self.total(squared),
            squares=(weights * squared_px).sum(1),
            weights=weights.sum(1),
            gradient=(weighted * residual[:, :, None]).sum(1),
            hessian=torch.cat(
                [
                    (weighted[:, :, :1] * world).sum(1),
                    (weighted[:, :, 1:2] * world[:, :, 1:]).sum(1),
                    (weighted[:, :, 2:] * world[:, :, 2:]).sum(1),
                ],
                dim=1,
            ),
        )


def _as_intrinsics(intrinsics: Intrinsics | Tensor, rotations: Tensor) -> Intrinsics:
    if isinstance(intrinsics, Intrinsics):
        return intrinsics
    return Intrinsics(intrinsics.expand(rotations.shape[0], 3, 3))
