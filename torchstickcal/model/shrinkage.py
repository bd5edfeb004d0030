"""Empirical Bayes: estimates of the same kind, each drawn towards the mean of all as far as its own data are few."""

from __future__ import annotations

import math

from torch import Tensor


def shrunk_logarithms(
    logarithms: Tensor, sampling: Tensor, known: Tensor, least: float = 0.0, farthest: float = math.inf
) -> Tensor:
    """Logarithms of variances (B, P), drawn towards the mean of their session.

    The variance between points is what the observed variance of the logarithms has beyond that of sampling. If there is no
    more, all points get the mean.

    Args:
        logarithms: the estimates.
        sampling: (B, P), their sampling variances.
        known: (B, P), which points have an estimate.
        least: variance between points that is taken for granted.
        farthest: sampling deviations by which an estimate is drawn towards the mean at most: one that is unlike the others may
            stay so.
    """
    weights = sampling.reciprocal() * known
    mean = _weighted_mean(logarithms, weights)
    between = _weighted_mean((logarithms - mean).square() - sampling, weights).clamp_min(least)
    total = between + sampling
    drawn = (_weighted_mean(logarithms, total.reciprocal()) - logarithms) * sampling / total
    if farthest < math.inf:
        limit = farthest * sampling.sqrt()
        drawn = drawn.clamp(-limit, limit)
    return logarithms + drawn


def _weighted_mean(values: Tensor, weights: Tensor) -> Tensor:
    return (values * weights).sum(1, keepdim=True) / weights.sum(1, keepdim=True).clamp_min(1e-300)
