"""Losses that couple consecutive frames of one point."""

from __future__ import annotations

from abc import ABC
from typing import ClassVar, NamedTuple, Self

import torch
from torch import Tensor

from torchstickcal.errors import ConfigError
from torchstickcal.losses.base import Loss
from torchstickcal.precision import at_least_float32, in_full_precision


class TrackTerms(NamedTuple):
    """A track loss, linearised at F frames and P points; its residuals are ``scale * stencil * track``."""

    cost: Tensor
    """(...): the loss"""
    residual: Tensor
    """(..., 3, F - reach, P): weighted residuals"""
    scale: Tensor
    """(..., F - reach, P): the factor in them; their Jacobian by frame f + i is ``scale * stencil[i] * I``"""


class TrackLoss(Loss, ABC):
    """Couples two or three consecutive frames of one point: its residuals are ``sum_i stencil[i] X[f + i]``, metres.

    A subclass needs no more than its :attr:`stencil`. To leave out a point, give it an infinite sigma. Exact gradients through
    a solution need least squares: no kernel.
    """

    stencil: ClassVar[tuple[float, ...]] = ()
    """two or three factors"""

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        if len(cls.stencil) not in {2, 3}:
            raise ConfigError(
                "a track loss cannot couple so many frames",
                where=f"{cls.__name__}.stencil",
                got=cls.stencil,
                expected="2 or 3 factors",
            )

    def within(self, window: slice, frames: int) -> Self:
        """The loss of some frames, of so many, where ``sigma`` is one for each of its residuals, (B, F - reach, P)."""
        reach = len(self.stencil) - 1
        if self.sigma.ndim < 3 or self.sigma.shape[-2] != frames - reach:
            return self
        start, stop, _ = window.indices(frames)
        return self._with(sigma=self.sigma[..., start : max(start, stop - reach), :])

    @in_full_precision
    def forward(self, points: Tensor) -> Tensor:
        """The loss, a scalar, of points (..., F, P, 3), metres; NaN for points that are not known."""
        known = points.isfinite().all(-1)
        complete = consecutive(known, len(self.stencil))
        differences = combined(at_least_float32(points).where(known[..., None], 0.0), self.stencil, dim=-3)
        squared = differences.square().sum(-1) * complete
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
