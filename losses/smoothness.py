"""The smoothness loss: points accelerate little from frame to frame."""

from __future__ import annotations

import torch
from torch import Tensor

from torchstickcal.losses.base import TrackLoss, TrackTerms


def second_differences(points: Tensor) -> Tensor:
    """``X[f-1] - 2 X[f] + X[f+1]``, (..., F - 2, P, 3), of points (..., F, P, 3); zero where one of the three is NaN."""
    difference = stencil(points, dim=-3)
    return torch.where(difference.isfinite().all(-1, keepdim=True), difference, torch.zeros_like(difference))


def stencil(values: Tensor, dim: int) -> Tensor:
    """``v[f-1] - 2 v[f] + v[f+1]`` along the dimension of the frames, two frames shorter."""
    v = values.movedim(dim, 0)
    return (v[2:] - 2 * v[1:-1] + v[:-2]).movedim(0, dim)


def complete_triples(present: Tensor) -> Tensor:
    """(..., F - 2, P), True where a point is present in three frames in a row, of a mask (..., F, P)."""
    return present[..., 2:, :] & present[..., 1:-1, :] & present[..., :-2, :]


class SmoothnessLoss(TrackLoss):
    """``weight * sum rho(|X[f-1] - 2 X[f] + X[f+1]|^2 / sigma^2)`` over frames and points (the paper's L_smooth).

    Args:
        sigma: standard deviation of a second difference along each axis, in metres, one number or one per point (P,).
        weight: factor on the loss.
        kernel: robust kernel; None for least squares.
    """

    def forward(self, points: Tensor) -> Tensor:
        """The loss of points (..., F, P, 3); NaN points take no part."""
        complete = complete_triples(points.isfinite().all(-1))
        squared = second_differences(points.nan_to_num()).square().sum(-1) * complete
        return self.total(squared * self.information(squared))

    def linearise(self, points: Tensor, active: Tensor) -> TrackTerms:
        complete = complete_triples(active)
        difference = stencil(points, dim=-2) * complete.unsqueeze(-3)
        squared = difference.square().sum(-3) * self.information(difference)
        scale = (self.weight * self.information(difference) * self.kernel.weight(squared)).sqrt() * complete
        return TrackTerms(cost=self.total(squared, over=2), residual=difference * scale.unsqueeze(-3), scale=scale)

    def slope(self, points: Tensor, moved: Tensor, active: Tensor) -> Tensor:
        complete = complete_triples(active)
        difference = stencil(points, dim=-2) * complete.unsqueeze(-3)
        squared = difference.square().sum(-3) * self.information(difference)
        weights = self.weight * self.information(difference) * self.kernel.weight(squared)
        return (weights * (difference * stencil(moved, dim=-2)).sum(-3)).sum()
