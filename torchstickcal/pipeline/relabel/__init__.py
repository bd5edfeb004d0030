"""Label errors: left and right of the body exchanged, ends of a stick exchanged, another person; found, and undone."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchstickcal.model.measurements import Measurements
from torchstickcal.model.ranks import nanquantile
from torchstickcal.model.state import State
from torchstickcal.observations import Observations
from torchstickcal.pipeline.relabel.exchanges import Exchange, exchanges
from torchstickcal.pipeline.relabel.hypotheses import exchanged_where
from torchstickcal.pipeline.relabel.persons import other_persons
from torchstickcal.pipeline.relabel.views import RayViews

__all__ = ["Exchange", "Labels", "exchanges", "mended"]

_GROSS_SIGMAS = 6.0
_GROSS_SHARE = 0.2
"""Least residual of an exchanged keypoint, as a share of its distance to the one that it is exchanged for."""
_CONTRADICTING_SHARE, _FAR_SHARE = 0.5, 0.05
"""For another person to be thought of: share of a camera's keypoints that must contradict their points, and their least median
residual as a share of the body's root mean square size."""
_LARGEST_OTHER_SHARE = 0.6
"""Of a camera's frames: a camera that shows another person in more is none that agrees with the others."""
_LEAST_SHARE = 0.01
"""Share of wrong keypoints, and of right ones, that is never ruled out."""
_SUSPICIOUS_SHARE = 0.3
"""Share of the keypoints of an exchange that must contradict the points for a camera's frame to be looked at."""
_MEASURED_FRAMES = 2000
_LEAST_NOISE_PX = 0.05
_SHARE, _QUANTILE_CHI2_2 = 0.1, 0.2107
"""A share of keypoints that are right even where most labels are wrong, and the quantile of it of the chi-square distribution
with 2 degrees of freedom."""
_LARGEST_RATIO = 3.0
"""Of the noise of a point to that of all points."""


@dataclass(frozen=True)
class Labels:
    """Which given keypoint each point uses in each camera and frame, of B sessions.

    Args:
        index: (B, C, F, P), the point whose given keypoint a point uses.
        other_person: (B, C, F), True where all keypoints are set aside, as those of another person.
    """

    index: Tensor
    other_person: Tensor

    @staticmethod
    def as_given(measurements: Measurements) -> Labels:
        """Every point uses its own keypoint."""
        shape = (measurements.sessions, measurements.num_cameras, measurements.frames)
        points = torch.arange(measurements.points_per_frame, device=measurements.pixels.device)
        return Labels(points.expand(*shape, -1), torch.zeros(shape, dtype=torch.bool, device=points.device))

    @staticmethod
    def stack(sessions: Sequence[Labels]) -> Labels:
        """Those of several sessions as one batch."""
        if len(sessions) == 1:
            return sessions[0]
        return Labels(torch.cat([s.index for s in sessions]), torch.cat([s.other_person for s in sessions]))

    def __getitem__(self, sessions: slice) -> Labels:
        """Those of some of the sessions."""
        return Labels(self.index[sessions], self.other_person[sessions])

    def exchanged(self, where: Tensor, partner: Tensor) -> Labels:
        """After one more exchange: where (C, F) it is of one session, partner (P,) the point whose keypoint each point gets."""
        return replace(self, index=self.index.where(~where[..., None], self.index[..., partner]))

    def without(self, other: Tensor) -> Labels:
        """Of one session, with camera frames (C, F) set aside as those of another person."""
        own = torch.arange(self.index.shape[-1], device=other.device)
        return Labels(torch.where(other[..., None], own, self.index), other[None])

    def exchanged_frames(self, exchange: Exchange) -> Tensor:
        """(B, C, F), True where any pair of an exchange uses each other's keypoints."""
        first, second = torch.tensor(exchange.pairs, device=self.index.device).mT
        return ((self.index[..., first] == second) | (self.index[..., second] == first)).any(-1)

    @property
    def touched(self) -> Tensor:
        """(B, C, F), True where anything is not as given."""
        return self.changed.any(-1) | self.other_person

    @property
    def changed(self) -> Tensor:
        """(B, C, F, P), True where a point uses the keypoint that was given for another."""
        return self.index != torch.arange(self.index.shape[-1], device=self.index.device)

    def applied(self, observations: Observations) -> Observations:
        """The one session that these are of, with its keypoints where they belong."""
        index, other = self.index[0], self.other_person[0]
        if not self.touched.any():
            return observations
        keypoints, confidence = observations.keypoints, observations.confidence
        keypoints = keypoints.gather(2, index[..., None].expand(-1, -1, -1, 2))
        return replace(
            observations,
            keypoints=keypoints.masked_fill(other[..., None, None], torch.nan),
            confidence=None if confidence is None else confidence.gather(2, index),
        )


