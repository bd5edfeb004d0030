"""What every loss has, and the three ways in which a loss may couple the unknowns.

A solver knows couplings, not losses: a loss that subclasses one of the three classes below works in both solvers.
``forward`` is the loss as a scalar of plain tensors, differentiable by autograd; ``linearise`` gives the same residuals
with their analytic derivatives, laid out coordinate-first for the Gauss-Newton solver. Both take any leading dimensions
before those named, for several sessions at once; ``forward`` sums over them, ``linearise`` keeps them.
"""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import NamedTuple, Self

import torch
from torch import Tensor, nn

from torchstickcal.geometry.cameras import Intrinsics, PixelMap
from torchstickcal.losses.robust import Quadratic, RobustKernel

UnknownColumns = Callable[[Tensor, Tensor, PixelMap], tuple[Tensor, Tensor]]
"""Derivatives of projections (x, y), each (..., C, k, N), by what is unknown of the cameras beside their poses, of normalised
coordinates (..., C, N) and the pixels there."""

ImageStep = Callable[[Tensor, Tensor, PixelMap], tuple[Tensor, Tensor]]
"""How projections (x, y) move, each (..., C, N), where the points stay, of the same."""


class Loss(nn.Module):
    """A sum of robust squared residuals in units of their standard deviation.

    Args:
        sigma: standard deviation of a residual in its own unit; a number, or a tensor with one per point or stick. Where it
            differs between sessions, a tensor that broadcasts against the residuals.
        weight: factor on the whole loss (the paper's lambda).
        kernel: robust kernel on squared whitened residuals.
    """

    sigma: Tensor

    def __init__(self, sigma: float | Tensor = 1.0, weight: float = 1.0, kernel: RobustKernel | None = None) -> None:
        super().__init__()
        self.register_buffer("sigma", torch.as_tensor(sigma, dtype=torch.float64))
        self.weight = weight
        self.kernel = kernel if kernel is not None else Quadratic()

    def total(self, whitened_squared: Tensor, over: int | None = None) -> Tensor:
        """The loss of squared whitened residuals, summed over all dimensions or over that many of the last."""
        rho = self.kernel.rho(whitened_squared)
        return self.weight * (rho.sum() if over is None else rho.sum(tuple(range(-over, 0)), dtype=torch.float64))

    def of(self, sessions: slice) -> Self:
        """The same loss for some of the sessions that ``sigma`` has as its first of three dimensions or more."""
        if self.sigma.ndim < 3:
            return self
        part = copy.deepcopy(self)
        part.sigma = self.sigma[sessions]
        return part

    def replaced(self, where: Tensor, other: Self) -> Self:
        """The same loss with the ``sigma`` of some sessions (B,), True where, that of another."""
        if self.sigma.ndim < 3:
            return self
        mixed = copy.deepcopy(self)
        mixed.sigma = torch.where(where.view(-1, *[1] * (self.sigma.ndim - 1)), other.sigma, self.sigma)
        return mixed

    def information(self, like: Tensor) -> Tensor:
        """1 / sigma^2 in the dtype and on the device of a tensor."""
        return self.sigma.to(like).square().reciprocal()


class UnknownTerms(NamedTuple):
    """A camera-point loss, linearised by k unknowns of each of C cameras, beside its pose."""

    gradient: Tensor
    """(..., C, k): half the derivative"""
    hessian: Tensor
    """(..., C, k, k): the Gauss-Newton block"""
    coupling: Tensor
    """(..., C, k, 3, N): the block with the point, in the world's axes"""


class CameraPointTerms(NamedTuple):
    """A camera-point loss, linearised at C cameras and N points."""

    cost: Tensor
    """(...): the loss"""
    squares: Tensor
    """(..., C): weighted sum of squared residuals, in pixels"""
    weights: Tensor
    """(..., C): sum of those weights"""
    gradient: Tensor
    """(..., C, 3, N): half the derivative by the point, in the world's axes"""
    hessian: Tensor
    """(..., C, 6, N): the Gauss-Newton block J^T J by the point, entries xx xy xz yy yz zz"""
    unknown: UnknownTerms | None
    """the same by what else is unknown of the cameras"""


