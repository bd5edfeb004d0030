"""Epipolar residual of two cameras, for all lags between their frames at once.

At the right lag there is a fundamental matrix F with ``b' F a`` near zero for all points a of one camera and b of the other. At
a wrong lag, moving points contradict every F. The smallest mean squared Sampson distance over all F is approximated by Taubin's
method: it is the smallest eigenvalue of a generalised eigenvalue problem (Taubin 1991). That needs only sums over frames of
products of coordinates. These sums are correlations, so the fast Fourier transform computes them for all lags at once.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchstickcal.lazy import cached_property

_PRODUCTS = torch.tensor([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
"""Index of each entry of (x, y, 1) (x, y, 1)' among its six distinct entries xx, xy, x, yy, y, 1."""
_ONE = 5
"""Index of the entry 1."""
_GRADIENT = torch.diag(torch.tensor([1.0, 1.0, 0.0], dtype=torch.float64))
_MIN_POINTS = 30
_EPSILON = 1e-9


@dataclass(frozen=True)
class EpipolarFit:
    """The epipolar residual of two cameras at L lags.

    At a lag, frame f of the first camera is paired with frame f + lag of the second.
    """

    residual_px2: Tensor
    """(L,), smallest mean squared distance from epipolar lines; NaN if there are too few common points"""
    motion_px2: Tensor
    """(L,), mean squared distance of the common points from their mean positions, in the camera with less motion"""
    points: Tensor
    """(L,), number of common points"""


