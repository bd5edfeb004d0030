"""Label errors: left and right of the body exchanged, ends of a stick exchanged, another person; found, and undone."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchstickcal.model.measurements import Measurements
from torchstickcal.model.state import State
from torchstickcal.observations import Observations
from torchstickcal.pipeline.relabel.exchanges import Exchange, exchanges
from torchstickcal.pipeline.relabel.hypotheses import exchanged_where
from torchstickcal.pipeline.relabel.views import RayViews

__all__ = ["Exchange", "Labels", "exchanges", "mended"]

_GROSS_SIGMAS = 5.0
_SUSPICIOUS_SHARE = 0.3
"""Share of the keypoints of an exchange that must contradict the points for a camera's frame to be looked at."""
_MEASURED_FRAMES = 2000
_QUARTILE_CHI2_2 = 0.5754
"""Lower quartile of the chi-square distribution with 2 degrees of freedom."""


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

    @property
    def changed(self) -> Tensor:
        """(B, C, F, P), True where a point uses the keypoint that was given for another."""
        return self.index != torch.arange(self.index.shape[-1], device=self.index.device)

    def applied(self, observations: Observations) -> Observations:
        """The one session that these are of, with its keypoints where they belong."""
        index, other = self.index[0], self.other_person[0]
        if not (self.changed.any() or other.any()):
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

    Nothing but the residuals is looked at where they give no reason for suspicion.

    Args:
        labels: as they are so far.
        measurements: the session with these labels.
        state: its cameras and points.
        applied: gives the session with other labels.

    Returns:
        The labels, the session with them, and its points triangulated anew; the given objects where nothing was found.
    """
    suspicions = _Suspicions.of(measurements, state)
    for exchange in exchanges(measurements.point_names, measurements.sticks.tolist()):
        points = torch.tensor(exchange.pairs, device=labels.index.device).mT.flatten()
        frames = suspicions.frames(points)
        if not len(frames):
            continue
        views = RayViews.of(measurements, state, suspicions.sigma_px, frames).at(points)
        where = exchanged_where(views, _pixels(measurements, points), frames)
        if not where.any():
            continue
        partner = torch.arange(measurements.points_per_frame, device=points.device)
        partner[points] = points.roll(len(exchange.pairs))
        labels = labels.exchanged(where, partner)
        measurements = applied(labels)
        state = _triangulated(measurements, state, suspicions.sigma_px, where.any(0).nonzero()[:, 0])
        suspicions = _Suspicions.of(measurements, state)
    return labels, measurements, state


def _triangulated(measurements: Measurements, state: State, sigma_px: Tensor, frames: Tensor) -> State:
    """The state with the points of some frames triangulated anew; zero where fewer than two cameras see a point."""
    points = measurements.by_frame(state.points[0]).clone()
    points[:, frames] = RayViews.of(measurements, state, sigma_px, frames).points().nan_to_num()
    return replace(state, points=points.flatten(1)[None])


@dataclass(frozen=True)
class _Suspicions:
    """Which keypoints of one session grossly contradict the points."""

    gross: Tensor
    """(C, F, P)"""
    visible: Tensor
    """(C, F, P)"""
    sigma_px: Tensor
    """(P,), a cautious estimate of the noise of each point's keypoints"""

    @staticmethod
    def of(measurements: Measurements, state: State) -> _Suspicions:
        squared = measurements.by_frame(measurements.squared_residuals(state)[0])
        visible = measurements.by_frame(measurements.visible[0])
        sigma_px = _noise(squared, visible)
        return _Suspicions(visible & (squared > (_GROSS_SIGMAS * sigma_px).square()), visible, sigma_px)

    def frames(self, points: Tensor) -> Tensor:
        """The frames in which many keypoints of some points in one camera are gross."""
        gross, visible = (mask[..., points].sum(-1) for mask in (self.gross, self.visible))
        return (gross > _SUSPICIOUS_SHARE * visible).any(0).nonzero()[:, 0]


def _pixels(measurements: Measurements, points: Tensor) -> Tensor:
    """The keypoints (C, 2, F, k) of some points of one session, NaN where not seen."""
    pixels, visible = (measurements.by_frame(given[0])[..., points] for given in (measurements.pixels, measurements.visible))
    return pixels.double().where(visible[:, None], torch.nan)


def _noise(squared: Tensor, visible: Tensor) -> Tensor:
    """A cautious estimate of the noise (P,) of each point's keypoints, from the smallest quarter of their residuals."""
    frames = torch.linspace(0, squared.shape[1] - 1, min(squared.shape[1], _MEASURED_FRAMES)).round().long()
    known = squared[:, frames].double().where(visible[:, frames], torch.nan).flatten(0, 1)
    quartile = known.nanquantile(0.25, dim=0)
    overall = known.nanquantile(0.25)
    return (quartile.where(quartile.isfinite(), overall).maximum(overall / 4) / _QUARTILE_CHI2_2).sqrt()