def mended(
    labels: Labels, measurements: Measurements, state: State, applied: Callable[[Labels], Measurements]
) -> tuple[Labels, Measurements, State]:
    """One session with its label errors undone.

    Nothing but the residuals is looked at where they give no reason for suspicion. What was found earlier, with cameras that
    were less well known, is decided anew.

    Args:
        labels: as they are so far.
        measurements: the session with these labels.
        state: its cameras and points.
        applied: gives the session with other labels.

    Returns:
        The labels, the session with them, and its points triangulated anew; the given objects where the labels stay.
    """
    given = labels, measurements, state
    residuals = _Residuals.of(measurements, state)
    sigma_px = residuals.sigma_px

    def with_labels(new: Labels, frames: Tensor) -> tuple[Labels, Measurements, State]:
        again = applied(new)
        return new, again, _triangulated(again, state, sigma_px, frames.nonzero()[:, 0])

    if (touched := labels.touched[0].any(0)).any():
        labels, measurements, state = with_labels(Labels.as_given(measurements), touched)
        residuals = _Residuals.of(measurements, state)
    elif not residuals.gross.any():
        return given
    for exchange in exchanges(measurements.point_names, measurements.sticks.tolist()):
        points = torch.tensor(exchange.pairs, device=touched.device).mT.flatten()
        frames = residuals.suspicious(points).nonzero()[:, 0]
        if not len(frames):
            continue
        views = RayViews.of(measurements, state, sigma_px, frames).at(points)
        where = exchanged_where(views, residuals.pixels[..., points], frames, exchange.margin)
        if where.any():
            partner = torch.arange(measurements.points_per_frame, device=points.device)
            partner[points] = points.roll(len(exchange.pairs))
            labels, measurements, state = with_labels(labels.exchanged(where, partner), where.any(0))
            residuals = _Residuals.of(measurements, state)
    frames = residuals.contradicting.any(0).nonzero()[:, 0]
    if len(frames) and measurements.num_cameras > 2:
        other = torch.zeros_like(residuals.contradicting)
        other[:, frames] = other_persons(RayViews.of(measurements, state, sigma_px, frames), residuals.right_share)
        other &= residuals.contradicting
        seen = residuals.visible.any(-1)
        other &= (other.sum(-1) <= _LARGEST_OTHER_SHARE * seen.sum(-1))[:, None]
        if other.any():
            labels, measurements, state = with_labels(labels.without(other), other.any(0))
    if all(map(torch.equal, (labels.index, labels.other_person), (given[0].index, given[0].other_person))):
        return given
    return labels, measurements, state


