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

from torchstickcal.model.measurements import Measurements
from torchstickcal.model.shrinkage import shrunk_logarithms
from torchstickcal.model.state import State
from torchstickcal.workers import map_with_idle_workers

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
_LARGEST_AMPLITUDE = 10.0
_FARTHEST = 1.0
_LEAST_JITTER = 0.02
_MEAN_BY_CHANCE = 0.8
"""Mean of a positive quantity of which zero was found, in standard deviations of the estimate."""
_VALUES_AT_ONCE = 2**22


@dataclass(frozen=True)
class CorrelationGates:
    """What was decided when errors were found to last: held where the estimate is repeated or differentiated."""

    significant: Tensor
    """(B, bins), the bins of lags whose correlation chance does not explain"""
    nothing: Tensor
    """(B, P), points whose errors do not last where those of others do"""

    def of(self, sessions: slice) -> CorrelationGates:
        """The decisions about some of the sessions."""
        return CorrelationGates(self.significant[sessions], self.nothing[sessions])

    def replaced(self, where: Tensor, other: CorrelationGates) -> CorrelationGates:
        """The decisions with some sessions (B,), True where, taken from another."""
        significant, nothing = ((self.significant, other.significant), (self.nothing, other.nothing))
        return CorrelationGates(*(torch.where(where[:, None], new, old) for old, new in (significant, nothing)))


