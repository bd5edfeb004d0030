"""The objective: the losses of a stage, bound to one session.

It can be asked for its value in two ways that the tests hold equal: as scalars through autograd, for LBFGS and training
loops, and linearised block by block, for the Gauss-Newton solver.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from torchstickcal.losses import CameraPointLoss, Loss, PairLoss, TrackLoss
from torchstickcal.losses.base import CameraPointTerms, PairTerms, TrackTerms
from torchstickcal.problem import Measurements, State


@dataclass(frozen=True)
class _BoundLoss:
    """A camera-point loss with its information matrix (C, N) on one session."""

    loss: CameraPointLoss
    information: Tensor


class Objective:
    """The weighted sum of named losses over one session.

    Args:
        measurements: the session.
        losses: the losses by name; their weights and standard deviations are their own.
    """

    def __init__(self, measurements: Measurements, losses: Mapping[str, Loss]) -> None:
        self.measurements = measurements
        self.losses = dict(losses)
        confidence = measurements.by_frame(measurements.confidence)
        self._camera_point = {
            name: _BoundLoss(loss, (confidence * loss.information(confidence)).flatten(1))
            for name, loss in losses.items()
            if isinstance(loss, CameraPointLoss)
        }
        self._pair = {k: v for k, v in losses.items() if isinstance(v, PairLoss) and len(measurements.pairs)}
        self._track = {k: v for k, v in losses.items() if isinstance(v, TrackLoss) and measurements.frames > 2}

    @property
    def couples_frames(self) -> bool:
        """Whether a loss ties one frame to another."""
        return bool(self._track)

    def terms(self, rotations: Tensor, translations: Tensor, points: Tensor) -> dict[str, Tensor]:
        """The value of every loss, differentiable, at cameras (C, 3, 3), (C, 3) and points (F, P, 3)."""
        m = self.measurements
        confidence = m.by_frame(m.confidence)
        keypoints = m.by_frame(m.pixels).movedim(1, -1).where(confidence[..., None] > 0, torch.nan)
        points = points.where(m.by_frame(m.active)[..., None], torch.nan)
        starts, ends = m.pairs.unbind(1)
        values: dict[str, Tensor] = {}
        for name, bound in self._camera_point.items():
            values[name] = bound.loss(points, rotations, translations, keypoints, m.cameras, confidence)
        for name, loss in self._pair.items():
            values[name] = loss(points[:, starts], points[:, ends], m.lengths_m)
        for name, loss in self._track.items():
            values[name] = loss(points)
        return values

    def linearise_chunk(self, state: State, columns: slice) -> dict[str, CameraPointTerms]:
        """The camera-point losses, linearised at a slice of the columns N."""
        m = self.measurements
        points_cam = state.in_cameras(columns)
        return {
            name: bound.loss.linearise(
                points_cam, state.rotations, m.pixels[:, :, columns], bound.information[:, columns], m.cameras
            )
            for name, bound in self._camera_point.items()
        }

    def linearise_pairs(self, state: State) -> dict[str, PairTerms]:
        """The pair losses, linearised."""
        if not self._pair:
            return {}
        m = self.measurements
        ends = m.by_frame(state.points)[..., m.pairs]
        difference = ends[..., 1] - ends[..., 0]
        return {name: loss.linearise(difference, m.lengths_m, m.pair_active) for name, loss in self._pair.items()}

    def linearise_tracks(self, state: State) -> dict[str, TrackTerms]:
        """The track losses, linearised."""
        if not self._track:
            return {}
        m = self.measurements
        active = m.by_frame(m.active)
        return {name: loss.linearise(m.by_frame(state.points), active) for name, loss in self._track.items()}
