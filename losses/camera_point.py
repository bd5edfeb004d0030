"""Losses that couple one camera and one point."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import NamedTuple, Protocol, Self

import torch
from torch import Tensor

from torchstickcal.dual import dual, dual_numbers, tangent
from torchstickcal.geometry import projection
from torchstickcal.geometry.cameras import Intrinsics, PixelMap
from torchstickcal.geometry.symmetric import six_entries
from torchstickcal.inference import differentiates
from torchstickcal.losses.base import Loss, checked_residuals
from torchstickcal.precision import in_common_precision, in_full_precision


class CameraUnknownsAt(Protocol):
    """How projections and keypoints depend on what is unknown of the cameras beside their poses: k numbers per camera."""

    @property
    def components(self) -> int:
        """k"""
        ...

    def projection_derivatives(self, u: Tensor, v: Tensor, pixel: PixelMap) -> tuple[Tensor, Tensor]:
        """Derivatives of projections (x, y), each (..., C, k, N), at normalised coordinates (..., C, N)."""
        ...

    def moved(self, deviations: Tensor) -> tuple[Intrinsics, Tensor]:
        """Cameras and keypoints (..., C, 2, N) at deviations (..., C, k) from the present values."""
        ...


class UnknownTerms(NamedTuple):
    """A camera-point loss, linearised by k unknowns of each of C cameras, beside its pose."""

    gradient: Tensor
    """(..., C, k): half the derivative"""
    hessian: Tensor
    """(..., C, k, k): the Gauss-Newton block"""
    coupling: Tensor
    """(..., C, k, 3, N): the block with the point, in world axes"""


class CameraPointSlopes(NamedTuple):
    """A camera-point loss at C cameras and N points, with its first derivatives."""

    cost: Tensor
    """(...): the loss"""
    squares: Tensor
    """(..., C): weighted sum of squared residuals, in the residual's unit"""
    weights: Tensor
    """(..., C): sum of those weights"""
    gradient: Tensor
    """(..., C, 3, N): half the derivative by the point, in world axes"""
    unknown_gradient: Tensor | None
    """(..., C, k): the same by what else is unknown of the cameras; None where that is nothing"""


class CameraPointTerms(NamedTuple):
    """A camera-point loss, linearised at C cameras and N points."""

    cost: Tensor
    """(...): the loss"""
    squares: Tensor
    """(..., C): weighted sum of squared residuals, in the residual's unit"""
    weights: Tensor
    """(..., C): sum of those weights"""
    gradient: Tensor
    """(..., C, 3, N): half the derivative by the point, in world axes"""
    hessian: Tensor
    """(..., C, 6, N): the Gauss-Newton block J^T J by the point, entries xx xy xz yy yz zz"""
    unknown: UnknownTerms | None
    """the same by what else is unknown of the cameras; None where that is nothing"""


