"""The stick-length loss: a rigid stick has the same, known length in every frame."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from torchstickcal.geometry.symmetric import DIAGONAL, expand, outer
from torchstickcal.losses.frame import FrameLoss, FrameTerms
from torchstickcal.losses.registry import LossContext, LossSettings, register_loss
from torchstickcal.losses.robust import robust_kernel
from torchstickcal.precision import in_common_precision, in_full_precision
from torchstickcal.settings import Positive

_MIN_LENGTH_M = 1e-6


@in_full_precision
def stick_lengths(starts: Tensor, ends: Tensor) -> Tensor:
    """Distances (...) of stick ends (..., 3), metres, clamped below at 1e-6 m so that a gradient exists; NaN where an end is.

    Example:
        >>> import torch
        >>> stick_lengths(torch.zeros(3), torch.tensor([0.0, 3.0, 4.0]))
        tensor(5.)
    """
    from kornia.geometry.linalg import batched_squared_norm

    starts, ends = in_common_precision(starts, ends)
    return batched_squared_norm(ends - starts).clamp_min(_MIN_LENGTH_M**2).sqrt()


class StickLengthLoss(FrameLoss):
    """``weight * sum rho((|end - start| - length)^2 / sigma^2)`` over frames and sticks (the paper's L_length).

    Args:
        sigma: tolerance of the length, in metres, one number or one per stick (S,).
        weight: factor on the loss.
        kernel: robust kernel; None for least squares.

    Example:
        >>> import torch
        >>> StickLengthLoss(sigma=0.5)(torch.zeros(1, 3), torch.tensor([[0.0, 3.0, 4.0]]), 4.0)
        tensor(4.)
    """

    @in_full_precision
    def forward(self, starts: Tensor, ends: Tensor, length_m: float | Tensor) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        """The loss, a scalar, of stick ends (..., F, S, 3) or (F, 3), metres; frames in which an end is NaN do not count.

        Args:
            starts: one end.
            ends: the other.
            length_m: the known length, one number or one per stick (S,).
        """
        starts, ends = in_common_precision(starts, ends)
        lengths = torch.as_tensor(length_m, dtype=starts.dtype, device=starts.device)
        grouped = torch.stack([starts, ends], dim=-2)
        squared = self._squared(grouped, grouped.isfinite().all(-1).all(-1), lengths)
        return self.total(squared * self.information(squared))

    def groups(self, sticks: Tensor) -> Tensor:
        return sticks

    def residuals(self, points: Tensor, lengths_m: Tensor) -> Tensor:
        return (stick_lengths(*points.unbind(-2)) - lengths_m).unsqueeze(-1)

    def linearise(self, points: Tensor, sticks: Tensor, lengths_m: Tensor, active: Tensor, exact: bool = False) -> FrameTerms:
        difference, length, information = self._between(points, sticks, active)
        residual = length - lengths_m
        squared = residual.square() * information
        weights = self.weight * information * self.kernel.weight(squared)
        direction, pull = difference / length.unsqueeze(-3), weights * residual
        entries = outer(direction.flatten(-2)).unflatten(-1, length.shape[-2:])
        if exact:
            across = pull / length
            along = weights + 2 * self.weight * information * self.kernel.curvature(squared) * squared
            entries = entries * (along - across).unsqueeze(-3)
            entries[..., DIAGONAL, :, :] += across.unsqueeze(-3)
        else:
            entries = entries * weights.unsqueeze(-3)
        gradient = direction * pull.unsqueeze(-3)
        return FrameTerms(
            cost=self.total(squared, over=2),
            gradient=torch.stack([-gradient, gradient], dim=-4),
            hessian=entries.unsqueeze(-4).expand(*entries.shape[:-3], 2, *entries.shape[-3:]),
            cross=-expand(entries.flatten(-2)).unflatten(-1, length.shape[-2:]).unsqueeze(-5),
        )

    def slope(self, points: Tensor, moved: Tensor, sticks: Tensor, lengths_m: Tensor, active: Tensor) -> Tensor:
        difference, length, information = self._between(points, sticks, active)
        residual = length - lengths_m
        weights = self.weight * information * self.kernel.weight(residual.square() * information)
        starts, ends = moved[..., sticks].unbind(-1)
        return (weights * residual * (difference * (ends - starts)).sum(-3) / length).sum()

    def point_information(self, points: Tensor, sticks: Tensor, lengths_m: Tensor, active: Tensor) -> Tensor:
        difference, length, information = self._between(points, sticks, active)
        weights = self.weight * information * self.kernel.weight((length - lengths_m).square() * information)
        direction = difference / length.unsqueeze(-3)
        blocks = outer(direction.flatten(-2)).unflatten(-1, length.shape[-2:]) * weights.unsqueeze(-3)
        found = points.new_zeros(*points.shape[:-3], 6, *points.shape[-2:])
        for end in sticks.unbind(1):
            found = found.index_add(-1, end, blocks)
        return found

    def _between(self, points: Tensor, sticks: Tensor, active: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """From one end to the other (..., 3, F, S), the lengths (..., F, S), and 1 / sigma^2, zero for unknown ends."""
        start, end = sticks.unbind(1)
        difference = points.index_select(-1, end) - points.index_select(-1, start)
        length = difference.square().sum(-3).clamp_min(_MIN_LENGTH_M**2).sqrt()
        known = active.index_select(-1, start) & active.index_select(-1, end)
        return difference, length, self.information(length) * known


@register_loss("stick_length")
@dataclass(frozen=True)
class StickLengthSettings(LossSettings):
    """Distance between the two ends of a stick against its length, in metres.

    Args:
        sigma_m: tolerance of the length, metres; ``stick`` takes each stick's own, :attr:`torchstickcal.Stick.sigma_m`.
        kernel: robust kernel, for frames in which an end is taken from wrong keypoints.
        kernel_scale: residual in tolerances from which on a frame counts for less; None for the kernel's default.
        weight: factor on the loss.
    """

    sigma_m: Positive | Literal["stick"] = "stick"
    kernel: Literal["none", "cauchy", "huber", "geman_mcclure"] = "none"
    kernel_scale: Positive | None = None
    weight: Positive = 1.0

    loss = StickLengthLoss

    def build(self, context: LossContext) -> StickLengthLoss:
        sigma_m = context.stick_sigma_m if self.sigma_m == "stick" else self.sigma_m
        return StickLengthLoss(sigma_m, self.weight, robust_kernel(self.kernel, self.kernel_scale))
