"""Symmetric systems that may be singular or not finite: solved as far as they are determined, never an exception.

The matrices are information matrices (inverse covariances). They are positive definite where the data determine all unknowns,
and singular where they do not, as without a keypoint of some camera.
"""

from __future__ import annotations

import torch
from torch import Tensor

_SINGULAR = 1e-12
"""Eigenvalue over the largest eigenvalue, in the units in which the diagonal is 1, below which a direction is undetermined."""
_ROUNDING = 1e-14
"""Relative size of the rounding errors of a covariance, for each of its rows."""
_UNKNOWN_VARIANCE = 1e12
"""Variance of an unknown about which there is no information at all."""


def solve_information(information: Tensor, rhs: Tensor) -> Tensor:
    """The solution x (K,) of ``A x = b`` for an information matrix A (K, K), zero along undetermined directions.

    Example:
        >>> solve_information(torch.tensor([[2.0, 0.0], [0.0, 0.0]]), torch.tensor([1.0, 0.0]))
        tensor([0.5000, 0.0000])
    """
    factor, failed = torch.linalg.cholesky_ex(information)
    if int(failed) == 0:
        solution = torch.cholesky_solve(rhs[:, None], factor)[:, 0]
        if bool(solution.isfinite().all()):
            return solution
    values, vectors, determined = _directions(information)
    return vectors @ ((vectors.mT @ rhs) * torch.where(determined, values.reciprocal(), 0.0))


def covariance_of(information: Tensor) -> Tensor:
    """The inverses (..., K, K) of information matrices.

    Along an undetermined direction the variance is far beyond anything that is known, but finite, so that it can be propagated:
    1e12 times that along the best determined direction, and 1e12 for an unknown about which there is no information at all.

    Example:
        >>> covariance_of(torch.tensor([[4.0, 0.0], [0.0, 0.0]], dtype=torch.float64)).diagonal().tolist()
        [0.25, 1000000000000.0]
    """
    root = covariance_root(information)
    return root @ root.mT


def covariance_root(information: Tensor) -> Tensor:
    """Roots Q (..., K, K) of the covariances Q Q^T of :func:`covariance_of`.

    Example:
        >>> covariance_root(torch.tensor([[4.0, 0.0], [0.0, 1.0]], dtype=torch.float64)).square().sum(-1).tolist()
        [0.25, 1.0]
    """
    values, vectors, determined = _directions(information)
    variances = torch.where(determined, values, _SINGULAR * values[..., -1:].clamp_min(1e-300)).reciprocal()
    nothing = ~vectors.any(-1)
    root = (vectors * variances.sqrt()[..., None, :]).masked_fill(nothing[..., None], 0.0)
    return root + (nothing * _UNKNOWN_VARIANCE**0.5).diag_embed().to(root)


def definite(covariance: Tensor) -> Tensor:
    """Covariances (..., K, K) as they are where they are positive definite, and elsewhere without what rounding made of them.

    Where the variances along some directions are 1e16 times those along others, rounding errors of the large ones are larger
    than the small ones, and leave eigenvalues of zero and below. There these are raised to the size of the rounding errors.

    Example:
        >>> rounded = torch.tensor([[1.0, 1.0 + 1e-15], [1.0 + 1e-15, 1.0]], dtype=torch.float64)
        >>> int(torch.linalg.cholesky_ex(rounded).info), int(torch.linalg.cholesky_ex(definite(rounded)).info)
        (2, 0)
    """
    known = covariance.isfinite().flatten(-2).all(-1)
    doubtful = known & (torch.linalg.cholesky_ex(covariance.where(known[..., None, None], 0.0)).info > 0)
    if not bool(doubtful.any()):
        return covariance
    diagonal = covariance.diagonal(dim1=-2, dim2=-1)
    scale = diagonal.clamp_min(1e-300).sqrt().where(diagonal > 0, 1e-150)
    unit = (covariance / scale[..., :, None] / scale[..., None, :]).where(doubtful[..., None, None], 0.0)
    values, vectors = torch.linalg.eigh((unit + unit.mT) / 2)
    least = _ROUNDING * covariance.shape[-1] * values[..., -1:].clamp_min(1e-300)
    vectors = vectors * scale[..., :, None]
    raised = (vectors * values.maximum(least)[..., None, :]) @ vectors.mT
    return raised.where(doubtful[..., None, None], covariance)


def propagated(jacobian: Tensor, covariance: Tensor) -> Tensor:
    """The covariances ``J C J^T`` (..., k, k) for Jacobians (..., k, K) and one covariance (K, K), without negative variances.

    Example:
        >>> propagated(torch.tensor([[1.0, -1.0]]), torch.tensor([[2.0, 1.0], [1.0, 2.0]])).item()
        2.0
    """
    root, failed = torch.linalg.cholesky_ex(definite(covariance))
    if int(failed):
        return jacobian @ covariance @ jacobian.mT
    half = jacobian @ root
    return half @ half.mT


def _directions(information: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Eigenvalues (..., K), eigenvectors (..., K, K), and which of them are determined.

    The eigenvalues are those in the units in which the diagonal is 1; the eigenvectors are in the given units. A matrix that is
    not finite counts as zero: without information.
    """
    finite = information.isfinite().flatten(-2).all(-1)[..., None, None]
    information = information.where(finite, 0.0)
    diagonal = information.diagonal(dim1=-2, dim2=-1)
    scale = diagonal.clamp_min(1e-300).rsqrt().where(diagonal > 0, 0.0)
    values, vectors = torch.linalg.eigh(information * scale[..., :, None] * scale[..., None, :])
    return values, vectors * scale[..., None], values > _SINGULAR * values[..., -1:]
