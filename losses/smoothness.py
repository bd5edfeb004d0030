"""The smoothness loss: points accelerate little from frame to frame."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from torchstickcal.losses.registry import LossContext, LossSettings, register_loss
from torchstickcal.losses.track import TrackLoss, combined
from torchstickcal.precision import at_least_float32, in_full_precision
from torchstickcal.settings import Positive


@in_full_precision
def second_differences(points: Tensor) -> Tensor:
    """``X[f-1] - 2 X[f] + X[f+1]``, (..., F - 2, P, 3), of points (..., F, P, 3), metres; zero where one of the three is NaN.

    Example:
        >>> import torch
        >>> second_differences(torch.tensor([0.0, 1.0, 4.0])[:, None, None].expand(3, 1, 3))
        tensor([[[2., 2., 2.]]])
    """
    difference = combined(at_least_float32(points), SmoothnessLoss.stencil, dim=-3)
    return torch.where(difference.isfinite().all(-1, keepdim=True), difference, torch.zeros_like(difference))


class SmoothnessLoss(TrackLoss):
    """``weight * sum rho(|X[f-1] - 2 X[f] + X[f+1]|^2 / sigma^2)`` over frames and points (the paper's L_smooth).

    Args:
        sigma: standard deviation of a second difference along each axis, in metres, one number or one per point (P,).
        weight: factor on the loss.
        kernel: robust kernel; None for least squares.

    Example:
        >>> import torch
        >>> SmoothnessLoss(sigma=2.0)(torch.tensor([0.0, 1.0, 4.0])[:, None, None].expand(3, 1, 3))
        tensor(3.)
    """

    stencil = (1.0, -2.0, 1.0)


@register_loss("smoothness")
@dataclass(frozen=True)
class SmoothnessSettings(LossSettings):
    """Acceleration of the points: their second differences over frames, in metres.

    Args:
        sigma_m: standard deviation of a second difference over frames, metres; ``estimated`` takes it from the session, for
            each point and time.
        weight: factor on the loss.
    """

    sigma_m: Positive | Literal["estimated"] = "estimated"
    weight: Positive = 1.0

    loss = SmoothnessLoss

    def build(self, context: LossContext) -> SmoothnessLoss:
        sigma = context.acceleration_m() if self.sigma_m == "estimated" else self.sigma_m
        return SmoothnessLoss(sigma, self.weight)
