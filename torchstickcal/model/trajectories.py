"""Position and velocity of the points between frames, for cameras that expose their images before or after a frame.

For each frame and point, a polynomial is fitted to the frames around it. The window is as wide as the polynomial can follow the
motion: a slow point is smoothed over many frames, and a fast swing over few. In a basis that is orthonormal by degree, the
noise of the points has the same variance in each coefficient. Coefficients that are not larger than the noise are shrunk to
zero, from the highest degree down (James-Stein shrinkage). This matters for the clocks: noise in the velocities biases time
offsets towards zero.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache, partial
from typing import NamedTuple

import torch
from torch import Tensor

_HALF_WIDTHS = (4, 8, 16)
"""Half widths of the windows, frames."""
WINDOW_FRAMES = _HALF_WIDTHS[-1]
"""Frames further apart than this do not influence each other's trajectories."""
_DEGREES = 2 * _HALF_WIDTHS[0] + 1
"""K, number of polynomial coefficients."""
_RIDGE = 1e-9
_MIN_PIVOT = 0.05
"""A degree is determined if its basis polynomial, orthogonal to the lower degrees, has a larger norm at the known frames.
The norm is 1 if all frames of the window are known and equally certain."""
_UNSHRUNK_DEGREES, _HIGH_DEGREES = 2, 3
"""Number of lowest degrees that are never shrunk, and of highest degrees that indicate motion between the frames."""
_NEIGHBOURS = (-3, -2, -1, 1, 2, 3)
_USUAL_NOISE, _MAX_NOISE = 1.25, 5.5
"""Distance of a point from the prediction by its neighbours in time, over the standard deviation of its position: the usual one
where there is noise alone, and one beyond which the point is ignored."""
_MAX_MOTION, _MAX_MOTION_CONFIRMED = 4.0, 8.0
"""How much of the usual distance beyond noise, which is due to the motion, is allowed too: for a point seen by two cameras, and
for a point that a third camera confirms."""
_MAX_FIT_SIGMAS = 2.0
"""Standard deviations of the chi-square residual above its mean up to which a polynomial follows the motion."""
_INTERPOLATION_ERROR = 0.15
"""Standard deviation of the interpolation along an axis, per frame of delay, as a fraction of the motion in the high degrees.
It is twice the ratio measured halfway between two frames on swings."""


class LocalPolynomials(NamedTuple):
    """Polynomials of time, one for each of n columns (frames x points)."""

    coefficients: Tensor
    """(K, 3, n), of the powers of the time from the frame; units are metres and frames"""
    high_degree_motion_m: Tensor
    """(n,), amount of motion in the highest degrees beyond noise. It indicates how much motion there is between the frames."""

    def positions(self, delays: Tensor) -> Tensor:
        """Points (C, 3, n), metres, at the times ``delays`` (C, n) after their frames, in frames."""
        time = delays.unsqueeze(-2)
        position = self.coefficients[-1].expand(len(delays), -1, -1)
        for coefficient in self.coefficients[:-1].flip(0):
            position = torch.addcmul(coefficient, position, time)
        return position

    def velocities(self, delays: Tensor) -> Tensor:
        """Velocities (C, 3, n), metres per frame, at the times ``delays`` (C, n) after the frames, in frames."""
        powers = torch.arange(1, len(self.coefficients)).to(self.coefficients)[:, None, None]
        return LocalPolynomials(self.coefficients[1:] * powers, self.high_degree_motion_m).positions(delays)

    def put(self, columns: Tensor, others: LocalPolynomials) -> None:
        """Take the polynomials of some columns (k,) from others."""
        self.coefficients[..., columns] = others.coefficients
        self.high_degree_motion_m[columns] = others.high_degree_motion_m

    def interpolation_std_m(self, delays: Tensor) -> Tensor:
        """Standard deviation (C, n) of the interpolated positions along an axis, metres."""
        return _INTERPOLATION_ERROR * delays.abs() * self.high_degree_motion_m


