"""Tracks between their frames: where a point is, and how fast, when a camera looks a little before or after a frame.

About each frame a polynomial goes through the frames around it, as many as it can follow: a slow track is smoothed over many
frames, a fast swing is followed through every one. In an orthonormal basis by degree the noise of the points is the same in
each coefficient, so coefficients that are no larger than noise are shrunk away (as Stein's estimate does, from the highest
degree down). Little noise matters more than it seems: noise in the velocity makes a clock's offset seem smaller than it is.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor

_REACHES = (4, 8, 16)
"""Frames looked at on either side: the most that a polynomial can follow."""
_DEGREES = 2 * _REACHES[0] + 1
_RIDGE = 1e-9
_LEAST_PIVOT = 0.05
"""Share of a basis polynomial that lower degrees leave at the known frames, below which the frames do not determine it."""
_SMOOTH_DEGREES, _ROUGH_DEGREES = 2, 3
"""The lowest degrees count as motion whatever their size, the highest as a sign of more between the frames."""
_NEIGHBOURS = (-3, -2, -1, 1, 2, 3)
_UNSTEADY, _UNSTEADY_CONFIRMED = 4.0, 8.0
"""Distance from where the neighbours in time have a point, over what is usual about it, from which on it is not believed: one
that two cameras hold, and one that a third confirms."""
_CHANCE = 2.0
"""Standard deviations of the residual beyond its mean up to which a polynomial follows the motion."""
_INTERPOLATION_SHARE = 0.15
"""Error halfway between two frames, along an axis, over the motion in the highest degrees: twice this; measured on swings."""


class Pieces(NamedTuple):
    """Polynomials of time about some frames' points (n,)."""

    coefficients: Tensor
    """(K, 3, n), of powers of the time from the frame, metres and frames"""
    roughness_m: Tensor
    """(n,), motion beyond noise in the highest degrees, which tells how much there is between the frames"""

    def positions(self, delays: Tensor) -> Tensor:
        """Points (C, 3, n), metres, some frames (C, n) after their own."""
        time = delays.unsqueeze(-2)
        found = self.coefficients[-1].expand(len(delays), -1, -1)
        for coefficient in self.coefficients[:-1].flip(0):
            found = torch.addcmul(coefficient, found, time)
        return found

    def velocities(self, delays: Tensor) -> Tensor:
        """Velocities (C, 3, n), metres a frame, some frames (C, n) after the points' own."""
        powers = torch.arange(1, len(self.coefficients)).to(self.coefficients)[:, None, None]
        return Pieces(self.coefficients[1:] * powers, self.roughness_m).positions(delays)

    def deviations_m(self, delays: Tensor) -> Tensor:
        """Standard deviations (C, n) of interpolation some frames (C, n) away, along an axis, metres."""
        return _INTERPOLATION_SHARE * delays.abs() * self.roughness_m


