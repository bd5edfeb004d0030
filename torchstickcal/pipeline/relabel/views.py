"""The keypoints of some frames of one session as rays, and how well they meet in points."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchstickcal.geometry.triangulation import triangulate
from torchstickcal.model.measurements import Measurements
from torchstickcal.model.state import State

_KERNEL_SIGMAS = 8.0
_ITERATIONS = 8
_MOST_AT_ONCE = 200_000
_LENIENCE = 2.0
"""Factor on the noise: the cameras are not yet where they will be."""
_AGREEING, _CONTRADICTING = 6.0, -2.3
"""Logarithm of how much likelier a keypoint at no, or at a large, distance from its point is than one that is anywhere."""
_PRICE_OF_A_POINT = 9.0
"""What a point must bring to count as one, since three numbers fitted to few views explain much by chance."""


@dataclass(frozen=True)
class RayViews:
    """Keypoints of C cameras in n frames, and the cameras.

    Args:
        rays: undistorted, normalised image coordinates, (C, 2, n, P).
        weights: (C, n, P), zero where not seen.
        rotations: (C, 3, 3), world to camera.
        translations: (C, 3), world to camera.
        sigma: noise of each point's keypoints in each camera, in normalised image coordinates, (C, P).
    """

    rays: Tensor
    weights: Tensor
    rotations: Tensor
    translations: Tensor
    sigma: Tensor

    @staticmethod
    def of(measurements: Measurements, state: State, sigma_px: Tensor, frames: Tensor) -> RayViews:
        """Some frames of one session.

        Args:
            measurements: one session.
            state: its cameras.
            sigma_px: (P,), noise of each point's keypoints.
            frames: which frames, (n,).
        """
        cameras = measurements.cameras_at(state).to(torch.float64)[0]
        pixels = measurements.by_frame(measurements.pixels[0])[:, :, frames].double()
        rays = cameras.undistort(pixels.flatten(2).movedim(1, -1)).movedim(-1, 1).unflatten(-1, pixels.shape[2:])
        finite = rays.isfinite().all(1)
        weights = measurements.by_frame(measurements.confidence[0])[:, frames].double() * finite
        sigma = _LENIENCE * sigma_px / cameras.focal_px[:, None]
        return RayViews(rays.nan_to_num(), weights, state.rotations[0], state.translations[0], sigma)

    def at_frames(self, frames: slice | Tensor) -> RayViews:
        """Some of the frames, as a slice or a mask (n,)."""
        return replace(self, rays=self.rays[:, :, frames], weights=self.weights[:, frames])

    def at(self, points: Tensor) -> RayViews:
        """Some of the points (k,)."""
        return replace(self, rays=self.rays[..., points], weights=self.weights[..., points], sigma=self.sigma[:, points])

    def exchanged(self, where: Tensor, partner: Tensor) -> RayViews:
        """With keypoints of other points.

        Args:
            where: (..., C, n), in which cameras and frames.
            partner: (P,), the point whose keypoint each point gets there.
        """
        chosen = where.movedim(-2, 0)
        axes = (slice(None), *[None] * (chosen.ndim - 2))
        rays, weights = self.rays.movedim(1, -1)[axes], self.weights[axes]
        rays = torch.where(chosen[..., None, None], rays[..., partner, :], rays).movedim(-1, 1)
        weights = torch.where(chosen[..., None], weights[..., partner], weights)
        return replace(self, rays=rays, weights=weights)

    def points(self, cameras: list[int] | None = None) -> Tensor:
        """The points in which the rays of all cameras, or of some, meet, (3, ..., n, P); NaN for those with one view."""
        chosen: slice | list[int] = slice(None) if cameras is None else cameras
        shape = self.weights.shape[1:]
        rays, weights = self.rays[chosen].flatten(2), self.weights[chosen].flatten(1)
        scale = _KERNEL_SIGMAS * float(self.sigma.median())
        step = max(1, _MOST_AT_ONCE // len(rays))
        parts = [
            triangulate(
                self.rotations[chosen],
                self.translations[chosen],
                rays[..., first : first + step],
                weights[..., first : first + step],
                scale=scale,
                iterations=_ITERATIONS,
            )
            for first in range(0, rays.shape[-1], step)
        ]
        return torch.cat(parts, dim=-1).unflatten(-1, shape)

    def evidence(self, points: Tensor) -> Tensor:
        """How well each keypoint agrees with a point: the logarithm of a ratio of likelihoods, (C, ..., n, P); 0 where unseen.

        Args:
            points: (3, ..., n, P).
        """
        squared = self.squared_distances(points)
        agreeing = (_AGREEING - squared / 2).exp() + torch.tensor(_CONTRADICTING).exp()
        seen = (self.weights > 0).view(len(self.weights), *[1] * (agreeing.ndim - self.weights.ndim), *self.weights.shape[1:])
        return agreeing.log().where(seen & points.isfinite().all(0), 0.0)

    def squared_distances(self, points: Tensor) -> Tensor:
        """Squared distances of the keypoints from points (3, ..., n, P) in their images, in deviations, (C, ..., n, P)."""
        flat = points.nan_to_num().flatten(1)
        x, y, z = (self.rotations @ flat + self.translations[..., None]).unbind(1)
        depth = z.where(z > 0, torch.nan)
        projected = torch.stack([x / depth, y / depth], dim=1).unflatten(-1, points.shape[1:])
        rays = self.rays.view(*self.rays.shape[:2], *[1] * (projected.ndim - self.rays.ndim), *self.rays.shape[2:])
        sigma = self.sigma.view(len(self.sigma), *[1] * (points.ndim - 2), -1)
        return ((projected - rays).square().sum(1) / sigma.square()).nan_to_num(nan=torch.inf)

    def total_evidence(self) -> Tensor:
        """How well all keypoints of a frame agree in points, (..., n).

        A point is there where it explains more than it costs; otherwise its keypoints contradict each other.
        """
        each = self.evidence(self.points()).sum(0) - _PRICE_OF_A_POINT
        seen = (self.weights > 0).sum(0)
        return torch.maximum(each, _CONTRADICTING * seen).where(seen >= 2, 0.0).sum(-1)
