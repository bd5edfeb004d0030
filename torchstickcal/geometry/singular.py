"""Symmetric systems that may be singular or not finite: solved as far as they are determined, never an exception.

The matrices are information matrices (inverse covariances). They are positive definite where the data determine all unknowns,
and singular where they do not, as without a keypoint of some camera.
"""

from __future__ import annotations

import torch
from torch import Tensor

_SINGULAR = 1e-12
"""Eigenvalue over the largest eigenvalue, in the units in which the diagonal is 1, below which a direction is undetermined."""
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