class Trajectories:
    """The tracks of one session.

    Args:
        points: (3, F, P), metres.
        variance: variance of a point along an axis, (F, P), square metres; infinite for unknown points.
        views: number of cameras that see a point, (F, P).
    """

    def __init__(self, points: Tensor, variance: Tensor, views: Tensor) -> None:
        known = variance.isfinite() & _is_consistent(points, variance, views)
        margins = (0, 0, _HALF_WIDTHS[-1], _HALF_WIDTHS[-1])
        information = torch.where(known, variance.clamp_min(1e-300).reciprocal(), 0.0)
        self._information = torch.nn.functional.pad(information, margins)
        self._points = torch.nn.functional.pad(points.where(known, 0.0), margins)

    def polynomials(self, frames: slice) -> LocalPolynomials:
        """The polynomials of all points in some frames, n = frames x P columns."""
        columns = torch.arange((frames.stop - frames.start) * self._points.shape[-1], device=self._points.device)
        found = LocalPolynomials(self._points.new_empty(_DEGREES, 3, len(columns)), self._points.new_empty(len(columns)))
        rows, narrower = columns, partial(self._fit, frames, _HALF_WIDTHS[0])
        for half_width in _HALF_WIDTHS[1:]:
            fit = self._fit(frames, half_width, columns)
            left = ~fit.follows
            found.put(columns[left], narrower(rows[left]).shrunk)
            rows, narrower = fit.follows.nonzero()[:, 0], fit.at
            columns = columns[rows]
        found.put(columns, narrower(rows).shrunk)
        return found

    def _fit(self, frames: slice, half_width: int, columns: Tensor) -> _Fit:
        """Weighted least squares in windows of one width, at some of the columns."""
        window = slice(frames.start + _HALF_WIDTHS[-1] - half_width, frames.stop + _HALF_WIDTHS[-1] + half_width)
        information = self._information[window].unfold(0, 2 * half_width + 1, 1).flatten(0, 1)[columns]
        points = self._points[:, window].unfold(1, 2 * half_width + 1, 1).flatten(1, 2)[:, columns]
        return _Fit.of(points, information, half_width)


class _Fit(NamedTuple):
    """Polynomials fitted to windows of one width around n columns.

    The coefficients are in the basis that is orthonormal under the weights, the information over the largest in the window. So
    the variance of the noise is 1 / largest in each.
    """

    half_width: int
    lower: Tensor
    """(n, K, K), Cholesky factors of the products of the basis under the weights"""
    coefficients: Tensor
    """(n, K, 3)"""
    energies: Tensor
    """(n, K), sum of the squared coefficients from each degree on"""
    determined: Tensor
    """(n, K), whether the window determines a degree"""
    largest: Tensor
    """(n, 1), largest information of a frame of the window"""
    follows: Tensor
    """(n,), whether the polynomial follows the motion in the window to within the noise"""

    @staticmethod
    def of(points: Tensor, information: Tensor, half_width: int) -> _Fit:
        """Of points (3, n, w) with information (n, w) in windows of w frames."""
        basis, products, _ = _basis(half_width, points.device)
        largest = information.amax(1, keepdim=True).clamp_min(1e-300)
        weights = information / largest
        gram = torch.addmm(_RIDGE * torch.eye(_DEGREES).to(basis).flatten(), weights, products)
        lower = torch.linalg.cholesky_ex(gram.unflatten(1, (_DEGREES, _DEGREES))).L
        weighted = points * weights
        coefficients = torch.linalg.solve_triangular(lower, (weighted @ basis).permute(1, 2, 0), upper=False)
        determined = lower.diagonal(dim1=1, dim2=2) > _MIN_PIVOT
        coefficients = coefficients * determined[..., None]
        energies = coefficients.square().sum(2).flip(1).cumsum(1).flip(1)
        degrees_of_freedom = 3 * ((weights > 0).sum(1) - determined.sum(1)).clamp_min(0)
        chi_square = ((points * weighted).sum((0, 2)) - energies[:, 0]) * largest[:, 0]
        limit = degrees_of_freedom + _MAX_FIT_SIGMAS * (2 * degrees_of_freedom).sqrt()
        follows = (chi_square <= limit) & (degrees_of_freedom > 0)
        return _Fit(half_width, lower, coefficients, energies, determined, largest, follows)

    def at(self, rows: Tensor) -> _Fit:
        """Those of some of the n columns."""
        return _Fit(self.half_width, *(tensor[rows] for tensor in self[1:]))

    @property
    def shrunk(self) -> LocalPolynomials:
        """The polynomials, with each degree shrunk by its energy and that of the higher degrees."""
        _, _, powers = _basis(self.half_width, self.lower.device)
        noise = torch.arange(3 * _DEGREES, 0, -3).to(powers) / self.largest  # expected energy of noise alone
        noise_limit = noise + (2 * noise / self.largest).sqrt()
        shrinkage = (1 - noise_limit / self.energies.clamp_min(1e-300)).clamp_min(0.0)
        shrinkage[:, :_UNSHRUNK_DEGREES] = 1.0
        of_basis = torch.linalg.solve_triangular(self.lower.mT, self.coefficients * shrinkage[..., None], upper=True)
        first_high = (self.determined.sum(1, keepdim=True) - _HIGH_DEGREES).clamp_min(_UNSHRUNK_DEGREES)
        high_degree_motion = (self.energies - noise).gather(1, first_high)[:, 0].clamp_min(0.0).sqrt()
        of_powers = of_basis.permute(2, 0, 1).contiguous() @ powers.mT
        return LocalPolynomials(of_powers.permute(2, 0, 1), high_degree_motion)


