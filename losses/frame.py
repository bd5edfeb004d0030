"""Losses that couple some points of one frame."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import NamedTuple

import torch
from torch import Tensor

from torchstickcal.dual import dual, dual_numbers, tangent
from torchstickcal.errors import ConfigError
from torchstickcal.geometry.symmetric import six_entries
from torchstickcal.inference import differentiates
from torchstickcal.losses.base import Loss, checked_residuals
from torchstickcal.precision import at_least_float32, in_full_precision


class FrameTerms(NamedTuple):
    """A frame loss, linearised at F frames and G groups of k points."""

    cost: Tensor
    """(...): the loss"""
    gradient: Tensor
    """(..., k, 3, F, G): half the derivative by each point of the group"""
    hessian: Tensor
    """(..., k, 6, F, G): the block of each point of the group, entries xx xy xz yy yz zz"""
    cross: Tensor
    """(..., k (k - 1) / 2, 3, 3, F, G): the blocks between two points, in the order 01 02 ... 12 ..."""


class FrameLoss(Loss, ABC):
    """Couples some points of one frame: lengths, angles, whatever is known of a body or an implement."""

    @abstractmethod
    def groups(self, sticks: Tensor) -> Tensor:
        """The points that take part: (G, k) of dtype long, k different points for each of G groups.

        Args:
            sticks: (S, 2), the ends of the session's sticks.
        """

    @abstractmethod
    def residuals(self, points: Tensor, lengths_m: Tensor) -> Tensor:
        """Residuals (..., G, m), not yet divided by sigma, metres or whatever unit sigma has.

        Args:
            points: the groups' points, (..., G, k, 3), metres.
            lengths_m: given lengths of the session's S sticks, (..., S), whatever the groups are.
        """

    def forward(self, points: Tensor, sticks: Tensor | None = None, lengths_m: Tensor | None = None) -> Tensor:
        """The loss, a scalar, for a training loop.

        Args:
            points: (..., F, P, 3), metres, NaN for points that are not known.
            sticks: (S, 2), the ends of sticks; None for none.
            lengths_m: (..., S), their lengths, metres.
        """
        if sticks is None or lengths_m is None:
            sticks, lengths_m = torch.zeros(0, 2, dtype=torch.long, device=points.device), points.new_zeros(0)
        return self.of_session(points, sticks, lengths_m.unsqueeze(-2))

    @in_full_precision
    def of_session(self, points: Tensor, sticks: Tensor, lengths_m: Tensor) -> Tensor:
        """The loss, a scalar, of a session's points (..., F, P, 3), NaN for points that are not known.

        Args:
            points: metres.
            sticks: (S, 2), the ends of its sticks.
            lengths_m: their given lengths, (..., 1, S).
        """
        grouped = at_least_float32(points)[..., self.checked_groups(sticks, points.shape[-2]), :]
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
        at = _in_general_position(points[..., groups].movedim(-4, -1), known)
        residuals, jacobian = self._with_jacobian(at, lengths_m)
        whitened = torch.where(known, residuals.square().sum(-1), 0.0)
        whitened = whitened * self.information(whitened)
        weights = self.weight * self.information(whitened) * known * self.kernel.weight(whitened)
        gradient = torch.einsum("...fgm,...fgmki,...fg->...kifg", residuals, jacobian, weights)
        if exact:
            hessian = self._exact_hessian(at, known, lengths_m)
        else:
            hessian = torch.einsum("...fgmki,...fgmlj,...fg->...fgklij", jacobian, jacobian, weights)
        blocks = hessian.movedim((-6, -5), (-2, -1))
        size = groups.shape[1]
        own = torch.stack([six_entries(blocks[..., i, i, :, :, :, :].flatten(-2)) for i in range(size)], dim=-3)
        first, second = torch.triu_indices(size, size, offset=1)
        return FrameTerms(
            cost=self.total(whitened, over=2),
            gradient=gradient,
            hessian=own.unflatten(-1, known.shape[-2:]),
            cross=blocks[..., first, second, :, :, :, :],
        )

    def slope(self, points: Tensor, moved: Tensor, sticks: Tensor, lengths_m: Tensor, active: Tensor) -> Tensor:
        """Half the derivative of the loss where the points move by (..., 3, F, P), summed; differentiable."""
        groups = self.groups(sticks)
        known = active[..., groups].all(-1)
        at, along = (values[..., groups].movedim(-4, -1) for values in (points, moved))
        with dual_numbers():
            squared = self._squared(dual(at, along), known, lengths_m)
            return tangent(self.total(squared * self.information(squared))) / 2

    def point_information(self, points: Tensor, sticks: Tensor, lengths_m: Tensor, active: Tensor) -> Tensor:
        """The Gauss-Newton blocks J^T J of each point by itself, (..., 6, F, P); differentiable by points and lengths."""
        groups = self.groups(sticks)
        known = active[..., groups].all(-1)
        at = _in_general_position(points[..., groups].movedim(-4, -1), known)
        whitened = self._squared(at, known, lengths_m)
        whitened = whitened * self.information(whitened)
        weights = self.weight * self.information(whitened) * known * self.kernel.weight(whitened)
        found = points.new_zeros(*points.shape[:-3], 6, *points.shape[-2:])
        for member, indices in enumerate(groups.unbind(1)):
            columns: list[Tensor] = []
            for axis in range(3):
                along = torch.zeros_like(at)
                along[..., member, axis] = 1.0
                with dual_numbers():
                    columns.append(tangent(self.residuals(dual(at, along), lengths_m)))
            pairs = [weights * (columns[i] * columns[j]).sum(-1) for i in range(3) for j in range(i, 3)]
            found = found.index_add(-1, indices, torch.stack(pairs, dim=-3))
        return found

    def checked_groups(self, sticks: Tensor, points: int) -> Tensor:
        """:meth:`groups` of a session with so many points.

        Raises:
            ConfigError: if they are not groups of its points.
        """
        groups = self.groups(sticks)
        if not isinstance(groups, Tensor) or groups.ndim != 2 or groups.dtype != torch.long:
            got = f"{tuple(groups.shape)}, {groups.dtype}" if isinstance(groups, Tensor) else type(groups).__name__
            expected = "a tensor (G, k) of dtype torch.long: k points for each of G groups"
        elif groups.numel() and not 0 <= int(groups.min()) <= int(groups.max()) < points:
            got, expected = f"points {int(groups.min())} to {int(groups.max())}", f"0 to {points - 1}"
        else:
            return groups
        raise ConfigError("unusable groups of points", where=f"{type(self).__name__}.groups", got=got, expected=expected)

    @differentiates
    def _with_jacobian(self, grouped: Tensor, lengths_m: Tensor) -> tuple[Tensor, Tensor]:
        """Residuals (..., F, G, m) of points (..., F, G, k, 3), and their derivatives by these, (..., F, G, m, k, 3)."""
        at = grouped.detach().requires_grad_()
        residuals = checked_residuals(self, self.residuals(at, lengths_m.detach()), at.shape[:-2])
        rows = [torch.autograd.grad(row.sum(), at, retain_graph=True)[0] for row in residuals.unbind(-1)]
        return residuals.detach(), torch.stack(rows, dim=-3)

    @differentiates
    def _exact_hessian(self, grouped: Tensor, known: Tensor, lengths_m: Tensor) -> Tensor:
        """Half the second derivatives of the loss, blocks (..., F, G, k, k, 3, 3)."""
        grouped = grouped.detach().requires_grad_()
        squared = self._squared(grouped, known, lengths_m)
        value = self.total(squared * self.information(squared))
        (gradient,) = torch.autograd.grad(value / 2, grouped, create_graph=True)
        rows = [torch.autograd.grad(row.sum(), grouped, retain_graph=True)[0] for row in gradient.flatten(-2).unbind(-1)]
        blocks = torch.stack(rows, dim=-3).unflatten(-3, grouped.shape[-2:])
        return blocks.transpose(-3, -2)

    def _squared(self, grouped: Tensor, known: Tensor, lengths_m: Tensor) -> Tensor:
        """Squared residuals (..., G) of points (..., G, k, 3), zero for groups that are not known whole."""
        residuals = self.residuals(_in_general_position(grouped, known), lengths_m)
        residuals = checked_residuals(self, residuals, grouped.shape[:-2])
        return torch.where(known, residuals.square().sum(-1), 0.0)


def _in_general_position(points: Tensor, known: Tensor) -> Tensor:
    """Points (..., G, k, 3), those of groups that are not known whole replaced by points with which any residual exists."""
    order = torch.arange(1.0, points.shape[-2] + 1).to(points)
    return torch.where(known[..., None, None], points, torch.stack([order, order.square(), order.pow(3)], dim=-1))
