"""The stick-length loss: a rigid stick has the same, known length in every frame."""

from __future__ import annotations

import torch
from torch import Tensor

from torchstickcal.geometry.symmetric import DIAGONAL, outer
from torchstickcal.losses.base import PairLoss, PairTerms

_MIN_LENGTH_M = 1e-6


def stick_lengths(starts: Tensor, ends: Tensor) -> Tensor:
    """Distance of stick ends (..., 3), clamped below at 1e-6 m so that its gradient exists; NaN where an end is."""
    return _length(ends - starts, dim=-1)


class StickLengthLoss(PairLoss):
    """``weight * sum rho((|end - start| - length)^2 / sigma^2)`` over frames and sticks (the paper's L_length).

    Args:
        sigma: how well the length holds, in metres, one number or one per stick (S,).
        weight: factor on the loss.
        kernel: robust kernel; None for least squares.
    """

    def forward(self, starts: Tensor, ends: Tensor, length_m: float | Tensor) -> Tensor:
        """The loss of stick ends (..., F, S, 3) or (F, 3); frames in which an end is NaN do not count."""
        known = (starts + ends).isfinite().all(-1)
        lengths = stick_lengths(starts.nan_to_num(), ends.nan_to_num())
        residuals = torch.where(known, lengths - length_m, torch.zeros_like(lengths))
        return self.total(residuals.square() * self.information(residuals))

    def linearise(self, difference: Tensor, length_m: Tensor, active: Tensor, exact: bool = False) -> PairTerms:
        length = _length(difference, dim=-3)
        information = self.information(length) * active
        residual = length - length_m
        squared = residual.square() * information
        weights = self.weight * information * self.kernel.weight(squared)
        along, across = weights, torch.zeros_like(weights)
        if exact:
            along = along + 2 * self.weight * information * self.kernel.curvature(squared) * squared
            across = weights * residual / length
        direction = difference / length.unsqueeze(-3)
        hessian = outer(direction.flatten(-2)).unflatten(-1, length.shape[-2:]) * (along - across).unsqueeze(-3)
        for entry in DIAGONAL:
            hessian[..., entry, :, :] += across
        return PairTerms(
            cost=self.total(squared, over=2),
            gradient=direction * (weights * residual).unsqueeze(-3),
            hessian=hessian,
        )

    def slope(self, difference: Tensor, moved: Tensor, length_m: Tensor, active: Tensor) -> Tensor:
        length = _length(difference, dim=-3)
        information = self.information(length) * active
        residual = length - length_m
        weights = self.weight * information * self.kernel.weight(residual.square() * information)
        return (weights * residual * (difference * moved).sum(-3) / length).sum()


def _length(difference: Tensor, dim: int) -> Tensor:
    return difference.square().sum(dim).clamp_min(_MIN_LENGTH_M**2).sqrt()
