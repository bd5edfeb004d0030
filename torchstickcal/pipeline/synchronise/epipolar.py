"""How well two cameras agree at every lag between their frames at once.

At the right lag some fundamental matrix F leaves no more than noise of ``b' F a`` for the points a of one camera and b of the
other; at a wrong one, points that move contradict every F. The least mean squared Sampson distance over F (by Taubin's
approximation: the smallest eigenvalue of a pencil) needs only sums over frames of products of coordinates, and these sums are
correlations: the Fourier transform gives them for all lags together.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

_PRODUCTS = torch.tensor([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
"""Where x x, x y, x, y y, y, 1 stand in the outer product of (x, y, 1)."""
_ONE = 5
_GRADIENT = torch.diag(torch.tensor([1.0, 1.0, 0.0], dtype=torch.float64))
_FEWEST_POINTS = 30
_EPSILON = 1e-9


@dataclass(frozen=True)
class Agreement:
    """Two cameras at lags (L,): the second's frame f + lag beside the first's frame f."""

    residual_px2: Tensor
    """(L,), least mean squared distance from epipolar lines; NaN where too few points are common"""
    motion_px2: Tensor
    """(L,), mean squared distance of the common points from their mean places, of the camera in which it is less"""
    points: Tensor
    """(L,), number of common points"""


class Tracks:
    """Weighted image tracks of a session.

    Args:
        places: undistorted pixels (C, 2, F, P).
        weights: (C, F, P) in [0, 1], zero where not seen.
        longest_lag: frames.
    """

    def __init__(self, places: Tensor, weights: Tensor, longest_lag: int) -> None:
        self.places, self.weights = places, weights
        self.lags = torch.arange(-longest_lag, longest_lag + 1)
        self._length = 1 << (places.shape[2] + longest_lag).bit_length()
        total = weights.sum((1, 2)).clamp_min(1.0)
        mean = (places * weights[:, None]).sum((2, 3)) / total[:, None]
        centred = (places - mean[:, :, None, None]) * (weights[:, None] > 0)
        self._variance_px2 = ((centred.square() * weights[:, None]).sum((1, 2, 3)) / (2 * total)).clamp_min(_EPSILON)
        self._normal = centred / self._variance_px2.sqrt()[:, None, None, None]

    def agreement(self, first: int, second: int) -> Agreement:
        """How two cameras agree at :attr:`lags`."""
        moments, points = self._moments(first, second)
        usable = points >= _FEWEST_POINTS
        residual = torch.full_like(points, torch.nan)
        reduced = self._reduced(moments[usable], first, second)[0]
        residual[usable] = torch.linalg.eigvalsh(reduced)[:, 0].clamp_min(0.0)
        return Agreement(residual, self._motion(first, second) / points.clamp_min(1.0), points)

    def distances_px(self, first: int, second: int, lag: int) -> tuple[Tensor, slice, slice] | None:
        """Sampson distances (n, P) of the common points at one lag, infinite elsewhere, and the frames of each camera.

        None where too few points are common.
        """
        at = lag - int(self.lags[0])
        moments, points = self._moments(first, second)
        if not 0 <= at < len(points) or points[at] < _FEWEST_POINTS:
            return None
        reduced, back = self._reduced(moments[at : at + 1], first, second)
        vector = back[0] @ torch.linalg.eigh(reduced[0]).eigenvectors[:, 0]
        last = -(moments[at, 8, :8] @ vector) / moments[at, 8, 8]
        fundamental = torch.cat([vector, last[None]]).view(3, 3)
        frames = self.places.shape[2]
        of_first = slice(max(0, -lag), min(frames, frames - lag))
        of_second = slice(of_first.start + lag, of_first.stop + lag)
        a, b = (_homogeneous(self._normal[camera, :, at]) for camera, at in ((first, of_first), (second, of_second)))
        lines_b, lines_a = torch.einsum("rs,sfp->rfp", fundamental, a), torch.einsum("rs,rfp->sfp", fundamental, b)
        slope = lines_b[:2].square().sum(0) / self._variance_px2[second]
        slope = slope + lines_a[:2].square().sum(0) / self._variance_px2[first]
        distances = (b * lines_b).sum(0).abs() / slope.clamp_min(1e-300).sqrt()
        common = (self.weights[first, of_first] > 0) & (self.weights[second, of_second] > 0)
        return distances.where(common, torch.inf), of_first, of_second

    @cached_property
    def _spectra(self) -> Tensor:
        """Of the six products of (x, y, 1), (C, 6, K, P)."""
        h = torch.cat([self._normal, torch.ones_like(self._normal[:, :1])], dim=1)
        rows, columns = torch.triu_indices(3, 3)
        return torch.fft.rfft(h[:, rows] * h[:, columns] * self.weights[:, None], n=self._length, dim=2)

    @cached_property
    def _about_means(self) -> Tensor:
        """Spectra of x, y about each point's mean, of their square, and of 1, (C, 4, K, P)."""
        weights = self.weights[:, None]
        mean = (self.places * weights).sum(2, keepdim=True) / weights.sum(2, keepdim=True).clamp_min(_EPSILON)
        moved = torch.where(weights > 0, self.places - mean, 0.0)
        parts = torch.cat([moved, moved.square().sum(1, keepdim=True), torch.ones_like(weights)], dim=1)
        return torch.fft.rfft(parts * weights, n=self._length, dim=2)

    def _moments(self, first: int, second: int) -> tuple[Tensor, Tensor]:
        """Sums of (b a')(b a')' over the common points, (L, 9, 9), and their number (L,)."""
        products = torch.einsum("akp,bkp->abk", self._spectra[first].conj(), self._spectra[second])
        sums = torch.fft.irfft(products, n=self._length)[..., self.lags]
        moments = sums[_PRODUCTS][:, :, _PRODUCTS].permute(4, 2, 0, 3, 1).reshape(-1, 9, 9)
        return moments, sums[_ONE, _ONE]

    def _reduced(self, moments: Tensor, first: int, second: int) -> tuple[Tensor, Tensor]:
        """The pencil of algebraic error and gradient as a symmetric matrix (L, 8, 8), and the way back to F's first entries."""
        blocks = moments.view(-1, 3, 3, 3, 3)
        of_first, of_second = blocks[:, 2, :, 2, :], blocks[:, :, 2, :, 2]
        gradient = torch.einsum("uv,lrs->lurvs", _GRADIENT, of_first) / self._variance_px2[second]
        gradient = gradient + torch.einsum("luv,rs->lurvs", of_second, _GRADIENT) / self._variance_px2[first]
        gradient = gradient.reshape(-1, 9, 9)[:, :8, :8]
        least = _EPSILON * gradient.diagonal(dim1=1, dim2=2).sum(1) + 1e-300
        factor = torch.linalg.cholesky(gradient + least[:, None, None] * torch.eye(8, dtype=moments.dtype))
        schur = moments[:, :8, :8] - moments[:, :8, 8:] @ moments[:, 8:, :8] / moments[:, 8:, 8:]
        inverse = torch.linalg.inv(factor)
        return inverse @ schur @ inverse.mT, inverse.mT

    def _motion(self, first: int, second: int) -> Tensor:
        """Sum of the squared distances (L,) of the common points from their mean places."""
        a, b = self._about_means[first], self._about_means[second]
        sums = []
        for product in (a.conj() * b[3:], a[3:].conj() * b):
            x, y, squares, count = torch.fft.irfft(product, n=self._length, dim=1)[:, self.lags]
            sums.append((squares - (x.square() + y.square()) / count.clamp_min(1.0)).sum(-1))
        return torch.minimum(*sums).clamp_min(0.0)


def _homogeneous(places: Tensor) -> Tensor:
    return torch.cat([places, torch.ones_like(places[:1])])
