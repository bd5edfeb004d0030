"""Robust kernels: how much a large residual may count.

A kernel is a function rho of a squared, whitened residual s, with rho(s) ~ s near 0. Gauss-Newton uses its derivative as
the weight of iteratively re-weighted least squares; LBFGS and training loops differentiate rho itself.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

from torch import Tensor

from torchstickcal.arrays import number_of
from torchstickcal.errors import ConfigError


class RobustKernel(Protocol):
    """A robust kernel on squared residuals."""

    def rho(self, squared: Tensor) -> Tensor:
        """The loss rho(s), element by element."""
        ...

    def weight(self, squared: Tensor) -> Tensor:
        """The derivative rho'(s), in (0, 1]."""
        ...

    def curvature(self, squared: Tensor) -> Tensor:
        """The second derivative rho''(s), not above 0."""
        ...


@dataclass(frozen=True)
class Quadratic:
    """Least squares: rho(s) = s."""

    def rho(self, squared: Tensor) -> Tensor:
        return squared

    def weight(self, squared: Tensor) -> Tensor:
        return squared.new_ones(()).expand_as(squared)

    def curvature(self, squared: Tensor) -> Tensor:
        return squared.new_zeros(()).expand_as(squared)


@dataclass(frozen=True)
class Cauchy:
    """rho(s) = c^2 log(1 + s / c^2), c the scale in standard deviations."""

    scale: float = 2.4

    def __post_init__(self) -> None:
        object.__setattr__(self, "scale", _scale(self.scale))

    def rho(self, squared: Tensor) -> Tensor:
        return self.scale**2 * (squared / self.scale**2).log1p()

    def weight(self, squared: Tensor) -> Tensor:
        return (1 + squared / self.scale**2).reciprocal()

    def curvature(self, squared: Tensor) -> Tensor:
        return -((self.scale + squared / self.scale).square().reciprocal())


@dataclass(frozen=True)
class Huber:
    """rho(s) = s up to c^2, then 2 c sqrt(s) - c^2."""

    scale: float = 1.35

    def __post_init__(self) -> None:
        object.__setattr__(self, "scale", _scale(self.scale))

    def rho(self, squared: Tensor) -> Tensor:
        linear = 2 * self.scale * squared.clamp_min(self.scale**2).sqrt() - self.scale**2
        return squared.where(squared <= self.scale**2, linear)

    def weight(self, squared: Tensor) -> Tensor:
        return self.scale * squared.clamp_min(self.scale**2).rsqrt()

    def curvature(self, squared: Tensor) -> Tensor:
        linear = -0.5 * self.scale * squared.clamp_min(self.scale**2).pow(-1.5)
        return linear.where(squared > self.scale**2, 0.0)


@dataclass(frozen=True)
class GemanMcClure:
    """rho(s) = s / (1 + s / c^2): bounded by c^2, so a gross outlier has no pull."""

    scale: float = 8.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "scale", _scale(self.scale))

    def rho(self, squared: Tensor) -> Tensor:
        return squared / (1 + squared / self.scale**2)

    def weight(self, squared: Tensor) -> Tensor:
        return (1 + squared / self.scale**2).square().reciprocal()

    def curvature(self, squared: Tensor) -> Tensor:
        return -2 / self.scale**2 * (1 + squared / self.scale**2).pow(-3)


@dataclass(frozen=True)
class Repeated:
    """A kernel for residuals of which n count as one: rho(s) = kernel(n s) / n, where s is the squared residual over n.

    A residual is judged by itself, with its own standard deviation, but has only 1 / n of its information.
    """

    kernel: RobustKernel
    times: Tensor
    """n, 1 or more; it broadcasts against the squared residuals"""

    def rho(self, squared: Tensor) -> Tensor:
        times = self.times.to(squared)
        return self.kernel.rho(times * squared) / times

    def weight(self, squared: Tensor) -> Tensor:
        return self.kernel.weight(self.times.to(squared) * squared)

    def curvature(self, squared: Tensor) -> Tensor:
        times = self.times.to(squared)
        return times * self.kernel.curvature(times * squared)


_KERNELS = {"none": Quadratic, "cauchy": Cauchy, "huber": Huber, "geman_mcclure": GemanMcClure}


def robust_kernel(name: str, scale: float | None = None) -> RobustKernel:
    """The kernel of a name: ``none``, ``cauchy``, ``huber`` or ``geman_mcclure``.

    Args:
        name: the kernel.
        scale: residual, in standard deviations, at which it starts to bend; None for the kernel's default.

    Raises:
        ConfigError: for an unknown name or a scale that is not positive.
    """
    if name not in _KERNELS:
        raise ConfigError("unknown robust kernel", where="kernel", got=repr(name), expected=f"one of {', '.join(_KERNELS)}")
    if scale is not None:
        scale = _scale(scale)
    return Quadratic() if name == "none" else _KERNELS[name](*([] if scale is None else [scale]))


def _scale(value: Any) -> float:
    """A kernel's scale.

    Raises:
        ConfigError: if it is none.
    """
    what, expected = "kernel scale is not usable", "a number above 0, in standard deviations"
    return number_of(value, "kernel_scale", what=what, expected=expected, least=1e-6, most=1e6, error=ConfigError)
