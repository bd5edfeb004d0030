"""What every loss has in common.

A loss is a sum of robust squared residuals, each divided by its standard deviation. It subclasses the class that says what one
residual depends on:

* :class:`torchstickcal.losses.CameraPointLoss`: one camera and one point, through the point's image;
* :class:`torchstickcal.losses.FrameLoss`: some points of one frame;
* :class:`torchstickcal.losses.TrackLoss`: one point in two or three consecutive frames.

Only the residuals have to be written. The scalar for training loops and LBFGS, the linearised form for Gauss-Newton, and the
slope for exact gradients follow from them by automatic differentiation. A loss that is worth it overrides ``linearise`` and
``slope`` with closed forms. Leading dimensions before those named stand for sessions: scalars sum over them, linearised forms
keep them.

The losses compute in the highest precision among their inputs, and in float32 at least. Autocast does not change that.
"""

from __future__ import annotations

import copy
from typing import Any, Self

import torch
from torch import Tensor, nn

from torchstickcal.arrays import tensor_of
from torchstickcal.errors import ConfigError
from torchstickcal.losses.robust import Quadratic, RobustKernel
from torchstickcal.shapes import extended

_LEAST_SIGMA = 1e-9


class Loss(nn.Module):
    """A sum of robust squared residuals in units of their standard deviation.

    Args:
        sigma: standard deviation of a residual in its own unit; a number, or a tensor with one per point or group. Where it
            differs between sessions, a tensor that broadcasts against the squared residuals.
        weight: factor on the whole loss (the paper's lambda).
        kernel: robust kernel on squared whitened residuals; None for least squares.

    Raises:
        ConfigError: if ``sigma`` is a number that is no standard deviation.
        ObservationError: if it is neither a number nor an array of numbers.
    """

    sigma: Tensor

    def __init__(self, sigma: float | Tensor = 1.0, weight: float = 1.0, kernel: RobustKernel | None = None) -> None:
        super().__init__()
        self.register_buffer("sigma", tensor_of(sigma, "sigma", keep_graph=True).double())
        if not isinstance(sigma, Tensor) and not bool((self.sigma >= _LEAST_SIGMA).all()):
            expected = f"{_LEAST_SIGMA:g} or more"
            raise ConfigError("not a standard deviation", where=f"{type(self).__name__}.sigma", got=sigma, expected=expected)
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
        return self._with(sigma=self.sigma[sessions])

    def replaced(self, where: Tensor, other: Self) -> Self:
        """The same loss with the ``sigma`` of some sessions (B,), True where, taken from another loss."""
        if self.sigma.ndim < 3:
            return self
        return self._with(sigma=torch.where(extended(where, self.sigma.ndim), other.sigma, self.sigma))

    def information(self, like: Tensor) -> Tensor:
        """1 / sigma^2 in the dtype and on the device of a tensor."""
        return self.sigma.to(like).square().reciprocal()

    def likelihood(self, sigma_px: Tensor) -> Self | None:
        """The loss as minus twice the logarithm of a normal density, for covariances; None if it is none.

        A loss with a weight other than 1 is none: its sigma is not a standard deviation. A robust kernel stays, so that a
        residual that is an outlier, such as the length of a stick in a frame with a wrong end, gives no information.

        Args:
            sigma_px: estimated noise of each point's keypoints, (B, P).
        """
        del sigma_px
        if self.weight != 1.0:
            return None
        return self

    def _with(self, **attributes: Any) -> Self:
        """A copy with some attributes changed. Buffers are shared, not copied."""
        copied = copy.copy(self)
        copied._buffers = dict(self._buffers)
        for name, value in attributes.items():
            setattr(copied, name, value)
        return copied


def checked_residuals(loss: Loss, residuals: Tensor, leading: tuple[int, ...]) -> Tensor:
    """Residuals (..., m), where they have one row of m numbers for each of the things that they are about.

    Raises:
        ConfigError: if they have not.
    """
    if residuals.ndim != len(leading) + 1 or residuals.shape[:-1] != leading:
        raise ConfigError(
            "residuals have the wrong shape",
            where=f"{type(loss).__name__}.residuals",
            got=tuple(residuals.shape),
            expected=f"{(*leading, 'm')}, m numbers each; m may be 1",
        )
    return residuals
