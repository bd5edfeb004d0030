"""The smoothness loss: points accelerate little from frame to frame."""

from __future__ import annotations

import torch
from torch import Tensor

from torchstickcal.losses.base import TrackLoss, TrackTerms


def second_differences(points: Tensor) -> Tensor:
    """``X[f-1] - 2 X[f] + X[f+1]``, (F - 2, P, 3), of points (F, P, 3); zero where one of the three is NaN."""
    difference = points[2:] - 2 * points[1:-1] + points[:-2]
    return torch.where(difference.isfinite().all(-1, keepdim=True), difference, torch.zeros_like(difference))


class SmoothnessLoss(TrackLoss):
    """``weight * sum rho(|X[f-1] - 2 X[f] + X[f+1]|^2 / sigma^2)`` over frames and points (the paper's L_smooth).

    Args:
        sigma: standard deviation of a second difference along each axis, in metres, one number or one per point (P,).
        weight: factor on the loss.
        kernel: robust kernel; None for least squares.
    """

    def forward(self, points: Tensor) -> Tensor:
        """The loss of points (F, P, 3); NaN points take no part."""
        present = points.isfinite().all(-1, keepdim=True)
        safe = points.nan_to_num()
        complete = (present[2:] & present[1:-1] & present[:-2])[..., 0]
        squared = second_differences(safe).square().sum(-1) * complete
        return self.total(squared * self.information(squared))

    def linearise(self, points: Tensor, active: Tensor) -> TrackTerms:
        complete = active[2:] & active[1:-1] & active[:-2]
        difference = (points[:, 2:] - 2 * points[:, 1:-1] + points[:, :-2]) * complete
        squared = difference.square().sum(0) * self.information(difference)
        scale = (self.weight * self.information(difference) * self.kernel.weight(squared)).sqrt() * complete
        return TrackTerms(cost=self.total(squared), residual=difference * scale, scale=scale)