class PairTerms(NamedTuple):
    """A loss on pairs of points of one frame, linearised at F frames and S pairs."""

    cost: Tensor
    """(...): the loss"""
    gradient: Tensor
    """(..., 3, F, S): half the derivative by the pair's second point; by its first point it is the negative"""
    hessian: Tensor
    """(..., 6, F, S): the block by either point, entries xx xy xz yy yz zz; between the two it is the negative"""


class TrackTerms(NamedTuple):
    """A loss on the frames of one point, linearised at F frames and P points: residuals ``stencil * track``."""

    cost: Tensor
    """(...): the loss"""
    residual: Tensor
    """(..., 3, F - 2, P): weighted residuals"""
    scale: Tensor
    """(..., F - 2, P): the factor in them; their Jacobian by frames f, f+1, f+2 is scale (1, -2, 1) I"""


class CameraPointLoss(Loss, ABC):
    """Couples one camera and one point: everything that compares a projection with an image."""

    @abstractmethod
    def forward(
        self,
        points: Tensor,
        rotations: Tensor,
        translations: Tensor,
        keypoints: Tensor,
        intrinsics: Intrinsics | Tensor,
        confidence: Tensor | None = None,
    ) -> Tensor:
        """The loss of points (F, P, 3) in cameras (C, 3, 3), (C, 3) that saw keypoints (C, F, P, 2)."""

    @abstractmethod
    def linearise(
        self,
        points_cam: Tensor,
        rotations: Tensor,
        pixels: Tensor,
        information: Tensor,
        cameras: Intrinsics,
        exact: bool = False,
        by_unknowns: UnknownColumns | None = None,
    ) -> CameraPointTerms:
        """The terms at N points.

        Args:
            points_cam: the points in every camera's frame, (..., C, 3, N).
            rotations: world to camera, (..., C, 3, 3).
            pixels: (..., C, 2, N).
            information: confidence / sigma^2, (..., C, N), zero where not seen.
            cameras: the C cameras.
            exact: whether the blocks are of the exact Hessian, with the curvature of kernel and projection.
            by_unknowns: what else is unknown of the cameras.
        """

    @abstractmethod
    def slope(
        self,
        points_cam: Tensor,
        moved_cam: Tensor,
        pixels: Tensor,
        information: Tensor,
        cameras: Intrinsics,
        image_step: ImageStep | None = None,
    ) -> Tensor:
        """Half the derivative of the loss where points and cameras move, summed: differentiable by all that is given.

        Args:
            points_cam: the points in every camera's frame, (..., C, 3, N).
            moved_cam: how they move, (..., C, 3, N).
            pixels: (..., C, 2, N).
            information: confidence / sigma^2, (..., C, N), zero where not seen.
            cameras: the C cameras.
            image_step: what changes of the cameras beside their poses.
        """


class PairLoss(Loss, ABC):
    """Couples two points of one frame through the vector between them."""

    @abstractmethod
    def linearise(self, difference: Tensor, length_m: Tensor, active: Tensor, exact: bool = False) -> PairTerms:
        """Terms at differences (..., 3, F, S) of the pairs' ends, nominal lengths (..., 1, S) and a mask (..., F, S)."""

    @abstractmethod
    def slope(self, difference: Tensor, moved: Tensor, length_m: Tensor, active: Tensor) -> Tensor:
        """Half the derivative of the loss where the differences move by (..., 3, F, S), summed; differentiable."""


class TrackLoss(Loss, ABC):
    """Couples three consecutive frames of one point through their second difference."""

    @abstractmethod
    def slope(self, points: Tensor, moved: Tensor, active: Tensor) -> Tensor:
        """Half the derivative of the loss where the points move by (..., 3, F, P), summed; differentiable."""

    @abstractmethod
    def linearise(self, points: Tensor, active: Tensor) -> TrackTerms:
        """Terms at points (..., 3, F, P) with a mask (..., F, P) of points that exist."""
