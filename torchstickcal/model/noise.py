"""Estimates from the data: noise of the keypoints, and acceleration of the points."""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor

from torchstickcal.losses import SmoothnessLoss
from torchstickcal.losses.track import combined, consecutive
from torchstickcal.model.measurements import Measurements
from torchstickcal.model.ranks import of_rank
from torchstickcal.model.shrinkage import shrunk_logarithms

NEAR_SIGMAS = 3.5
"""Residual, in standard deviations, beyond which a keypoint takes no part in the estimate of the noise. With a wide cut,
outliers raise the estimate, it lets more of them in, and stays at several times the noise."""
_ITERATIONS = 4
_MAX_SORTED = 5000
"""Residuals of a point, evenly spaced in time, whose quartile is taken."""
_MAX_FRAMES = 2000
_LOWER_QUARTILE = -0.6745
"""Of the standard normal distribution."""
_MIN_SIGMA_PX = 1e-4
_MIN_ACCELERATION_M = 1e-5
_MIN_VARIANCE_RATIO = 0.05
"""Smallest variance of the true acceleration, as a fraction of the variance that noise gives to the measured acceleration."""
_COLUMNS_AT_ONCE = 2**20
_NEAR_FRAMES, _USUAL_FRAMES = 12, 3.0
"""Frames before and after that tell how a point accelerates, less the farther away; all frames together count as this many."""


def estimate_sigma_px(measurements: Measurements, squared_residuals: Tensor) -> Tensor:
    """Standard deviation of the keypoints along an image axis, for each point, (B, P), pixels: of :func:`sigma_px_of`."""
    return sigma_px_of(measurements, squared_residuals, near_keypoints(measurements, squared_residuals))


def near_keypoints(measurements: Measurements, squared_residuals: Tensor) -> Tensor:
    """The keypoints that take part in the estimate of the noise: those with residuals below 3.5 standard deviations.

    Of a long session, 2000 evenly spaced frames are looked at.

    Args:
        measurements: the sessions.
        squared_residuals: from :meth:`Measurements.squared_residuals`, (B, C, N).

    Returns:
        A mask (B, C, N), False in frames that are not looked at.
    """
    squared = _of_some_frames(measurements, squared_residuals)
    visible = _of_some_frames(measurements, measurements.visible)
    variance, views = _initial_variance(squared, visible), visible.sum(1)
    near = visible
    for iteration in range(_ITERATIONS):
        before = near
        if iteration:
            variance = _variance(squared, near, measurements.num_cameras, NEAR_SIGMAS)
        near = visible & (squared <= (NEAR_SIGMAS**2 * variance[:, None] * _remaining_share(views))[:, None])
        near = near & (near.sum(1, keepdim=True) >= 2)
        if iteration and torch.equal(near, before):  # and so it would stay
            break
        views = near.sum(1)
    mask = torch.zeros_like(measurements.by_frame(measurements.visible))
    mask[:, :, frames_looked_at(measurements)] = near
    return mask.flatten(2)


def sigma_px_of(measurements: Measurements, squared_residuals: Tensor, taking_part: Tensor, cut: float = NEAR_SIGMAS) -> Tensor:
    """Standard deviation of the keypoints along an image axis, for each point, (B, P), pixels. Differentiable.

    It is that of a keypoint of confidence 1: the root mean square of the residuals of the keypoints that take part, corrected
    for the cut and for the three degrees of freedom of each 3D point. The estimates of different points are then shrunk towards
    their common mean (empirical Bayes on the log variances). If their differences can be explained by chance, all points get
    the same value.

    Args:
        measurements: the sessions.
        squared_residuals: from :meth:`Measurements.squared_residuals`, (B, C, N).
        taking_part: the keypoints that take part, (B, C, N), as from :func:`near_keypoints`.
        cut: residual, in standard deviations, up to which they do.
    """
    squared = _of_some_frames(measurements, squared_residuals)
    return _variance(squared, _of_some_frames(measurements, taking_part), measurements.num_cameras, cut).sqrt()


