"""What every loss has in common, and the three ways in which a loss may couple the unknowns.

A loss is a sum of robust squared residuals, each divided by its standard deviation. It subclasses the class that says what one
residual depends on:

* :class:`CameraPointLoss`: one camera and one point, through the point's image;
* :class:`FrameLoss`: some points of one frame;
* :class:`TrackLoss`: one point in two or three consecutive frames.

Only the residuals have to be written. The scalar for training loops and LBFGS, the linearised form for Gauss-Newton, and the
slope for exact gradients follow from them by automatic differentiation. A loss that is worth it overrides ``linearise`` and
``slope`` with closed forms. Leading dimensions before those named stand for sessions: scalars sum over them, linearised forms
keep them.
"""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from typing import ClassVar, NamedTuple, Protocol, Self

import torch
from torch import Tensor, nn
from torch.autograd import forward_ad

from torchstickcal.errors import ConfigError
from torchstickcal.geometry import projection
from torchstickcal.geometry.cameras import Intrinsics, PixelMap
from torchstickcal.losses.robust import Quadratic, RobustKernel


class Loss(nn.Module):
    """A sum of robust squared residuals in units of their standard deviation.

    Args:
        sigma: standard deviation of a residual in its own unit; a number, or a tensor with one per point or group. Where it
            differs between sessions, a tensor that broadcasts against the squared residuals.
        weight: factor on the whole loss (the paper's lambda).
        kernel: robust kernel on squared whitened residuals; None for least squares.
    """

    sigma: Tensor

    def __init__(self, sigma: float | Tensor = 1.0, weight: float = 1.0, kernel: RobustKernel | None = None) -> None:
        super().__init__()
        self.register_buffer("sigma", torch.as_tensor(sigma, dtype=torch.float64))
        self.weight = weight
        self.kernel = kernel if kernel is not None else Quadratic()

    def total(self, whitened_squared: Tensor, over: int | None = None) -> Tensor:
        """The loss of squared whitened residuals, summed over all dimensions or over the last ``over`` of them."""
        rho = self.kernel.rho(whitened_squared)
        return self.weight * (rho.sum() if over is None else rho.sum(tuple(range(-over, 0)), dtype=torch.float64))

    def of(self, sessions: slice) -> Self:
        """The same loss for some of the sessions, where ``sigma`` has a dimension for them (its first of three or more)."""
        if self.sigma.ndim < 3:
            return self
        part = copy.deepcopy(self)
        part.sigma = self.sigma[sessions]
        return part

    def replaced(self, where: Tensor, other: Self) -> Self:
        """The same loss with the ``sigma`` of some sessions (B,), True where, taken from another loss."""
        if self.sigma.ndim < 3:
            return self
        mixed = copy.deepcopy(self)
        mixed.sigma = torch.where(where.view(-1, *[1] * (self.sigma.ndim - 1)), other.sigma, self.sigma)
        return mixed

    def information(self, like: Tensor) -> Tensor:
        """1 / sigma^2 in the dtype and on the device of a tensor."""
        return self.sigma.to(like).square().reciprocal()

    def likelihood(self, sigma_px: Tensor) -> Self | None:
        """The loss as minus twice the logarithm of a normal density, for covariances; None if it is none.

        A loss with a weight other than 1 is none: its sigma is not a standard deviation.

        Args:
            sigma_px: estimated noise of each point's keypoints, (B, P).
        """
        del sigma_px
        if self.weight != 1.0:
            return None
        normal = copy.deepcopy(self)
        normal.kernel = Quadratic()
        return normal


class CameraUnknownsAt(Protocol):
    """How projections and keypoints depend on what is unknown of the cameras beside their poses: k numbers per camera."""

    @property
    def components(self) -> int:
        """k"""
        ...

    def columns(self, u: Tensor, v: Tensor, pixel: PixelMap) -> tuple[Tensor, Tensor]:
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


