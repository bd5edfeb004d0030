"""How long the errors of the keypoints last: their autocorrelation over frames, for each point.

Detectors err alike in neighbouring frames, so that n keypoints of a track have less information than n independent ones. The
autocorrelation is estimated from the residuals, pooled over cameras and image axes. Lags are pooled too, in bins that become
wider with the lag, so that a small correlation that lasts long is found. Only what chance does not explain is kept: where
errors are independent, the estimate is zero at every lag, exactly.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchstickcal.model.measurements import Measurements
from torchstickcal.model.state import State

_CUT = 3.0
"""Residual, in standard deviations, to which larger ones are drawn in: a single outlier must not look like a pattern."""
_SIGNIFICANT = 3.0
"""Estimate, in standard deviations, from which on a correlation of all points together is taken as real; of one point, 2."""
_SIGNIFICANT_OF_POINT = 2.0
_BIN_SHARE = 0.25
"""Width of a bin of lags, as a share of the lag."""
_LEAST_PAIRS = 30
"""Pairs of residuals from which on a bin is estimated by itself. Beyond, the correlation is taken to stay as it is."""
_LEAST_VARIANCE = 0.05
"""Squared residual, in units of the noise, below which residuals are rounding errors."""
_VALUES_AT_ONCE = 2**22


@dataclass(frozen=True)
class ErrorCorrelation:
    """Autocorrelation of the keypoint errors along each point's track, by lag.

    Args:
        values: (B, P, F), the correlation of errors that are 0, 1, ... F - 1 frames apart, 0 to 1; 1 at lag 0.
    """

    values: Tensor

    @property
    def lasts(self) -> bool:
        """Whether the errors of any point last longer than one frame."""
        return bool(self.values[..., 1:].any())

    @property
    def times(self) -> Tensor:
        """Integrated autocorrelation time of each point, (B, P), frames: as many keypoints are worth one independent one.

        1 where errors are independent, F where they never change. A lag l is found F - l times in F frames.
        """
        frames = self.values.shape[-1]
        found = 1 - torch.arange(1, frames).to(self.values) / frames
        return 1 + 2 * self.values[..., 1:] @ found

    def spectrum(self, frames: int) -> Tensor:
        """Power of the errors at the frequencies of ``rfft`` over 2 ``frames`` frames, (B, P, frames + 1), 0 or more, mean 1."""
        lags = pad(self.values, (0, max(0, frames - self.values.shape[-1])))[..., :frames]
        around = torch.cat([lags, torch.zeros_like(lags[..., :1]), lags[..., 1:].flip(-1)], dim=-1)
        power = torch.fft.rfft(around).real.clamp_min(0.0)
        return power / ((2 * power.sum(-1) - power[..., 0] - power[..., -1]) / (2 * frames))[..., None]

    def between(self, first: slice, second: slice) -> Tensor:
        """Mean correlation (B, P) of the errors in a frame of one slice with those in a frame of a later slice."""
        gap = second.start - first.start
        lags = torch.arange(gap - (first.stop - first.start) + 1, gap + (second.stop - second.start))
        pairs = torch.minimum(lags - lags[0] + 1, lags[-1] + 1 - lags)
        pairs = pairs.clamp_max(min(first.stop - first.start, second.stop - second.start)).to(self.values)
        return self.values[..., lags] @ pairs / pairs.sum()


def error_correlation(measurements: Measurements, state: State, sigma_px: Tensor) -> ErrorCorrelation:
    """The autocorrelation of the keypoint errors, from the residuals.

    The estimates of different points are shrunk towards their common mean (empirical Bayes), as those of the noise are.

    Args:
        measurements: the inliers.
        state: the solution.
        sigma_px: noise of each point's keypoints, (B, P), pixels.
    """
    m = measurements
    values = torch.zeros(m.sessions, m.points_per_frame, m.frames, dtype=torch.float64, device=m.pixels.device)
    values[..., 0] = 1.0
    if m.frames > 2:
        bins = _bins(m.frames, values.device)
        products, pairs = _binned_products(m, _residual_tracks(m, state, sigma_px), bins)
        values[..., 1:] = _kept(products, pairs, _freedom_share(m), bins.bincount())[..., bins]
    return ErrorCorrelation(values)


def _bins(frames: int, device: torch.device) -> Tensor:
    """The bin of each lag 1, 2, ... ``frames`` - 1."""
    bins: list[int] = []
    while len(bins) < frames - 1:
        bins += [bins[-1] + 1 if bins else 0] * max(1, int(_BIN_SHARE * (len(bins) + 1)))
    return torch.tensor(bins[: frames - 1], device=device)


def _residual_tracks(m: Measurements, state: State, sigma_px: Tensor) -> Tensor:
    """Whitened residuals by track, (B, P, C, 2, F), in float32; zero where not seen."""
    tracks = sigma_px.new_empty(m.sessions, m.points_per_frame, m.num_cameras, 2, m.frames, dtype=torch.float32)
    for columns, residuals, _ in m.residuals(state):
        weights = m.confidence[..., columns].sqrt().unflatten(-1, (-1, m.points_per_frame)) / sigma_px[:, None, None]
        whitened = residuals.unflatten(-1, (-1, m.points_per_frame)) * weights.unsqueeze(2)
        whitened = whitened.where(weights.unsqueeze(2) > 0, 0.0).clamp(-_CUT, _CUT)
        frames = slice(columns.start // m.points_per_frame, columns.stop // m.points_per_frame)
        tracks[..., frames] = whitened.movedim(-1, 1).to(torch.float32)
    return tracks


def _binned_products(m: Measurements, tracks: Tensor, bins: Tensor) -> tuple[Tensor, Tensor]:
    """Products of a track's residuals at some lag, in units of their variance, and how many pairs there are, (B, P, bins)."""
    seen = m.by_frame(m.visible).permute(0, 3, 1, 2)
    together = max(1, _VALUES_AT_ONCE // (2 * m.sessions * m.num_cameras * 2 * m.frames))
    products, pairs = (tracks.new_zeros(*tracks.shape[:2], int(bins[-1]) + 1, dtype=torch.float64) for _ in range(2))
    for first in range(0, m.points_per_frame, together):
        part = slice(first, first + together)
        own, count = _by_lag(tracks[:, part].flatten(2, 3)), 2 * _by_lag(seen[:, part].to(tracks.dtype)).round()
        variance = (own[..., :1] / count[..., :1].clamp_min(1)).clamp_min(_LEAST_VARIANCE)
        products[:, part].index_add_(-1, bins, own[..., 1:] / variance)
        pairs[:, part].index_add_(-1, bins, count[..., 1:])
    return products, pairs


def _by_lag(series: Tensor) -> Tensor:
    """Sums over tracks (B, P, tracks, F) of the products of values some lag apart, (B, P, F)."""
    frames = series.shape[-1]
    power = torch.view_as_real(torch.fft.rfft(series, n=2 * frames)).square().sum((-3, -1), dtype=torch.float64)
    return torch.fft.irfft(power, n=2 * frames)[..., :frames]


def _freedom_share(m: Measurements) -> Tensor:
    """Degrees of freedom that the residuals of each point have left when it is fitted, as a share of their number, (B, P)."""
    views = m.visible.sum(1)
    free = m.by_frame((2 * views - 3).clamp_min(0)).sum(1)
    return free / m.by_frame(2 * views).sum(1).clamp_min(1)


def _kept(products: Tensor, pairs: Tensor, free: Tensor, widths: Tensor) -> Tensor:
    """The correlation by bin, (B, P, bins), that chance does not explain.

    The sampling variance of a bin is one over its pairs where errors are independent. Where they last, the products at
    neighbouring lags are alike too (Bartlett's formula), by what was found at smaller lags.

    Args:
        products: sums of the products of residuals, (B, P, bins).
        pairs: their numbers, (B, P, bins).
        free: (B, P), share of them that counts.
        widths: (bins,), numbers of lags.
    """
    values = torch.zeros_like(products)
    time, squares = (torch.ones_like(free[:, :1]) for _ in range(2))
    for number, width in enumerate(widths.tolist()):
        count, own = pairs[..., number], values[..., number]
        if float(count.sum(1).max()) < _LEAST_PAIRS and number:
            own.copy_(values[..., number - 1])
            continue
        inflation = torch.minimum(time.square(), width * squares)
        variance = inflation / (free * count).clamp_min(0.1)
        weights = (count > 0) / variance
        estimates = products[..., number] / count.clamp_min(1)
        total = weights.sum(1, keepdim=True).clamp_min(1e-300)
        mean = (estimates * weights).sum(1, keepdim=True) / total
        between = (((estimates - mean).square() - variance) * weights).sum(1, keepdim=True).div(total).clamp_min(0.0)
        shrunk = mean + (estimates - mean) * between / (between + variance)
        uncertain = (between * variance / (between + variance)).sqrt()
        real = (mean > _SIGNIFICANT * total.rsqrt()) & (shrunk > _SIGNIFICANT_OF_POINT * uncertain)
        own.copy_(shrunk.where(real, 0.0).clamp(0.0, 1.0))
        pooled = (own * weights).sum(1, keepdim=True) / total
        time, squares = time + 2 * width * pooled, squares + 2 * width * pooled.square()
    return values