class Trajectories:
    """The tracks of one session.

    Args:
        points: (3, F, P), metres.
        variance: (F, P), of a point along an axis, square metres; infinite where it is not known.
        views: (F, P), how many cameras hold a point.
    """

    def __init__(self, points: Tensor, variance: Tensor, views: Tensor) -> None:
        known = variance.isfinite() & _steady(points, variance, views)
        around = (0, 0, _REACHES[-1], _REACHES[-1])
        information = torch.where(known, variance.clamp_min(1e-300).reciprocal(), 0.0)
        self._information = torch.nn.functional.pad(information, around)
        self._points = torch.nn.functional.pad(points.where(known, 0.0), around)

    def pieces(self, frames: slice) -> Pieces:
        """Those of all points of some frames, n = frames x P columns."""
        found, _ = self._fitted(frames, _REACHES[0])
        following = torch.ones_like(found.roughness_m, dtype=torch.bool)
        for reach in _REACHES[1:]:
            wider, follows = self._fitted(frames, reach)
            following &= follows
            if not bool(following.any()):
                break
            found = Pieces(*(torch.where(following, new, old) for new, old in zip(wider, found, strict=True)))
        return found

    def _fitted(self, frames: slice, reach: int) -> tuple[Pieces, Tensor]:
        """Polynomials through the frames up to a reach away, and whether they follow the motion there to within noise."""
        window = slice(frames.start + _REACHES[-1] - reach, frames.stop + _REACHES[-1] + reach)
        information = self._information[window].unfold(0, 2 * reach + 1, 1).flatten(0, 1)
        points = self._points[:, window].unfold(1, 2 * reach + 1, 1).flatten(1, 2).movedim(0, 1)
        most = information.amax(1, keepdim=True).clamp_min(1e-300)
        weights = information / most
        basis, products, powers = _basis(reach, points.device)
        gram = (weights @ products).unflatten(1, (_DEGREES, _DEGREES)) + _RIDGE * torch.eye(_DEGREES).to(basis)
        lower = torch.linalg.cholesky_ex(gram).L
        coefficients = torch.linalg.solve_triangular(lower, ((points * weights[:, None]) @ basis).mT, upper=False)
        determined = lower.diagonal(dim1=1, dim2=2) > _LEAST_PIVOT
        coefficients = coefficients * determined[..., None]
        energies = coefficients.square().sum(2).flip(1).cumsum(1).flip(1)
        noise = torch.arange(3 * _DEGREES, 0, -3).to(basis) / most
        chance = noise + (2 * noise / most).sqrt()
        shrinkage = (1 - chance / energies.clamp_min(1e-300)).clamp_min(0.0)
        shrinkage[:, :_SMOOTH_DEGREES] = 1.0
        smooth = torch.linalg.solve_triangular(lower.mT, coefficients * shrinkage[..., None], upper=True)
        highest = (determined.sum(1, keepdim=True) - _ROUGH_DEGREES).clamp_min(_SMOOTH_DEGREES)
        roughness = (energies - noise).gather(1, highest)[:, 0].clamp_min(0.0).sqrt()
        freedom = 3 * ((weights > 0).sum(1) - determined.sum(1)).clamp_min(0)
        unexplained = ((points.square().sum(1) * weights).sum(1) - energies[:, 0]) * most[:, 0]
        follows = (unexplained <= freedom + _CHANCE * (2 * freedom).sqrt()) & (freedom > 0)
        return Pieces((powers @ smooth).permute(1, 2, 0).contiguous(), roughness), follows


def _steady(points: Tensor, variance: Tensor, views: Tensor) -> Tensor:
    """Whether points are near where their neighbours in time have them (F, P), for their pace.

    A point that two cameras see has no third to contradict a wrong keypoint; its neighbours do.
    """
    seen = points.where(variance.isfinite(), torch.nan)
    near = dict(zip(_NEIGHBOURS, around(seen, _NEIGHBOURS), strict=True))
    middles = [(near[-k] + near[k]) / 2 for k in (1, 2, 3)]
    onward = [2 * near[k] - near[2 * k] for k in (-1, 1)]
    away = (seen - torch.stack([*middles, *onward]).nanmedian(0).values).square().sum(0).sqrt()
    usual = around(away, range(-_REACHES[1], _REACHES[1] + 1)).nanmedian(0).values
    limit = torch.where(views > 2, _UNSTEADY_CONFIRMED, _UNSTEADY)
    return ~(away > limit * (usual + (3 * variance).sqrt()))


def around(values: Tensor, steps: Sequence[int]) -> Tensor:
    """Values (..., F, P) some frames away from each, one after another, NaN beyond the ends."""
    widest, frames = max(map(abs, steps)), values.shape[-2]
    padded = torch.nn.functional.pad(values, (0, 0, widest, widest), value=torch.nan)
    return torch.stack([padded[..., widest + k : widest + k + frames, :] for k in steps])


@lru_cache
def _basis(reach: int, device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
    """Orthonormal polynomials at the frames around (frames, K), their products (frames, K K), and their powers (K, K)."""
    times = torch.linspace(-1, 1, 2 * reach + 1, dtype=torch.float64)
    basis, mixed = torch.linalg.qr(times[:, None] ** torch.arange(_DEGREES))
    products = (basis[:, :, None] * basis[:, None]).flatten(1)
    powers = torch.linalg.inv(mixed) / reach ** torch.arange(_DEGREES)[:, None]
    return basis.to(device), products.to(device), powers.to(device)