class CameraPointLoss(Loss, ABC):
    """Couples one camera and one point: everything that compares a point's image with a keypoint."""

    @abstractmethod
    def residuals(self, points_cam: Tensor, keypoints: Tensor, intrinsics: Intrinsics) -> Tensor:
        """Residuals (..., C, n, m), not yet divided by sigma.

        Args:
            points_cam: the points in every camera's frame, (..., C, n, 3), metres.
            keypoints: (..., C, n, 2), pixels.
            intrinsics: the C cameras.
        """

    def of_columns(self, columns: slice | Tensor, points: int) -> Self:
        """The loss as it is applied to some columns, of ``points`` points side by side in each frame; here the same."""
        del columns, points
        return self

    @in_full_precision
    def forward(
        self,
        points: Tensor,
        rotations: Tensor,
        translations: Tensor,
        keypoints: Tensor,
        intrinsics: Intrinsics | Tensor,
        confidence: Tensor | None = None,
    ) -> Tensor:
        """The loss.

        Args:
            points: (..., F, P, 3), metres, in the world. NaN for points that are not known.
            rotations: (..., C, 3, 3), world to camera.
            translations: (..., C, 3), metres, world to camera.
            keypoints: (..., C, F, P, 2), pixels, NaN where not seen.
            intrinsics: the cameras, or camera matrices (3, 3) or (..., C, 3, 3).
            confidence: (..., C, F, P), 0 to 1; None for 1. It does not matter where a keypoint was not seen.

        Returns:
            A scalar.
        """
        residuals = self.of_scene(points, rotations, translations, keypoints, intrinsics)
        squared = residuals.square().sum(-1) * self.information(residuals)
        if confidence is not None:
            squared = squared * confidence.where(keypoints.isfinite().all(-1), 0.0)
        return self.total(squared)

    @in_full_precision
    def of_scene(
        self, points: Tensor, rotations: Tensor, translations: Tensor, keypoints: Tensor, intrinsics: Intrinsics | Tensor
    ) -> Tensor:
        """Residuals (..., C, F, P, m), zero where a keypoint was not seen or its point is not known."""
        lens = intrinsics if isinstance(intrinsics, Intrinsics) else Intrinsics(intrinsics.expand_as(rotations))
        given = (
            points,
            rotations,
            translations,
            keypoints,
            lens.matrix,
            *([] if lens.distortion is None else [lens.distortion]),
        )
        points, rotations, translations, keypoints, matrix, *distortion = in_common_precision(*given)
        known = points.isfinite().all(-1, keepdim=True)
        seen = keypoints.isfinite().all(-1, keepdim=True) & known.unsqueeze(-4)
        points_cam = projection.to_cameras(points.where(known, 0.0), rotations, translations)
        points_cam = torch.where(seen, points_cam, points.new_tensor([0.0, 0.0, 1.0]))
        cameras = Intrinsics(matrix, distortion[0] if distortion else None, lens.fisheye)
        found = self._residuals(points_cam.flatten(-3, -2), keypoints.where(seen, 0.0).flatten(-3, -2), cameras)
        found = found.unflatten(-2, keypoints.shape[-3:-1])
        return torch.where(seen, found, torch.zeros_like(found))

    def linearise(
        self,
        points_cam: Tensor,
        rotations: Tensor,
        pixels: Tensor,
        information: Tensor,
        cameras: Intrinsics,
        exact: bool = False,
        unknowns: CameraUnknownsAt | None = None,
    ) -> CameraPointTerms:
        """The terms at N points, here by automatic differentiation of the residuals.

        Args:
            points_cam: the points in every camera's frame, (..., C, 3, N).
            rotations: world to camera, (..., C, 3, 3).
            pixels: keypoints, (..., C, 2, N).
            information: confidence / sigma^2, (..., C, N), zero where not seen.
            cameras: the C cameras.
            exact: whether the blocks by the points are those of the exact Hessian, with the curvature of kernel and projection.
            unknowns: what else is unknown of the cameras; None where that is nothing.
        """
        squared, weights = self._weighted(points_cam, pixels, information, cameras)
        residuals, jacobian = self._with_jacobian(points_cam, pixels, cameras)
        hessian = torch.einsum("...nmi,...nmj,...n->...nij", jacobian, jacobian, weights)
        if exact:
            hessian = self._exact_hessian(points_cam, pixels, information, cameras)
        hessian = rotations.mT.unsqueeze(-3) @ hessian @ rotations.unsqueeze(-3)
        gradient = torch.einsum("...nm,...nmi,...n->...in", residuals, jacobian, weights)
        terms = None
        if unknowns is not None:
            columns = self._by_unknowns(unknowns, points_cam)
            weighted = columns * weights[..., None, :, None]
            terms = UnknownTerms(
                gradient=torch.einsum("...cknm,...cnm->...ck", weighted, residuals),
                hessian=torch.einsum("...cknm,...clnm->...ckl", weighted, columns),
                coupling=torch.einsum("...cknm,...cnmi,...cij->...ckjn", weighted, jacobian, rotations),
            )
        return CameraPointTerms(
            *self._sums(squared, squared * information, weights),
            gradient=rotations.mT @ gradient,
            hessian=six_entries(hessian.movedim(-3, -1)),
            unknown=terms,
        )

    def slopes(
        self,
        points_cam: Tensor,
        rotations: Tensor,
        pixels: Tensor,
        information: Tensor,
        cameras: Intrinsics,
        unknowns: CameraUnknownsAt | None = None,
    ) -> CameraPointSlopes:
        """The terms of first order alone, here by automatic differentiation; the arguments are those of :meth:`linearise`."""
        squared, weights = self._weighted(points_cam, pixels, information, cameras)
        residuals, jacobian = self._with_jacobian(points_cam, pixels, cameras)
        gradient = torch.einsum("...nm,...nmi,...n->...in", residuals, jacobian, weights)
        by_unknowns = None
        if unknowns is not None:
            columns = self._by_unknowns(unknowns, points_cam)
            by_unknowns = torch.einsum("...cknm,...cnm,...cn->...ck", columns, residuals, weights)
        return CameraPointSlopes(
            *self._sums(squared, squared * information, weights),
            gradient=rotations.mT @ gradient,
            unknown_gradient=by_unknowns,
        )

    def slope(
        self,
        points_cam: Tensor,
        moved_cam: Tensor,
        pixels: Tensor,
        information: Tensor,
        cameras: Intrinsics,
        unknowns: CameraUnknownsAt | None = None,
        step: Tensor | None = None,
    ) -> Tensor:
        """Half the derivative of the loss, summed, where points and cameras move; differentiable by all that is given.

        Args:
            points_cam: the points in every camera's frame, (..., C, 3, N).
            moved_cam: how they move, (..., C, 3, N).
            pixels: keypoints, (..., C, 2, N).
            information: confidence / sigma^2, (..., C, N), zero where not seen.
            cameras: the C cameras.
            unknowns: what else is unknown of the cameras.
            step: how that changes, (..., C, k); None where it does not.
        """
        with dual_numbers():
            moving = dual(points_cam, moved_cam)
            if unknowns is not None and step is not None:
                cameras, pixels = unknowns.moved(dual(torch.zeros_like(step), step))
            value = self.total(self._squared(moving, pixels, cameras) * information)
            return tangent(value) / 2

    def point_information(
        self, points_cam: Tensor, rotations: Tensor, pixels: Tensor, information: Tensor, cameras: Intrinsics
    ) -> Tensor:
        """The Gauss-Newton blocks J^T J by the points, summed over the cameras, (..., 6, N); differentiable by all arguments.

        The arguments are those of :meth:`linearise`.
        """
        _, weights = self._weighted(points_cam, pixels, information, cameras)
        columns: list[Tensor] = []
        for axis in rotations.unbind(-1):
            with dual_numbers():
                moving = dual(points_cam, axis.unsqueeze(-1).expand_as(points_cam))
                columns.append(tangent(self._residuals(moving.mT, pixels.mT, cameras)))
        pairs = [(columns[i] * columns[j]).sum(-1) for i in range(3) for j in range(i, 3)]
        return torch.stack([(weights * pair).sum(-2) for pair in pairs], dim=-2)

    def _weighted(self, points_cam: Tensor, pixels: Tensor, information: Tensor, cameras: Intrinsics) -> tuple[Tensor, Tensor]:
        """Squared residuals (..., C, N), not divided by sigma, and the weights of the keypoints with the kernel's."""
        squared = self._squared(points_cam, pixels, cameras)
        return squared, self.weight * information * self.kernel.weight(squared * information)

    def _sums(self, squared: Tensor, whitened: Tensor, weights: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Cost, squares and weights of the terms, of squared residuals (..., C, N), as they are and divided by sigma^2."""
        return self.total(whitened, over=2), (weights * squared).sum(-1), weights.sum(-1)

    def _squared(self, points_cam: Tensor, pixels: Tensor, cameras: Intrinsics) -> Tensor:
        """Squared residuals (..., C, N), not divided by sigma."""
        return self._residuals(points_cam.mT, pixels.mT, cameras).square().sum(-1)

    def _residuals(self, points_cam: Tensor, keypoints: Tensor, cameras: Intrinsics) -> Tensor:
        """:meth:`residuals`, checked."""
        return checked_residuals(self, self.residuals(points_cam, keypoints, cameras), points_cam.shape[:-1])

    @differentiates
    def _with_jacobian(self, points_cam: Tensor, pixels: Tensor, cameras: Intrinsics) -> tuple[Tensor, Tensor]:
        """Residuals (..., C, N, m), and their derivatives (..., C, N, m, 3) by the points in the cameras' frames."""
        at = points_cam.detach().mT.requires_grad_()
        residuals = self.residuals(at, pixels.mT, cameras)
        rows = [torch.autograd.grad(row.sum(), at, retain_graph=True)[0] for row in residuals.unbind(-1)]
        return residuals.detach(), torch.stack(rows, dim=-2)

    @differentiates
    def _exact_hessian(self, points_cam: Tensor, pixels: Tensor, information: Tensor, cameras: Intrinsics) -> Tensor:
        """Half the second derivatives (..., C, N, 3, 3) of the loss by the points in the cameras' frames."""
        at = points_cam.detach().requires_grad_()
        value = self.total(self._squared(at, pixels, cameras) * information)
        (gradient,) = torch.autograd.grad(value / 2, at, create_graph=True)
        rows = [torch.autograd.grad(row.sum(), at, retain_graph=True)[0] for row in gradient.unbind(-2)]
        return torch.stack(rows, dim=-3).movedim(-1, -3)

    def _by_unknowns(self, unknowns: CameraUnknownsAt, points_cam: Tensor) -> Tensor:
        """Derivatives (..., C, k, N, m) of the residuals by each of the cameras' k numbers."""
        found: list[Tensor] = []
        for component in range(unknowns.components):
            direction = points_cam.new_zeros(*points_cam.shape[:-2], unknowns.components)
            direction[..., component] = 1.0
            with dual_numbers():
                cameras, pixels = unknowns.moved(dual(torch.zeros_like(direction), direction))
                found.append(tangent(self.residuals(points_cam.mT, pixels.mT, cameras)))
        return torch.stack(found, dim=-3)