class Tracks:
    """Weighted tracks of keypoints in the images of a session.

    Args:
        pixels: undistorted keypoints, (C, 2, F, P).
        weights: (C, F, P) in [0, 1], zero if not seen.
        max_lag: largest lag, frames.
    """

    def __init__(self, pixels: Tensor, weights: Tensor, max_lag: int) -> None:
        self.pixels, self.weights = pixels, weights
        self.lags = torch.arange(-max_lag, max_lag + 1)
        self._fft_length = 1 << (pixels.shape[2] + max_lag).bit_length()
        total = weights.sum((1, 2)).clamp_min(1.0)
        mean = (pixels * weights[:, None]).sum((2, 3)) / total[:, None]
        centred = (pixels - mean[:, :, None, None]) * (weights[:, None] > 0)
        self._variance_px2 = ((centred.square() * weights[:, None]).sum((1, 2, 3)) / (2 * total)).clamp_min(_EPSILON)
        self._normalised = centred / self._variance_px2.sqrt()[:, None, None, None]

    def fit(self, first: int, second: int) -> EpipolarFit:
        """The epipolar residual of two cameras at all :attr:`lags`."""
        moments, points = self._moments(first, second)
        usable = points >= _MIN_POINTS
        residual = torch.full_like(points, torch.nan)
        matrices, _, regular = self._eigenvalue_problem(moments[usable], first, second)
        residual[usable] = torch.linalg.eigvalsh(matrices)[:, 0].clamp_min(0.0).where(regular, torch.nan)
        return EpipolarFit(residual, self._motion(first, second) / points.clamp_min(1.0), points)

    def distances_px(self, first: int, second: int, lag: int) -> tuple[Tensor, slice, slice] | None:
        """Sampson distances of the common points at one lag.

        Returns:
            The distances (n, P) in n pairs of frames, infinite for points that are not common, and the frames of both cameras.
            None if there are too few common points, or if these are all the same.
        """
        at = lag - int(self.lags[0])
        moments, points = self._moments(first, second)
        if not 0 <= at < len(points) or points[at] < _MIN_POINTS:
            return None
        matrices, back, regular = self._eigenvalue_problem(moments[at : at + 1], first, second)
        if not bool(regular):
            return None
        vector = back[0] @ torch.linalg.eigh(matrices[0]).eigenvectors[:, 0]
        last = -(moments[at, 8, :8] @ vector) / moments[at, 8, 8]
        fundamental = torch.cat([vector, last[None]]).view(3, 3)
        frames = self.pixels.shape[2]
        of_first = slice(max(0, -lag), min(frames, frames - lag))
        of_second = slice(of_first.start + lag, of_first.stop + lag)
        a, b = _homogeneous(self._normalised[first, :, of_first]), _homogeneous(self._normalised[second, :, of_second])
        lines_b, lines_a = torch.einsum("rs,sfp->rfp", fundamental, a), torch.einsum("rs,rfp->sfp", fundamental, b)
        squared_gradient = lines_b[:2].square().sum(0) / self._variance_px2[second]
        squared_gradient = squared_gradient + lines_a[:2].square().sum(0) / self._variance_px2[first]
        distances = (b * lines_b).sum(0).abs() / squared_gradient.clamp_min(1e-300).sqrt()
        common = (self.weights[first, of_first] > 0) & (self.weights[second, of_second] > 0)
        return distances.where(common, torch.inf), of_first, of_second

    @cached_property
    def _spectra(self) -> Tensor:
        """Spectra of the six products of (x, y, 1), (C, 6, K, P) at K frequencies."""
        h = torch.cat([self._normalised, torch.ones_like(self._normalised[:, :1])], dim=1)
        rows, columns = torch.triu_indices(3, 3)
        return torch.fft.rfft(h[:, rows] * h[:, columns] * self.weights[:, None], n=self._fft_length, dim=2)

    @cached_property
    def _deviation_spectra(self) -> Tensor:
        """Spectra of the deviation (x, y) of each point from its mean, of its square, and of 1, (C, 4, K, P)."""
        weights = self.weights[:, None]
        mean = (self.pixels * weights).sum(2, keepdim=True) / weights.sum(2, keepdim=True).clamp_min(_EPSILON)
        deviation = torch.where(weights > 0, self.pixels - mean, 0.0)
        parts = torch.cat([deviation, deviation.square().sum(1, keepdim=True), torch.ones_like(weights)], dim=1)
        return torch.fft.rfft(parts * weights, n=self._fft_length, dim=2)

    def _moments(self, first: int, second: int) -> tuple[Tensor, Tensor]:
        """Sums over the common points of ``v v'`` with v = vec(b a'), (L, 9, 9), and the number of common points (L,)."""
        products = torch.einsum("akp,bkp->abk", self._spectra[first].conj(), self._spectra[second])
        sums = torch.fft.irfft(products, n=self._fft_length)[..., self.lags]
        moments = sums[_PRODUCTS][:, :, _PRODUCTS].permute(4, 2, 0, 3, 1).reshape(-1, 9, 9)
        return moments, sums[_ONE, _ONE]

    def _eigenvalue_problem(self, moments: Tensor, first: int, second: int) -> tuple[Tensor, Tensor, Tensor]:
        """Taubin's problem ``M f = lambda G f`` as a standard symmetric eigenvalue problem.

        M has the moments, G the squared gradients of ``b' F a``. The last entry of f, which has no gradient, is eliminated.

        Returns:
            Symmetric matrices (L, 8, 8), the matrices (L, 8, 8) from their eigenvectors to the first 8 entries of F, and
            whether the problem is regular (L,). The matrices are zero where it is not, as for a point that never moves.
        """
        blocks = moments.view(-1, 3, 3, 3, 3)
        of_first, of_second = blocks[:, 2, :, 2, :], blocks[:, :, 2, :, 2]
        gradient = torch.einsum("uv,lrs->lurvs", _GRADIENT, of_first) / self._variance_px2[second]
        gradient = gradient + torch.einsum("luv,rs->lurvs", of_second, _GRADIENT) / self._variance_px2[first]
        gradient = gradient.reshape(-1, 9, 9)[:, :8, :8]
        ridge = _EPSILON * gradient.diagonal(dim1=1, dim2=2).sum(1) + 1e-300
        identity = torch.eye(8, dtype=moments.dtype)
        factor, failed = torch.linalg.cholesky_ex(gradient + ridge[:, None, None] * identity)
        schur = moments[:, :8, :8] - moments[:, :8, 8:] @ moments[:, 8:, :8] / moments[:, 8:, 8:]
        inverse = torch.linalg.solve_triangular(factor, identity.expand_as(factor), upper=False)
        matrices = inverse @ schur @ inverse.mT
        regular = (failed == 0) & matrices.isfinite().all(-1).all(-1)
        return matrices.where(regular[:, None, None], 0.0), inverse.mT, regular

    def _motion(self, first: int, second: int) -> Tensor:
        """Sum of the squared distances of the common points from their mean positions, (L,), in the camera with less motion."""
        a, b = self._deviation_spectra[first], self._deviation_spectra[second]
        motions = []
        for product in (a.conj() * b[3:], a[3:].conj() * b):
            x, y, squares, count = torch.fft.irfft(product, n=self._fft_length, dim=1)[:, self.lags]
            motions.append((squares - (x.square() + y.square()) / count.clamp_min(1.0)).sum(-1))
        return torch.minimum(*motions).clamp_min(0.0)


def _homogeneous(pixels: Tensor) -> Tensor:
    return torch.cat([pixels, torch.ones_like(pixels[:1])])