class FrameTerms(NamedTuple):
    """A frame loss, linearised at F frames and G groups of k points."""

    cost: Tensor
    """(...): the loss"""
    gradient: Tensor
    """(..., k, 3, F, G): half the derivative by each point of the group"""
    hessian: Tensor
    """(..., k, k, 3, 3, F, G): the blocks between the points of the group"""


class TrackTerms(NamedTuple):
    """A track loss, linearised at F frames and P points; its residuals are ``scale * stencil * track``."""

    cost: Tensor
    """(...): the loss"""
    residual: Tensor
    """(..., 3, F - reach, P): weighted residuals"""
    scale: Tensor
    """(..., F - reach, P): the factor in them; their Jacobian by frame f + i is ``scale * stencil[i] * I``"""


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
            confidence: (..., C, F, P), 0 to 1; None for 1.

        Returns:
            A scalar.
        """
        residuals = self.of_scene(points, rotations, translations, keypoints, intrinsics)
        squared = residuals.square().sum(-1) * self.information(residuals)
        return self.total(squared if confidence is None else squared * confidence)

    def of_scene(
        self, points: Tensor, rotations: Tensor, translations: Tensor, keypoints: Tensor, intrinsics: Intrinsics | Tensor
    ) -> Tensor:
        """Residuals (..., C, F, P, m), zero where a keypoint was not seen or its point is not known."""
        if not isinstance(intrinsics, Intrinsics):
            intrinsics = Intrinsics(intrinsics.expand_as(rotations))
        seen = keypoints.isfinite().all(-1, keepdim=True) & points.isfinite().all(-1, keepdim=True).unsqueeze(-4)
        points_cam = projection.to_cameras(points.nan_to_num(), rotations, translations)
        points_cam = torch.where(seen, points_cam, points.new_tensor([0.0, 0.0, 1.0]))
        found = self.residuals(points_cam.flatten(-3, -2), keypoints.nan_to_num().flatten(-3, -2), intrinsics)
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
        squared = self._squared(points_cam, pixels, cameras)
        weights = self.weight * information * self.kernel.weight(squared * information)
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
            cost=self.total(squared * information, over=2),
            squares=(weights * squared).sum(-1),
            weights=weights.sum(-1),
            gradient=rotations.mT @ gradient,
            hessian=six_entries(hessian.movedim(-3, -1)),
            unknown=terms,
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
        with forward_ad.dual_level():
            moving = forward_ad.make_dual(points_cam, moved_cam)
            if unknowns is not None and step is not None:
                cameras, pixels = unknowns.moved(forward_ad.make_dual(torch.zeros_like(step), step))
            value = self.total(self._squared(moving, pixels, cameras) * information)
            return _tangent(value) / 2

    def _squared(self, points_cam: Tensor, pixels: Tensor, cameras: Intrinsics) -> Tensor:
        """Squared residuals (..., C, N), not divided by sigma."""
        return self.residuals(points_cam.mT, pixels.mT, cameras).square().sum(-1)

    @torch.enable_grad()
    def _with_jacobian(self, points_cam: Tensor, pixels: Tensor, cameras: Intrinsics) -> tuple[Tensor, Tensor]:
        """Residuals (..., C, N, m), and their derivatives (..., C, N, m, 3) by the points in the cameras' frames."""
        at = points_cam.detach().mT.requires_grad_()
        residuals = self.residuals(at, pixels.mT, cameras)
        rows = [torch.autograd.grad(row.sum(), at, retain_graph=True)[0] for row in residuals.unbind(-1)]
        return residuals.detach(), torch.stack(rows, dim=-2)

    @torch.enable_grad()
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
            with forward_ad.dual_level():
                cameras, pixels = unknowns.moved(forward_ad.make_dual(torch.zeros_like(direction), direction))
                found.append(_tangent(self.residuals(points_cam.mT, pixels.mT, cameras)))
        return torch.stack(found, dim=-3)


