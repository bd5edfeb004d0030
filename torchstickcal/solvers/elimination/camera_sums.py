"""Sums over all points from which the cameras' own part of the normal equations follows."""

from __future__ import annotations

import itertools
from functools import lru_cache

import torch
from torch import Tensor

from torchstickcal.geometry import se3
from torchstickcal.losses.camera_point import UnknownTerms


class CameraSums:
    """Sums over all points from which the cameras' own gradients and Hessian blocks follow.

    B(X) is linear in the homogeneous coordinates h = (1, x, y, z). So the sums of B^T g and of B^T N B over the points are
    linear in the moments ``sum g h^T`` (3 x 4) and in the moments of N with the ten distinct products h_a h_b.

    Args:
        like: a tensor (B, ...) with the dtype and device of the sums.
        cameras: C.
        free: C', number of free cameras.
        components: k, number of lens and clock unknowns per camera.
    """

    unknown_gradient: Tensor
    """(B, C, k)"""
    unknown_hessian: Tensor
    """(B, C, k, k)"""

    def __init__(self, like: Tensor, cameras: int, free: int, components: int) -> None:
        self._sessions, self._free, zeros = len(like), free, like.new_zeros
        self._gradient_moments = zeros(self._sessions, 3 * free, 4)
        self._hessian_moments = zeros(self._sessions, 6 * free, 10)
        self._unknown_moments = zeros(self._sessions, free, components, 3, 4)
        self.unknown_gradient = zeros(self._sessions, cameras, components)
        self.unknown_hessian = zeros(self._sessions, cameras, components, components)
        self._gradient_map, self._hessian_map = _moment_maps(like.device)

    def add(self, points: Tensor, gradient: Tensor, hessian: Tensor, unknown: UnknownTerms | None) -> None:
        """Add the points (B, 3, n) of a chunk: gradients (B, C, 3, n), Hessians (B, C, 6, n), terms of the unknowns."""
        homogeneous = self.add_gradient(points, gradient, None if unknown is None else unknown.gradient)
        products = torch.cat([homogeneous[:, a : a + 1] * homogeneous[:, a:] for a in range(4)], dim=1)
        self._hessian_moments += hessian[:, 1:].flatten(1, 2) @ products.mT
        if unknown is not None:
            self.unknown_hessian += unknown.hessian
            self._unknown_moments += unknown.coupling[:, 1:] @ homogeneous.mT[:, None, None]

    def add_gradient(self, points: Tensor, gradient: Tensor, unknown_gradient: Tensor | None) -> Tensor:
        """Add only what the gradients need: also those of the unknowns, (B, C, k). Returns h, (B, 4, n)."""
        homogeneous = torch.cat([torch.ones_like(points[:, :1]), points], dim=1)
        self._gradient_moments += gradient[:, 1:].flatten(1, 2) @ homogeneous.mT
        if unknown_gradient is not None:
            self.unknown_gradient += unknown_gradient
        return homogeneous

    def include(self, other: CameraSums) -> None:
        """Add the sums over other points."""
        self._gradient_moments += other._gradient_moments
        self._hessian_moments += other._hessian_moments
        if self.unknown_gradient.numel():
            self._unknown_moments += other._unknown_moments
            self.unknown_gradient += other.unknown_gradient
            self.unknown_hessian += other.unknown_hessian

    def pose_gradient(self) -> Tensor:
        """Gradient with respect to the tangents, (B, C', 6)."""
        return self._gradient_moments.view(self._sessions, self._free, 12) @ self._gradient_map

    def pose_hessian(self, exact: bool) -> Tensor:
        """Hessian block of each camera's tangent, (B, C', 6, 6)."""
        blocks = (self._hessian_moments.view(self._sessions, self._free, 60) @ self._hessian_map).unflatten(-1, (6, 6))
        if exact:
            blocks += _pose_curvature(self._gradient_moments.view(self._sessions, self._free, 3, 4))
        return blocks

    def unknown_pose_hessian(self) -> Tensor:
        """Hessian blocks between each camera's lens and clock unknowns and its tangent, (B, C', k, 6)."""
        return self._unknown_moments.flatten(3) @ self._gradient_map


def _pose_curvature(moments: Tensor) -> Tensor:
    """Addition of the exact Hessian to the pose block of each camera, (B, C', 6, 6), from the moments of g, (B, C', 3, 4).

    It is the second-order term of ``Exp(nu, omega) X = X + nu + omega x X + (omega x nu + omega x (omega x X)) / 2 + ...``.
    """
    gradient, by_point = moments[..., 0], moments[..., 1:]
    curvature = moments.new_zeros(*moments.shape[:2], 6, 6)
    curvature[..., :3, 3:] = se3.hat(gradient) / 2
    curvature[..., 3:, :3] = curvature[..., :3, 3:].mT
    trace = by_point.diagonal(dim1=-2, dim2=-1).sum(-1)
    curvature[..., 3:, 3:] = (by_point + by_point.mT) / 2 - trace[..., None, None] * torch.eye(3).to(moments)
    return curvature


_PRODUCTS = ([0, 0, 0, 0, 1, 1, 1, 2, 2, 3], [0, 1, 2, 3, 1, 2, 3, 2, 3, 3])
"""The ten distinct products of the homogeneous coordinates (1, x, y, z)."""


@lru_cache(maxsize=8)
@torch.inference_mode(mode=False)
def _moment_maps(device: torch.device) -> tuple[Tensor, Tensor]:
    """Linear maps from the moments of g (12) to B^T g, (12, 6), and from the moments of N (60) to B^T N B, (60, 36).

    With B(X) = sum_a h_a B_a: B^T g = sum_a B_a^T (g h_a), and B^T N B = sum_ab B_a^T (N h_a h_b) B_b.
    """
    basis = torch.zeros(4, 3, 6, dtype=torch.float64)
    basis[0, :, :3] = torch.eye(3)
    basis[1:, :, 3:] = -se3.hat(torch.eye(3, dtype=torch.float64))
    hessian_map = torch.zeros(6, 10, 6, 6, dtype=torch.float64)
    entries = torch.tensor([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
    product = torch.zeros(4, 4, dtype=torch.long)
    product[_PRODUCTS] = product[_PRODUCTS[::-1]] = torch.arange(10)
    for a, b, i, j in itertools.product(range(4), range(4), range(3), range(3)):
        hessian_map[entries[i, j], product[a, b]] += torch.outer(basis[a, i], basis[b, j])
    gradient_map = basis.transpose(0, 1).reshape(12, 6)
    return gradient_map.to(device), hessian_map.view(60, 36).to(device)
