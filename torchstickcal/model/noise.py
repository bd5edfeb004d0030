"""How noisy the keypoints and how unsteady the tracks are, estimated from the data themselves."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchstickcal.losses import SmoothnessLoss
from torchstickcal.losses.track import combined, consecutive
from torchstickcal.model.measurements import Measurements
from torchstickcal.model.state import State

_CUT = 4.0
_ROUNDS = 5
_MAX_FRAMES = 2000
_MEDIAN_CHI2_2 = 2 * math.log(2)
_MIN_SIGMA_PX = 1e-4
_MIN_ACCELERATION_M = 1e-5
_DISCERNIBLE_SHARE = 0.01


def estimate_sigma_px(measurements: Measurements, squared_residuals: Tensor) -> Tensor:
    """Standard deviation of a keypoint along each axis, (B, P), pixels, for every point of the skeleton and the sticks.

    From the residuals of the adjustment: their second moment inside a cut of 4 standard deviations, corrected for the part
    cut off and for the three degrees of freedom each 3D point has taken. Estimates of single points are drawn towards
    their common value as far as their spread is explained by chance (an empirical-Bayes mean of log variances), so that
    points that are alike are treated alike. Of a long session some thousand frames, evenly spread, are looked at.

    Args:
        measurements: the sessions.
        squared_residuals: (B, C, N), of :meth:`Measurements.squared_residuals`.
    """
    frames = torch.linspace(0, measurements.frames - 1, min(measurements.frames, _MAX_FRAMES)).round().long()
    visible = measurements.by_frame(measurements.visible)[:, :, frames]
    squared = measurements.by_frame(squared_residuals)[:, :, frames].double()
    variance = _first_guess(squared, visible)
    for _ in range(_ROUNDS):
        kept = visible & (squared <= _CUT**2 * variance[:, None, None])
        kept = kept & (kept.sum(1, keepdim=True) >= 2)
        freedom = (2 * kept.sum(1) - 3).clamp_min(0).sum(1).to(squared)
        variance = squared.where(kept, 0.0).sum((1, 2)) / freedom.clamp_min(1) / _truncated_moment(_CUT)
        variance = _draw_together(variance.clamp_min(_MIN_SIGMA_PX**2), freedom)
    return variance.sqrt()


def residual_correlation(measurements: Measurements, state: State, sigma_px: Tensor) -> float:
    """How alike the residuals of a track are from one frame to the next, 0 to 1.

    Independent noise has 0; what a camera's model gets wrong, or a detector gets wrong in the same way for a while, comes
    close to 1, and then n residuals tell no more than ``n (1 - r) / (1 + r)`` independent ones would.

    Args:
        measurements: those that took part.
        state: the solution.
        sigma_px: noise of each point's keypoints, (B, P).
    """
    m = measurements
    alike, squares = torch.zeros(2, dtype=torch.float64, device=state.points.device)
    for columns, residuals, _ in m.residuals(state):
        seen = m.visible[..., columns].unsqueeze(-2)
        residuals = residuals.where(seen, torch.nan).double().unflatten(-1, (-1, m.points_per_frame))
        residuals = residuals / sigma_px[:, None, None, None]
        before, after = residuals[..., :-1, :], residuals[..., 1:, :]
        alike += (before * after).nansum()
        squares += (before.square() + after.square()).where((before * after).isfinite(), 0.0).sum() / 2
    return float((alike / squares.clamp_min(1e-300)).clamp(0.0, 1.0))


def estimate_acceleration_m(measurements: Measurements, points: Tensor, point_covariance: Tensor) -> Tensor:
    """Standard deviation of a second difference along each axis, (B, P), metres, of each point's true motion.

    What the measured second differences have beyond the noise of triangulation; never less than a small share of that
    noise, below which a motion cannot be told from none.

    Args:
        measurements: the sessions.
        points: (B, 3, N).
        point_covariance: mean variance along the axes of each point as triangulated, (B, N), square metres.
    """
    complete = consecutive(measurements.by_frame(measurements.active), len(SmoothnessLoss.stencil))
    x, noise = measurements.by_frame(points), measurements.by_frame(point_covariance)
    measured = combined(x, SmoothnessLoss.stencil, dim=-2).square().mean(1)
    expected = noise[:, 2:] + 4 * noise[:, 1:-1] + noise[:, :-2]
    weights = complete / expected.clamp_min(_MIN_ACCELERATION_M**2)
    total = weights.sum(1).clamp_min(1e-300)
    variance = ((measured - expected) * weights).sum(1) / total
    discernible = _DISCERNIBLE_SHARE * complete.sum(1) / total
    return torch.maximum(variance, discernible).clamp_min(_MIN_ACCELERATION_M**2).sqrt()


def _first_guess(squared: Tensor, visible: Tensor) -> Tensor:
    """Variance (B, P) by the median of the squared residuals, each enlarged by the share its point has absorbed."""
    views = visible.sum(1, keepdim=True)
    enlarged = (squared * (2 * views / (2 * views - 3).clamp_min(1))).where(visible, torch.nan)
    median = enlarged.flatten(1, 2).nanmedian(1).values
    if not bool(median.isfinite().all()):
        overall = enlarged.flatten(1).nanmedian(1, keepdim=True).values.nan_to_num(nan=1.0)
        median = median.where(median.isfinite(), overall)
    return (median / _MEDIAN_CHI2_2).clamp_min(_MIN_SIGMA_PX**2)


def _truncated_moment(cut: float) -> float:
    """Second moment of a two-dimensional Gaussian inside a radius of ``cut`` sigma, as a share of the whole."""
    tail = math.exp(-(cut**2) / 2)
    return 1 - (cut**2 / 2) * tail / (1 - tail)


def _draw_together(variance: Tensor, freedom: Tensor) -> Tensor:
    """Shrink log variances (B, P) with given degrees of freedom (B, P) towards the mean of their session."""
    chance = 2 / freedom.clamp_min(0.1)
    logs = variance.log()
    weights = chance.reciprocal() * (freedom > 0)
    mean = _weighted_mean(logs, weights)
    spread = _weighted_mean((logs - mean).square() - chance, weights).clamp_min(0.0)
    mean = _weighted_mean(logs, 1 / (spread + chance))
    return (mean + (logs - mean) * spread / (spread + chance)).exp()


def _weighted_mean(values: Tensor, weights: Tensor) -> Tensor:
    return (values * weights).sum(1, keepdim=True) / weights.sum(1, keepdim=True).clamp_min(1e-300)