class FrameLoss(Loss, ABC):
    """Couples some points of one frame: lengths, angles, whatever is known of a body or an implement."""

    @abstractmethod
    def groups(self, sticks: Tensor) -> Tensor:
        """The points that take part: (G, k), k different points for each of G groups.

        Args:
            sticks: (S, 2), the ends of the session's sticks.
        """

    @abstractmethod
    def residuals(self, points: Tensor, lengths_m: Tensor) -> Tensor:
        """Residuals (..., G, m), not yet divided by sigma, metres or whatever unit sigma has.

        Args:
            points: the groups' points, (..., G, k, 3), metres.
            lengths_m: given lengths of the session's sticks, (..., S).
        """

    def of_session(self, points: Tensor, sticks: Tensor, lengths_m: Tensor) -> Tensor:
        """The loss, a scalar, of a session's points (..., F, P, 3), NaN for points that are not known.

        Args:
            points: metres.
            sticks: (S, 2), the ends of its sticks.
            lengths_m: their given lengths, (..., 1, S).
        """
        grouped = points[..., self.groups(sticks), :]
        known = grouped.isfinite().all(-1).all(-1)
        squared = self._squared(grouped, known, lengths_m)
        return self.total(squared * self.information(squared))

    def linearise(self, points: Tensor, sticks: Tensor, lengths_m: Tensor, active: Tensor, exact: bool = False) -> FrameTerms:
        """The terms, here by automatic differentiation of the residuals.

        Args:
            points: (..., 3, F, P), metres.
            sticks: (S, 2), the ends of the session's sticks.
            lengths_m: their given lengths, (..., 1, S).
            active: (..., F, P), True for points that are known.
            exact: whether the blocks are those of the exact Hessian, with the curvature of kernel and residuals.
        """
        groups = self.groups(sticks)
        known = active[..., groups].all(-1)
        with torch.enable_grad():
            at = _in_general_position(points[..., groups].movedim(-4, -1), known).detach().requires_grad_()
            residuals = self.residuals(at, lengths_m.detach())
            rows = [torch.autograd.grad(row.sum(), at, retain_graph=True)[0] for row in residuals.unbind(-1)]
        whitened = torch.where(known, residuals.detach().square().sum(-1), 0.0)
        whitened = whitened * self.information(whitened)
        weights = self.weight * self.information(whitened) * known * self.kernel.weight(whitened)
        jacobian = torch.stack(rows, dim=-3)
        gradient = torch.einsum("...fgm,...fgmki,...fg->...kifg", residuals.detach(), jacobian, weights)
        if exact:
            hessian = self._exact_hessian(at, known, lengths_m)
        else:
            hessian = torch.einsum("...fgmki,...fgmlj,...fg->...klijfg", jacobian, jacobian, weights)
        return FrameTerms(self.total(whitened, over=2), gradient, hessian)

    def slope(self, points: Tensor, moved: Tensor, sticks: Tensor, lengths_m: Tensor, active: Tensor) -> Tensor:
        """Half the derivative of the loss where the points move by (..., 3, F, P), summed; differentiable."""
        groups = self.groups(sticks)
        known = active[..., groups].all(-1)
        at, along = (values[..., groups].movedim(-4, -1) for values in (points, moved))
        with forward_ad.dual_level():
            squared = self._squared(forward_ad.make_dual(at, along), known, lengths_m)
            return _tangent(self.total(squared * self.information(squared))) / 2

    @torch.enable_grad()
    def _exact_hessian(self, grouped: Tensor, known: Tensor, lengths_m: Tensor) -> Tensor:
        """Half the second derivatives of the loss, blocks (..., k, k, 3, 3, F, G)."""
        squared = self._squared(grouped, known, lengths_m)
        value = self.total(squared * self.information(squared))
        (gradient,) = torch.autograd.grad(value / 2, grouped, create_graph=True)
        rows = [torch.autograd.grad(row.sum(), grouped, retain_graph=True)[0] for row in gradient.flatten(-2).unbind(-1)]
        blocks = torch.stack(rows, dim=-3).unflatten(-3, grouped.shape[-2:])
        return torch.einsum("...fgkilj->...klijfg", blocks)

    def _squared(self, grouped: Tensor, known: Tensor, lengths_m: Tensor) -> Tensor:
        """Squared residuals (..., G) of points (..., G, k, 3), zero for groups that are not known whole."""
        residuals = self.residuals(_in_general_position(grouped, known), lengths_m)
        return torch.where(known, residuals.square().sum(-1), 0.0)