@dataclass(frozen=True)
class _Residuals:
    """What contradicts what in one session."""

    squared: Tensor
    """(C, F, P), square pixels, 0 where not seen"""
    visible: Tensor
    """(C, F, P)"""
    sigma_px: Tensor
    """(P,), a cautious estimate of the noise of each point's keypoints"""
    measurements: Measurements

    @staticmethod
    def of(measurements: Measurements, state: State) -> _Residuals:
        squared = measurements.by_frame(measurements.squared_residuals(state)[0])
        visible = measurements.by_frame(measurements.visible[0])
        return _Residuals(squared.where(visible, 0.0), visible, _noise(squared, visible), measurements)

    @property
    def pixels(self) -> Tensor:
        """(C, 2, F, P), NaN where not seen."""
        m = self.measurements
        return m.by_frame(m.pixels[0]).double().where(self.visible[:, None], torch.nan)

    @property
    def gross(self) -> Tensor:
        """(C, F, P), True where a keypoint is far from its point, compared with its noise."""
        return self.squared > (_GROSS_SIGMAS * self.sigma_px).square()

    @property
    def right_share(self) -> Tensor:
        """(C,), share of each camera's keypoints that are near their points in the frames in which most are."""
        counted = self.visible & ~self.contradicting[..., None]
        right = (counted & ~self.gross).sum((1, 2)) / counted.sum((1, 2)).clamp_min(1)
        return right.double().clamp(_LEAST_SHARE, 1 - _LEAST_SHARE)

    @property
    def contradicting(self) -> Tensor:
        """(C, F), True where most keypoints of a camera are far from their points, compared with the size of the body."""
        gross = self.gross
        many = gross.sum(-1) > _CONTRADICTING_SHARE * self.visible.sum(-1)
        if not many.any():
            return many
        pixels = self.pixels
        extent = (pixels - pixels.nanmean(-1, keepdim=True)).square().sum(1)
        far = self.squared.where(self.visible, torch.nan).nanmedian(-1).values > _FAR_SHARE**2 * extent.nanmean(-1)
        return many & far

    def suspicious(self, points: Tensor) -> Tensor:
        """The frames (F,) in which keypoints of one camera contradict their points as much as if they were exchanged.

        Args:
            points: those that may be exchanged, each half of them for the other.
        """
        squared, pixels = self.squared[..., points], self.pixels[..., points]
        gross = squared > (_GROSS_SIGMAS * self.sigma_px[points]).square()
        if not gross.any():
            return gross.any(-1).any(0)
        apart = (pixels - pixels.roll(len(points) // 2, -1)).square().sum(1).nan_to_num()
        gross &= squared > _GROSS_SHARE**2 * apart
        return (gross.sum(-1) > _SUSPICIOUS_SHARE * pixels[:, 0].isfinite().sum(-1)).any(0)


def _triangulated(measurements: Measurements, state: State, sigma_px: Tensor, frames: Tensor) -> State:
    """The state with the points of some frames triangulated anew; zero where fewer than two cameras see a point."""
    points = measurements.by_frame(state.points[0]).clone()
    points[:, frames] = RayViews.of(measurements, state, sigma_px, frames).points().nan_to_num()
    return replace(state, points=points.flatten(1)[None])


def _noise(squared: Tensor, visible: Tensor) -> Tensor:
    """A cautious estimate of the noise (P,) of each point's keypoints, from the smallest tenth of their residuals.

    Each squared residual is first divided by the fraction that remains after its 3D point was fitted.
    """
    frames = torch.linspace(0, squared.shape[1] - 1, min(squared.shape[1], _MEASURED_FRAMES)).round().long()
    squared, visible = squared[:, frames].double(), visible[:, frames]
    views = visible.sum(0)
    known = (squared * (2 * views / (2 * views - 3).clamp_min(1))).where(visible, torch.nan).flatten(0, 1)
    overall, each = nanquantile(known.flatten()[None], _SHARE)[0], nanquantile(known.mT, _SHARE)
    each = each.where(each.isfinite(), overall).clamp(overall / _LARGEST_RATIO**2, overall * _LARGEST_RATIO**2)
    return (each / _QUANTILE_CHI2_2).sqrt().clamp_min(_LEAST_NOISE_PX)
