"""One session in the solvers' layout: float64, coordinates first, points of all frames side by side.

Everything a solver touches in its inner loop is a tensor (C, k, N) or (k, N), N = F P with the frame varying slowest, so
that a slice of frames is a contiguous slice of columns.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from torchstickcal import se3
from torchstickcal.cameras import Intrinsics
from torchstickcal.observations import Observations

_CHUNK_KEYPOINTS = 10900
"""Keypoints worked on at a time: three numbers of each stay below the size at which torch starts threads."""


@dataclass(frozen=True)
class Measurements:
    """What is known: pixels, weights, cameras and sticks.

    Args:
        pixels: (C, 2, N), zero where not seen.
        confidence: (C, N), zero where not seen and at points fewer than two cameras see.
        cameras: intrinsics of the C cameras.
        frames: F.
        pairs: (S, 2), the points that are ends of one stick.
        lengths_m: (S,), the sticks' lengths.
    """

    pixels: Tensor
    confidence: Tensor
    cameras: Intrinsics
    frames: int
    pairs: Tensor
    lengths_m: Tensor

    @staticmethod
    def of(observations: Observations, use: Collection[int] | None = None) -> Measurements:
        """The measurements of observations; ``use`` restricts them to some of the points."""
        keypoints = observations.keypoints.double()
        visible = observations.visible
        if use is not None:
            kept = torch.zeros(observations.num_points, dtype=torch.bool, device=visible.device)
            kept[list(use)] = True
            visible = visible & kept
        visible = visible & (visible.sum(0) >= 2)
        confidence = visible.double() if observations.confidence is None else observations.confidence.double()
        sticks = [s for s in observations.sticks if use is None or {s.start, s.end} <= set(use)]
        return Measurements(
            pixels=torch.where(visible[..., None], keypoints, 0.0).movedim(-1, 1).flatten(2).contiguous(),
            confidence=torch.where(visible, confidence, 0.0).flatten(1),
            cameras=observations.cameras,
            frames=observations.num_frames,
            pairs=torch.tensor([(s.start, s.end) for s in sticks], dtype=torch.long).view(-1, 2).to(keypoints.device),
            lengths_m=torch.tensor([s.length_m for s in sticks], dtype=torch.float64).to(keypoints.device),
        )

    def keeping(self, kept: Tensor) -> Measurements:
        """The measurements without the keypoints outside a mask (C, N), and without points left with a single view."""
        confidence = self.confidence * kept
        return replace(self, confidence=confidence * ((confidence > 0).sum(0) >= 2))

    def squared_residuals(self, state: State) -> Tensor:
        """Squared distances (C, N) between projections and keypoints, square pixels, times the keypoint's confidence.

        Infinite where a keypoint is not seen or its point lies behind the camera.
        """
        squared = torch.empty_like(self.confidence)
        for columns in self.chunks():
            x, y, z = state.in_cameras(columns).unbind(1)
            px, py = self.cameras.project_components(x, y, z)
            distance = (px - self.pixels[:, 0, columns]).square() + (py - self.pixels[:, 1, columns]).square()
            confidence = self.confidence[:, columns]
            squared[:, columns] = (distance * confidence).where((confidence > 0) & (z > 0), torch.inf)
        return squared

    @cached_property
    def visible(self) -> Tensor:
        """(C, N), True where a keypoint counts."""
        return self.confidence > 0

    @cached_property
    def active(self) -> Tensor:
        """(N,), True where two cameras or more see the point."""
        return self.visible.any(0)

    @cached_property
    def inactive_columns(self) -> Tensor:
        """Indices (K,) of the columns that are not active."""
        return (~self.active).nonzero()[:, 0]

    @cached_property
    def pair_active(self) -> Tensor:
        """(F, S), True where both ends of a stick are active."""
        return self.by_frame(self.active)[:, self.pairs].all(-1)

    @property
    def points_per_frame(self) -> int:
        """P"""
        return self.confidence.shape[1] // self.frames

    def chunks(self, columns: slice = slice(None)) -> list[slice]:
        """Slices of some of the columns, whole frames each, small enough for the arrays of one to stay in the cache."""
        cameras, total = self.confidence.shape
        first, last = columns.start or 0, total if columns.stop is None else columns.stop
        width = self.points_per_frame * max(1, _CHUNK_KEYPOINTS // (self.points_per_frame * cameras))
        return [slice(start, min(start + width, last)) for start in range(first, last, width)]

    def frame_slices(self) -> list[slice]:
        """The frames of each of :meth:`chunks`."""
        points = self.points_per_frame
        return [slice(columns.start // points, columns.stop // points) for columns in self.chunks()]

    def stick_lengths_m(self, points: Tensor) -> Tensor:
        """Lengths (F, S) of the sticks among points (3, N); NaN in frames where an end is not active."""
        ends = self.by_frame(points)[..., self.pairs]
        return (ends[..., 1] - ends[..., 0]).square().sum(0).sqrt().where(self.pair_active, torch.nan)

    def by_frame(self, columns: Tensor) -> Tensor:
        """A tensor (..., N) as (..., F, P)."""
        return columns.unflatten(-1, (self.frames, -1))


@dataclass(frozen=True)
class State:
    """The unknowns: rotations (C, 3, 3) and translations (C, 3) world to camera, points (3, N) in metres."""

    rotations: Tensor
    translations: Tensor
    points: Tensor

    def scaled(self, factor: float) -> State:
        """The same scene, ``factor`` times as large."""
        return replace(self, translations=self.translations * factor, points=self.points * factor)

    def retracted(self, camera_step: Tensor, point_step: Tensor) -> State:
        """The state after tangent steps (C - 1, 6) of all cameras but the first, or (0, 6), and steps (3, N) of the points."""
        rotations, translations = self.rotations, self.translations
        if len(camera_step):
            moved = se3.retract(rotations[1:], translations[1:], camera_step)
            rotations, translations = torch.cat([rotations[:1], moved[0]]), torch.cat([translations[:1], moved[1]])
        return State(rotations, translations, self.points + point_step)

    def in_cameras(self, columns: slice = slice(None)) -> Tensor:
        """The points in every camera's frame, (C, 3, N)."""
        return self.rotations @ self.points[:, columns] + self.translations[..., None]