class TrackLoss(Loss, ABC):
    """Couples two or three consecutive frames of one point: its residuals are ``sum_i stencil[i] X[f + i]``, metres.

    A subclass needs no more than its :attr:`stencil`. Exact gradients through a solution need least squares: no kernel.
    """

    stencil: ClassVar[tuple[float, ...]]
    """two or three factors"""

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        if len(cls.stencil) not in {2, 3}:
            raise ConfigError(
                "a track loss couples too many frames",
                where=f"{cls.__name__}.stencil",
                got=cls.stencil,
                expected="2 or 3 factors",
            )

    def forward(self, points: Tensor) -> Tensor:
        """The loss, a scalar, of points (..., F, P, 3), metres; NaN for points that are not known."""
        complete = consecutive(points.isfinite().all(-1), len(self.stencil))
        squared = combined(points.nan_to_num(), self.stencil, dim=-3).square().sum(-1) * complete
        return self.total(squared * self.information(squared))

    def linearise(self, points: Tensor, active: Tensor) -> TrackTerms:
        """The terms at points (..., 3, F, P) with a mask (..., F, P) of points that are known."""
        complete = consecutive(active, len(self.stencil))
        difference = combined(points, self.stencil, dim=-2) * complete.unsqueeze(-3)
        squared = difference.square().sum(-3) * self.information(difference)
        scale = (self.weight * self.information(difference) * self.kernel.weight(squared)).sqrt() * complete
        return TrackTerms(cost=self.total(squared, over=2), residual=difference * scale.unsqueeze(-3), scale=scale)

    def slope(self, points: Tensor, moved: Tensor, active: Tensor) -> Tensor:
        """Half the derivative of the loss where the points move by (..., 3, F, P), summed; differentiable."""
        complete = consecutive(active, len(self.stencil))
        difference = combined(points, self.stencil, dim=-2) * complete.unsqueeze(-3)
        squared = difference.square().sum(-3) * self.information(difference)
        weights = self.weight * self.information(difference) * self.kernel.weight(squared)
        return (weights * (difference * combined(moved, self.stencil, dim=-2)).sum(-3)).sum()


def combined(values: Tensor, stencil: tuple[float, ...], dim: int) -> Tensor:
    """``sum_i stencil[i] v[f + i]`` along the dimension of the frames, which becomes shorter by ``len(stencil) - 1``."""
    over_time = values.movedim(dim, 0)
    frames = max(0, len(over_time) - len(stencil) + 1)
    *earlier, last = (factor * over_time[first : first + frames] for first, factor in enumerate(stencil))
    return sum(reversed(earlier), start=last).movedim(0, dim)


def consecutive(present: Tensor, frames: int) -> Tensor:
    """Whether a point is present in so many frames in a row, (..., F - frames + 1, P), of a mask (..., F, P)."""
    count = max(0, present.shape[-2] - frames + 1)
    return torch.stack([present[..., first : first + count, :] for first in range(frames)]).all(0)


def six_entries(matrices: Tensor) -> Tensor:
    """The six distinct entries (..., 6, N) of symmetric matrices (..., 3, 3, N)."""
    return torch.stack([matrices[..., i, j, :] for i in range(3) for j in range(i, 3)], dim=-2)


def _in_general_position(points: Tensor, known: Tensor) -> Tensor:
    """Points (..., G, k, 3), those of groups that are not known whole replaced by points with which any residual exists."""
    order = torch.arange(1.0, points.shape[-2] + 1).to(points)
    return torch.where(known[..., None, None], points, torch.stack([order, order.square(), order.pow(3)], dim=-1))


def _tangent(value: Tensor) -> Tensor:
    """The derivative that a dual number carries; zero if it carries none."""
    primal, tangent = forward_ad.unpack_dual(value)
    return torch.zeros_like(primal) if tangent is None else tangent