def _is_consistent(points: Tensor, variance: Tensor, views: Tensor) -> Tensor:
    """Whether points are near the prediction by their neighbours in time, relative to their usual distance from it, (F, P).

    The prediction is the median of midpoints and linear extrapolations. This test detects wrong keypoints of points that only
    two cameras see, which no third camera can contradict, and moderately wrong ones that were not rejected: they would make
    velocities that are not there, and so wrong time offsets.
    """
    known = points.where(variance.isfinite(), torch.nan)
    neighbours = dict(zip(_NEIGHBOURS, shifted_in_time(known, _NEIGHBOURS), strict=True))
    midpoints = [(neighbours[-k] + neighbours[k]) / 2 for k in (1, 2, 3)]
    extrapolations = [2 * neighbours[k] - neighbours[2 * k] for k in (-1, 1)]
    prediction = torch.stack([*midpoints, *extrapolations]).nanmedian(0).values
    distance = (known - prediction).square().sum(0).sqrt()
    usual = shifted_in_time(distance, range(-_HALF_WIDTHS[1], _HALF_WIDTHS[1] + 1)).nanmedian(0).values
    noise = (3 * variance).sqrt()
    motion = (usual - _USUAL_NOISE * noise).clamp_min(0.0)
    return ~(distance > _MAX_NOISE * noise + torch.where(views > 2, _MAX_MOTION_CONFIRMED, _MAX_MOTION) * motion)


def shifted_in_time(values: Tensor, steps: Sequence[int]) -> Tensor:
    """The values (..., F, P) some frames later, one copy for each of the steps, (steps, ..., F, P). NaN outside the session."""
    widest, frames = max(map(abs, steps)), values.shape[-2]
    padded = torch.nn.functional.pad(values, (0, 0, widest, widest), value=torch.nan)
    return torch.stack([padded[..., widest + k : widest + k + frames, :] for k in steps])


@lru_cache
@torch.inference_mode(mode=False)
def _basis(half_width: int, device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
    """Orthonormal polynomials in a window.

    Returns:
        Their values in the frames of the window, (frames, K); the products of any two of them, (frames, K K); and the matrix
        from their coefficients to those of the powers of the time in frames, (K, K).
    """
    times = torch.linspace(-1, 1, 2 * half_width + 1, dtype=torch.float64)
    basis, triangular = torch.linalg.qr(times[:, None] ** torch.arange(_DEGREES))
    products = (basis[:, :, None] * basis[:, None]).flatten(1)
    powers = torch.linalg.inv(triangular) / half_width ** torch.arange(_DEGREES)[:, None]
    return basis.to(device), products.to(device), powers.to(device)