def estimate_acceleration_m(measurements: Measurements, points: Tensor, point_variance: Tensor) -> Tensor:
    """Standard deviation of the second difference of a point's true motion along an axis, (B, F - 2, P), metres.

    It is the variance of the measured second differences minus the variance that the noise of the points explains, on average
    over the frames near: who swings stands still before. A lower limit is set by the noise: a much smaller acceleration cannot
    be detected.

    Args:
        measurements: the sessions, of F frames.
        points: (B, 3, N).
        point_variance: what the noise explains of the variance of each triangulated point, mean over the three axes, (B, N),
            square metres.
    """
    active, x, noise = (measurements.by_frame(tensor) for tensor in (measurements.active, points, point_variance))
    together = max(1, _COLUMNS_AT_ONCE // (measurements.sessions * measurements.frames))
    parts = zip(*(tensor.split(together, dim=-1) for tensor in (active, x, noise)), strict=True)
    return torch.cat([_acceleration_m(*part) for part in parts], dim=-1)


def _acceleration_m(active: Tensor, x: Tensor, noise: Tensor) -> Tensor:
    """That of some of the points: which are active (B, F, P), where they are (B, 3, F, P), and their variance (B, F, P)."""
    complete, noise = consecutive(active, len(SmoothnessLoss.stencil)), noise.double()
    measured = combined(x, SmoothnessLoss.stencil, dim=-2).square().mean(1)
    expected = noise[:, 2:] + 4 * noise[:, 1:-1] + noise[:, :-2]
    weights = complete / expected.clamp_min(_MIN_ACCELERATION_M**2)
    motion = (measured - expected) * weights
    count, total = complete.sum(1, keepdim=True), weights.sum(1, keepdim=True).clamp_min(1e-300)
    overall = (motion.sum(1, keepdim=True) / total).clamp_min(0.0)
    near, nearby = _sums_near(motion), _sums_near(weights)
    usual = _USUAL_FRAMES * total / count.clamp_min(1)
    variance = (near + usual * overall) / (nearby + usual)
    detectable = _MIN_VARIANCE_RATIO * count / total
    above, least = variance - detectable, _MIN_ACCELERATION_M**2
    raised = detectable + (above + (above.square() + detectable.square() + least**2).sqrt()) / 2  # the larger, without a kink
    return raised.clamp_min(least).sqrt()


def _sums_near(values: Tensor) -> Tensor:
    """Weighted sums over the frames near each frame, of values (B, F, P)."""
    window = torch.hann_window(2 * _NEAR_FRAMES + 1, periodic=False).to(values)[None, None]
    tracks = values.movedim(1, 2)
    if not tracks.shape[2]:
        return values
    sums = torch.nn.functional.conv1d(tracks.flatten(0, 1)[:, None], window, padding=_NEAR_FRAMES)
    return sums.view_as(tracks).movedim(2, 1)


def frames_looked_at(measurements: Measurements) -> Tensor:
    """The frames whose keypoints tell the noise: all, or 2000 of them evenly spaced."""
    return torch.linspace(0, measurements.frames - 1, min(measurements.frames, _MAX_FRAMES)).round().long()


def _of_some_frames(measurements: Measurements, columns: Tensor) -> Tensor:
    """A tensor (B, C, N) by frame, (B, C, F', P), of the frames that are looked at; numbers in float64."""
    by_frame = measurements.by_frame(columns)
    if measurements.frames > _MAX_FRAMES:
        by_frame = by_frame[:, :, frames_looked_at(measurements)]
    return by_frame.double() if by_frame.is_floating_point() else by_frame


def _variance(squared: Tensor, near: Tensor, cameras: int, cut: float) -> Tensor:
    """Variance of the keypoints (B, P), from squared residuals below a cut: of those that take part, both (B, C, F', P)."""
    near = near & (squared < torch.inf)  # points that have moved behind a camera since the keypoints were chosen
    views, moments = near.sum(1), _truncated_moments(cameras, cut).to(squared)
    by_point = (2 * views - 3).clamp_min(0)
    expected = (by_point * moments[views]).sum(1).clamp_min(moments[2])
    variance = squared.where(near, 0.0).sum((1, 2)) / expected
    return _shrink(variance.clamp_min(_MIN_SIGMA_PX**2), by_point.sum(1).to(squared))


def _initial_variance(squared: Tensor, visible: Tensor) -> Tensor:
    """Variance (B, P) from the lower quartile of the squared residuals, which the better keypoints determine.

    Each squared residual is first divided by the fraction that remains after its 3D point was fitted, (2 n - 3) / 2 n for n
    views.
    """
    views = visible.sum(1, keepdim=True)
    quartiles = _lower_quartiles(visible.shape[1]).to(squared)
    corrected = (squared / (_remaining_share(views) * quartiles[views])).where(visible, torch.nan).flatten(1, 2)
    corrected = corrected[:, :: -(-corrected.shape[1] // _MAX_SORTED)]
    known = ~corrected.isnan()
    rank = (known.sum(1) // 4).clamp_max(corrected.shape[1] - 1)
    quartile = of_rank(corrected.where(known, torch.inf).mT, rank[..., None])[..., 0]
    overall = quartile.where(quartile.isfinite(), torch.nan).nanmedian(1, keepdim=True).values.nan_to_num(nan=1.0)
    return quartile.where(quartile.isfinite(), overall).clamp_min(_MIN_SIGMA_PX**2)


def _remaining_share(views: Tensor) -> Tensor:
    """Fraction of a keypoint's variance that its residual has after its 3D point was fitted to n views: (2 n - 3) / 2 n."""
    return (2 * views - 3).clamp_min(1) / (2 * views).clamp_min(4)


@lru_cache
@torch.inference_mode(mode=False)
def _truncated_moments(cameras: int, cut: float) -> Tensor:
    """Second moments of residuals below the cut, as fractions of the full moments, by the number of views from 0 to C."""
    half = _degrees(cameras) / 2
    limit = half * cut**2 / 2
    return torch.special.gammainc(half + 1, limit) / torch.special.gammainc(half, limit)


@lru_cache
@torch.inference_mode(mode=False)
def _lower_quartiles(cameras: int) -> Tensor:
    """Lower quartiles of squared residuals with mean 2, by the number of views from 0 to C (Wilson and Hilferty 1931)."""
    spread = 2 / (9 * _degrees(cameras))
    return 2 * (1 - spread + _LOWER_QUARTILE * spread.sqrt()) ** 3


def _degrees(cameras: int) -> Tensor:
    """Degrees of freedom of the chi-square distribution that squared residuals have, by the number of views from 0 to C.

    The residual of a keypoint has two coordinates. With two views only the distance from the epipolar line remains of them: one
    degree of freedom. With many views it has two.
    """
    return 2 - 1 / (torch.arange(cameras + 1, dtype=torch.float64) - 1).clamp_min(1)


def _shrink(variance: Tensor, degrees_of_freedom: Tensor) -> Tensor:
    """Variances (B, P), their logarithms, of sampling variance ``2 / degrees_of_freedom``, shrunk towards their mean."""
    sampling = 2 / degrees_of_freedom.clamp_min(0.1)
    return shrunk_logarithms(variance.log(), sampling, degrees_of_freedom > 0).exp()
