"""Tracks between their frames: where a point is, and how fast, when a camera looks a little before or after a frame.

About each frame a polynomial goes through the frames around it. In an orthonormal basis by degree the noise of the points is
the same in each coefficient, so coefficients that are no larger than noise are shrunk away (as Stein's estimate does, from the
highest degree down): a slow track is smoothed, a fast swing is followed through every frame.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor

_REACH = 4
"""Frames looked at on either side."""
_DEGREES = 2 * _REACH + 1
_RIDGE = 1e-9
_LEAST_PIVOT = 0.05
"""Share of a basis polynomial that lower degrees leave at the known frames, below which the frames do not determine it."""
_ROUGH_DEGREES = 3
_INTERPOLATION_SHARE = 0.15
"""Error halfway between two frames, along an axis, over the motion in the highest degrees: twice this; measured on swings."""


class Pieces(NamedTuple):
    """Polynomials of time about some frames' points (n,)."""

    coefficients: Tensor
    """(K, 3, n), of powers of the time from the frame over the reach, metres"""
    roughness_m: Tensor
    """(n,), motion beyond noise in the highest degrees, which tells how much there is between the frames"""

    def positions(self, delays: Tensor) -> Tensor:
        """Points (C, 3, n), metres, some frames (C, n) after their own."""
        time = (delays / _REACH).unsqueeze(-2)
        found = self.coefficients[-1].expand(len(delays), -1, -1)
        for coefficient in self.coefficients[:-1].flip(0):
            found = torch.addcmul(coefficient, found, time)
        return found

    def velocities(self, delays: Tensor) -> Tensor:
        """Velocities (C, 3, n), metres a frame, some frames (C, n) after the points' own."""
        powers = torch.arange(1, len(self.coefficients)).to(self.coefficients)[:, None, None]
        return Pieces(self.coefficients[1:] * powers / _REACH, self.roughness_m).positions(delays)

    def deviations_m(self, delays: Tensor) -> Tensor:
        """Standard deviations (C, n) of interpolation some frames (C, n) away, along an axis, metres."""
        return _INTERPOLATION_SHARE * delays.abs() * self.roughness_m


class Trajectories:
    """The tracks of one session.

    Args:
        points: (3, F, P), metres.
        variance: (F, P), of a point along an axis, square metres; infinite where it is not known.
    """

    def __init__(self, points: Tensor, variance: Tensor) -> None:
        known = variance.isfinite()
        information = torch.where(known, variance.clamp_min(1e-300).reciprocal(), 0.0)
        around = (0, 0, _REACH, _REACH)
        self._points = torch.nn.functional.pad(points.where(known, 0.0), around).unfold(1, _DEGREES, 1)
        self._information = torch.nn.functional.pad(information, around).unfold(0, _DEGREES, 1)

    def pieces(self, frames: slice) -> Pieces:
        """Those of all points of some frames, n = frames x P columns."""
        information = self._information[frames].flatten(0, 1)
        points = self._points[:, frames].flatten(1, 2).movedim(0, 1)
        most = information.amax(1).clamp_min(1e-300)
        weights = information / most[:, None]
        basis, products, powers = _basis(points.device)
        gram = (weights @ products).unflatten(1, (_DEGREES, _DEGREES)) + _RIDGE * torch.eye(_DEGREES).to(basis)
        lower = torch.linalg.cholesky(gram)
        coefficients = torch.linalg.solve_triangular(lower, ((points * weights[:, None]) @ basis).mT, upper=False)
        determined = lower.diagonal(dim1=1, dim2=2) > _LEAST_PIVOT
        coefficients = coefficients * determined[..., None]
        energies = coefficients.square().sum(2).flip(1).cumsum(1).flip(1)
        freedom = torch.arange(3 * _DEGREES, 0, -3).to(basis)
        noise = freedom / most[:, None]
        chance = (freedom + (2 * freedom).sqrt()) / most[:, None]
        shrinkage = (1 - chance / energies.clamp_min(1e-300)).clamp_min(0.0)
        shrinkage[:, :2] = 1.0
        smooth = torch.linalg.solve_triangular(lower.mT, coefficients * shrinkage[..., None], upper=True)
        highest = (determined.sum(1, keepdim=True) - _ROUGH_DEGREES).clamp_min(0)
        roughness = (energies - noise).gather(1, highest)[:, 0].clamp_min(0.0).sqrt()
        return Pieces((powers @ smooth).permute(1, 2, 0).contiguous(), roughness)


@lru_cache
def _basis(device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
    """Orthonormal polynomials at the frames around (frames, K), their products (frames, K K), and their powers (K, K)."""
    times = torch.linspace(-1, 1, _DEGREES, dtype=torch.float64)
    basis, mixed = torch.linalg.qr(times[:, None] ** torch.arange(_DEGREES))
    products = (basis[:, :, None] * basis[:, None]).flatten(1)
    return basis.to(device), products.to(device), torch.linalg.inv(mixed).to(device)
