"""Estimates from the data: noise of the keypoints, correlation of the residuals, and acceleration of the points."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchstickcal.losses import SmoothnessLoss
from torchstickcal.losses.track import combined, consecutive
from torchstickcal.model.measurements import Measurements
from torchstickcal.model.state import State

_CUT = 4.0
"""Residual, in standard deviations, beyond which a keypoint counts as an outlier in the estimate of the noise."""
_ITERATIONS = 5
_MAX_FRAMES = 2000
_MEDIAN_CHI2_2 = 2 * math.log(2)
"""Median of the chi-square distribution with 2 degrees of freedom."""
_MIN_SIGMA_PX = 1e-4
_MIN_ACCELERATION_M = 1e-5
_MIN_VARIANCE_RATIO = 0.01
"""Smallest variance of the true acceleration, as a fraction of the variance that noise gives to the measured acceleration."""


def estimate_sigma_px(measurements: Measurements, squared_residuals: Tensor) -> Tensor:
    """Standard deviation of the keypoints along an image axis, for each point, (B, P), pixels.

    It is the root mean square of the residuals below 4 standard deviations, corrected for this cut and for the three degrees of
    freedom of each 3D point. The estimates of different points are then shrunk towards their common mean (empirical Bayes on
    the log variances). If their differences can be explained by chance, all points get the same value. Of a long session, 2000
    evenly spaced frames are used.

    Args:
        measurements: the sessions.
        squared_residuals: from :meth:`Measurements.squared_residuals`, (B, C, N).
    """
    frames = torch.linspace(0, measurements.frames - 1, min(measurements.frames, _MAX_FRAMES)).round().long()
    visible = measurements.by_frame(measurements.visible)[:, :, frames]
    squared = measurements.by_frame(squared_residuals)[:, :, frames].double()
    variance = _initial_variance(squared, visible)
    for _ in range(_ITERATIONS):
        inliers = visible & (squared <= _CUT**2 * variance[:, None, None])
        inliers = inliers & (inliers.sum(1, keepdim=True) >= 2)
        degrees_of_freedom = (2 * inliers.sum(1) - 3).clamp_min(0).sum(1).to(squared)
        sums = squared.where(inliers, 0.0).sum((1, 2))
        variance = sums / degrees_of_freedom.clamp_min(1) / _truncated_moment(_CUT)
        variance = _shrink(variance.clamp_min(_MIN_SIGMA_PX**2), degrees_of_freedom)
    return variance.sqrt()


def residual_correlation(measurements: Measurements, state: State, sigma_px: Tensor) -> float:
    """Autocorrelation r of the residuals of a track between consecutive frames, 0 to 1.

    Independent noise has r = 0. Model errors of a camera, and detector errors that last for several frames, have an r near 1.
    With an exponentially decaying autocorrelation, n residuals have the information of ``n (1 - r) / (1 + r)`` independent
    residuals.

    Args:
        measurements: the inliers.
        state: the solution.
        sigma_px: noise of each point's keypoints, (B, P).
    """
    m = measurements
    products, squares = torch.zeros(2, dtype=torch.float64, device=state.points.device)
    for columns, residuals, _ in m.residuals(state):
        seen = m.visible[..., columns].unsqueeze(-2)
        residuals = residuals.where(seen, torch.nan).double().unflatten(-1, (-1, m.points_per_frame))
        residuals = residuals / sigma_px[:, None, None, None]
        before, after = residuals[..., :-1, :], residuals[..., 1:, :]
        products += (before * after).nansum()
        squares += (before.square() + after.square()).where((before * after).isfinite(), 0.0).sum() / 2
    return float((products / squares.clamp_min(1e-300)).clamp(0.0, 1.0))


def estimate_acceleration_m(measurements: Measurements, points: Tensor, point_variance: Tensor) -> Tensor:
    """Standard deviation of the second difference of a point's true motion along an axis, (B, P), metres.

    It is the variance of the measured second differences minus the variance that the noise of the points explains. A lower
    limit is set by the noise: a much smaller acceleration cannot be detected.

    Args:
        measurements: the sessions.
        points: (B, 3, N).
        point_variance: variance of each triangulated point, mean over the three axes, (B, N), square metres.
    """
    complete = consecutive(measurements.by_frame(measurements.active), len(SmoothnessLoss.stencil))
    x, noise = measurements.by_frame(points), measurements.by_frame(point_variance).double()
    measured = combined(x, SmoothnessLoss.stencil, dim=-2).square().mean(1)
    expected = noise[:, 2:] + 4 * noise[:, 1:-1] + noise[:, :-2]
    weights = complete / expected.clamp_min(_MIN_ACCELERATION_M**2)
    total = weights.sum(1).clamp_min(1e-300)
    variance = ((measured - expected) * weights).sum(1) / total
    detectable = _MIN_VARIANCE_RATIO * complete.sum(1) / total
    return torch.maximum(variance, detectable).clamp_min(_MIN_ACCELERATION_M**2).sqrt()


def _initial_variance(squared: Tensor, visible: Tensor) -> Tensor:
    """Variance (B, P) from the median of the squared residuals.

    Each squared residual is first divided by the fraction that remains after its 3D point was fitted, (2 n - 3) / 2 n for n
    views.
    """
    views = visible.sum(1, keepdim=True)
    corrected = (squared * (2 * views / (2 * views - 3).clamp_min(1))).where(visible, torch.nan)
    median = corrected.flatten(1, 2).nanmedian(1).values
    if not bool(median.isfinite().all()):
        overall = corrected.flatten(1).nanmedian(1, keepdim=True).values.nan_to_num(nan=1.0)
        median = median.where(median.isfinite(), overall)
    return (median / _MEDIAN_CHI2_2).clamp_min(_MIN_SIGMA_PX**2)


def _truncated_moment(cut: float) -> float:
    """Second moment of a two-dimensional Gaussian inside a radius of ``cut`` sigma, as a fraction of the full moment."""
    tail = math.exp(-(cut**2) / 2)
    return 1 - (cut**2 / 2) * tail / (1 - tail)


def _shrink(variance: Tensor, degrees_of_freedom: Tensor) -> Tensor:
    """Variances (B, P), their logarithms shrunk towards the mean of their session.

    The sampling variance of a log variance is ``2 / degrees_of_freedom``. The variance between points is what the observed
    variance of the log variances has beyond that.
    """
    sampling = 2 / degrees_of_freedom.clamp_min(0.1)
    logs = variance.log()
    weights = sampling.reciprocal() * (degrees_of_freedom > 0)
    mean = _weighted_mean(logs, weights)
    between = _weighted_mean((logs - mean).square() - sampling, weights).clamp_min(0.0)
    mean = _weighted_mean(logs, 1 / (between + sampling))
    return (mean + (logs - mean) * between / (between + sampling)).exp()


def _weighted_mean(values: Tensor, weights: Tensor) -> Tensor:
    return (values * weights).sum(1, keepdim=True) / weights.sum(1, keepdim=True).clamp_min(1e-300)