@dataclass(frozen=True)
class ErrorCorrelation:
    """Autocorrelation of the keypoint errors along each point's track, by lag.

    Args:
        values: (B, P, F), the correlation of errors that are 0, 1, ... F - 1 frames apart, 0 to 1; 1 at lag 0.
        gates: what was decided; None for sessions of one or two frames.
    """

    values: Tensor
    gates: CorrelationGates | None = None

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

    @property
    def jitter(self) -> Tensor:
        """Variance of the errors' second differences over frames, as a share of that of independent errors, (B, P)."""
        lags = self.values[..., 1:3]
        return (1 - lags @ lags.new_tensor([4 / 3, -1 / 3])[: lags.shape[-1]]).clamp_min(_LEAST_JITTER)

    @property
    def varying_times(self) -> Tensor:
        """The same, of errors whose mean over the session has been taken out, (B, P). A correlation that is left after half the
        session is that of a part that is always the same."""
        lags = self.values.shape[-1]
        found = 1 - torch.arange(1, lags).to(self.values) / lags
        return 1 + 2 * (self.values[..., 1:] - self.values[..., lags // 2, None]).clamp_min(0.0) @ found

    def spectrum(self, frames: int) -> Tensor:
        """Power of the errors at the frequencies of ``rfft`` over 2 ``frames`` frames, (B, P, frames + 1), mean 1."""
        lags = self.values[..., :frames]
        around = torch.cat([lags, lags[..., -1:], lags[..., 1:].flip(-1)], dim=-1)
        power = torch.fft.rfft(around).real.clamp_min(0.0)
        return power / ((2 * power.sum(-1) - power[..., 0] - power[..., -1]) / (2 * frames))[..., None]

    def between(self, first: slice, second: slice) -> Tensor:
        """Mean correlation (B, P) of the errors in a frame of one slice with those in a frame of a later slice."""
        gap = second.start - first.start
        lags = torch.arange(gap - (first.stop - first.start) + 1, gap + (second.stop - second.start))
        pairs = torch.minimum(lags - lags[0] + 1, lags[-1] + 1 - lags)
        pairs = pairs.clamp_max(min(first.stop - first.start, second.stop - second.start)).to(self.values)
        return self.values[..., lags] @ pairs / pairs.sum()


def error_correlation(
    measurements: Measurements, state: State, sigma_px: Tensor, contrast: float = 0.0, gates: CorrelationGates | None = None
) -> ErrorCorrelation:
    """The autocorrelation of the keypoint errors, from the residuals.

    The estimates of different points are shrunk towards their common mean (empirical Bayes), as those of the noise are.

    Args:
        measurements: the inliers.
        state: the solution.
        sigma_px: noise of each point's keypoints, (B, P), pixels.
        contrast: variance of the logarithm of what lasts between points that is taken for granted; with more, points are drawn
            less towards the mean.
        gates: what was decided before, to be held; None to decide. With them, the estimate is in float64 and differentiable.
    """
    m = measurements
    values = torch.zeros(m.sessions, m.points_per_frame, m.frames, dtype=torch.float64, device=m.pixels.device)
    values[..., 0] = 1.0
    if m.frames <= 2:
        return ErrorCorrelation(values)
    bins = _bins(m.frames, values.device)
    if gates is not None and not bool(gates.significant.any()):
        return ErrorCorrelation(values, gates)
    precision = torch.float32 if gates is None else torch.float64
    products, pairs = _binned_products(m, _residual_tracks(m, state, sigma_px, precision), bins)
    free = _freedom_share(m)
    products, pairs = free[..., None] * products, free[..., None] * pairs
    held = None if gates is None else gates.significant
    common, time, significant = _pooled(products.sum(1), pairs.sum(1), bins.bincount(), held)
    if gates is None:
        gates = CorrelationGates(significant, torch.zeros_like(values[..., 0], dtype=torch.bool))
        if not bool(significant.any()):
            return ErrorCorrelation(values, gates)
        nothing = None
    else:
        nothing = gates.nothing
    independent = 2 * free * m.by_frame(m.visible.sum(1)).sum(1) / time.clamp_max(m.frames)
    amplitudes, nothing = _amplitudes(products, pairs, common, independent, contrast, nothing)
    values[..., 1:] = (amplitudes[..., None] * common[:, None]).clamp(0.0, 1.0)[..., bins]
    return ErrorCorrelation(values, CorrelationGates(significant, nothing))


def _bins(frames: int, device: torch.device) -> Tensor:
    """The bin of each lag 1, 2, ... ``frames`` - 1."""
    bins: list[int] = []
    while len(bins) < frames - 1:
        bins += [bins[-1] + 1 if bins else 0] * max(1, int(_BIN_SHARE * (len(bins) + 1)))
    return torch.tensor(bins[: frames - 1], device=device)


def _residual_tracks(m: Measurements, state: State, sigma_px: Tensor, precision: torch.dtype) -> Tensor:
    """Whitened residuals by track, (B, P, C, 2, F); zero where not seen."""
    tracks = sigma_px.new_empty(m.sessions, m.points_per_frame, m.num_cameras, 2, m.frames, dtype=precision)

    def put(columns: slice) -> None:
        residuals, _ = m.residuals_at(state, columns)
        weights = _square_roots(m.confidence[..., columns]).unflatten(-1, (-1, m.points_per_frame)) / sigma_px[:, None, None]
        whitened = residuals.unflatten(-1, (-1, m.points_per_frame)) * weights.unsqueeze(2)
        whitened = whitened.where(weights.unsqueeze(2) > 0, 0.0).clamp(-_CUT, _CUT)
        frames = slice(columns.start // m.points_per_frame, columns.stop // m.points_per_frame)
        tracks[..., frames] = whitened.movedim(-1, 1).to(precision)

    if any(tensor.requires_grad for tensor in (state.points, state.rotations, state.translations, sigma_px, m.pixels)):
        for columns in m.chunks():  # threads may not write into one tensor with a graph of gradients
            put(columns)
    else:
        map_with_idle_workers(put, m.chunks())
    return tracks


def _square_roots(confidence: Tensor) -> Tensor:
    """Their square roots; the derivative where they are zero is zero."""
    return confidence.where(confidence > 0, 1.0).sqrt().where(confidence > 0, 0.0)


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
    power = torch.view_as_real(torch.fft.rfft(series, n=2 * frames)).square().sum(-3, dtype=torch.float64).sum(-1)
    return torch.fft.irfft(power, n=2 * frames)[..., :frames]


def _freedom_share(m: Measurements) -> Tensor:
    """Degrees of freedom that the residuals of each point have left when it is fitted, as a share of their number, (B, P)."""
    views = m.visible.sum(1)
    free = m.by_frame((2 * views - 3).clamp_min(0)).sum(1)
    return free / m.by_frame(2 * views).sum(1).clamp_min(1)


def _pooled(products: Tensor, pairs: Tensor, widths: Tensor, held: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
    """The correlation of all points together by bin that chance does not explain, (B, bins), and its integrated time (B, 1);
    also in which bins there is such a correlation, (B, bins).

    The sampling variance of a bin is one over its pairs where errors are independent. Where they last, the products at
    neighbouring lags are alike too (Bartlett's formula), by what was found at smaller lags.

    Args:
        products: sums of the products of residuals, (B, bins).
        pairs: their numbers, as far as they are independent, (B, bins).
        widths: (bins,), numbers of lags.
        held: (B, bins), in which bins there is such a correlation; None to decide.
    """
    if held is None and not bool((products > _SIGNIFICANT * pairs.clamp_min(0.1).sqrt()).any()):
        return torch.zeros_like(products), torch.ones_like(products[:, :1]), torch.zeros_like(products, dtype=torch.bool)
    values: list[Tensor] = []
    decided: list[Tensor] = []
    time, squares = (torch.ones_like(products[:, :1]) for _ in range(2))
    for number, width in enumerate(widths.tolist()):
        one = slice(number, number + 1)
        variance = torch.minimum(time.square(), width * squares) / pairs[:, one].clamp_min(0.1)
        found = products[:, one] / pairs[:, one].clamp_min(0.1)
        above = found > _SIGNIFICANT * variance.sqrt() if held is None else held[:, one]
        enough = pairs[:, one] >= _LEAST_PAIRS if number else torch.ones_like(above)
        found = found.where(above, 0.0).clamp(0.0, 1.0)
        values.append(found if not number else found.where(enough, values[-1]))
        decided.append(above & enough)
        time, squares = time + 2 * width * values[-1], squares + 2 * width * values[-1].square()
    return torch.cat(values, dim=1), time, torch.cat(decided, dim=1)


def _amplitudes(
    products: Tensor, pairs: Tensor, common: Tensor, independent: Tensor, contrast: float, nothing: Tensor | None
) -> tuple[Tensor, Tensor]:
    """How much of the common correlation (B, bins) each point has, (B, P), drawn towards that of all points; and who has none.

    It is a variance, that of the errors that last, estimated from few independent ones. So its logarithm is drawn towards the
    mean, as that of the noise is. A point that has none where others clearly have some gets
    what can have been missed by chance.

    Args:
        products: sums of the products of residuals, (B, P, bins).
        pairs: their numbers, as far as they are independent, (B, P, bins).
        common: the correlation of all points together.
        independent: (B, P), number of independent errors that each point has had.
        contrast: variance of the logarithms between points that is taken for granted.
        nothing: (B, P), the points that have none; None to decide.
    """
    by_chance = (pairs @ common.square()[..., None])[..., 0].clamp_min(1e-12).reciprocal()
    own = (products @ common[..., None])[..., 0] * by_chance
    least = _SIGNIFICANT_OF_POINT * by_chance.sqrt()
    scatter = 2 / independent.clamp_min(0.1)
    if nothing is None:
        nothing = (own < least) & (least < (-_SIGNIFICANT_OF_POINT * scatter.sqrt()).exp())
    own = torch.maximum(own, least).clamp_max(_LARGEST_AMPLITUDE)
    sampling = by_chance / own.square() + scatter
    drawn = shrunk_logarithms(own.log(), sampling, independent > 0, contrast, _FARTHEST).exp()
    return drawn.where(~nothing, _MEAN_BY_CHANCE * by_chance.sqrt()), nothing
