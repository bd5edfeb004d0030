"""Sessions in the solvers' layout: coordinates before points, points of all frames side by side.

Everything a solver touches in its inner loop is a tensor (B, C, k, N), (B, k, N) or (B, N): B sessions of equal shape, C
cameras, N = F P columns with the frame varying slowest, so that a slice of frames is a contiguous slice of columns. One session
is a batch of one.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property

import torch
from torch import Tensor

from torchstickcal.geometry import se3
from torchstickcal.geometry.cameras import Intrinsics
from torchstickcal.model.unknowns import CameraUnknowns, Columns, ImageMotion
from torchstickcal.observations import Observations

_CHUNK_KEYPOINTS = {"cpu": 32_000, "cuda": 1_000_000}
"""Keypoints worked on at a time. What a CPU works on stays in its cache; elsewhere an operation should be worth its launch."""


@dataclass(frozen=True)
class Measurements:
    """What is known: pixels, weights, cameras and sticks.

    Args:
        pixels: (B, C, 2, N), zero where not seen.
        confidence: (B, C, N), zero where not seen and at points fewer than two cameras see.
        cameras: intrinsics of the B sessions' C cameras.
        frames: F.
        pairs: (S, 2), the points that are ends of one stick.
        lengths_m: (B, S), the sticks' lengths.
        unknowns: what is not known of the cameras beside their poses; None where that is nothing.
        motion: of the keypoints, where clocks are among the unknowns.
    """

    pixels: Tensor
    confidence: Tensor
    cameras: Intrinsics
    frames: int
    pairs: Tensor
    lengths_m: Tensor
    unknowns: CameraUnknowns | None = None
    motion: ImageMotion | None = None

    @staticmethod
    def of(observations: Observations, use: Collection[int] | None = None, dtype: torch.dtype = torch.float64) -> Measurements:
        """The measurements of one session.

        Args:
            observations: the session.
            use: the points that take part; None for all.
            dtype: of everything that there is one of per keypoint.
        """
        visible = observations.visible
        if use is not None:
            kept = torch.zeros(observations.num_points, dtype=torch.bool, device=visible.device)
            kept[list(use)] = True
            visible = visible & kept
        visible = visible & (visible.sum(0) >= 2)
        keypoints = observations.keypoints.to(dtype)
        confidence = visible.to(dtype) if observations.confidence is None else observations.confidence.to(dtype)
        sticks = [s for s in observations.sticks if use is None or {s.start, s.end} <= set(use)]
        return Measurements(
            pixels=torch.where(visible[..., None], keypoints, 0.0).movedim(-1, 1).flatten(2).contiguous()[None],
            confidence=torch.where(visible, confidence, 0.0).flatten(1)[None],
            cameras=observations.cameras.batched(),
            frames=observations.num_frames,
            pairs=torch.tensor([(s.start, s.end) for s in sticks], dtype=torch.long).view(-1, 2).to(keypoints.device),
            lengths_m=torch.tensor([[s.length_m for s in sticks]], dtype=torch.float64).to(keypoints.device),
        )

    @staticmethod
    def stack(sessions: Sequence[Measurements]) -> Measurements:
        """Sessions of equal shape, with the same sticks and the same unknowns, as one batch."""
        if len(sessions) == 1:
            return sessions[0]
        first = sessions[0]
        lenses = [session.cameras.distortion for session in sessions]
        some = next((lens for lens in lenses if lens is not None), None)
        cameras = Intrinsics(
            torch.cat([session.cameras.matrix for session in sessions]),
            None if some is None else torch.cat([torch.zeros_like(some) if lens is None else lens for lens in lenses]),
            first.cameras.fisheye,
        )
        pixels, confidence, lengths_m = (
            torch.cat([getattr(session, name) for session in sessions]) for name in ("pixels", "confidence", "lengths_m")
        )
        unknowns = [session.unknowns for session in sessions if session.unknowns is not None]
        motions = [session.motion for session in sessions if session.motion is not None]
        return Measurements(
            pixels,
            confidence,
            cameras,
            first.frames,
            first.pairs,
            lengths_m,
            CameraUnknowns.stack(unknowns) if unknowns else None,
            ImageMotion(*map(torch.cat, zip(*motions, strict=True))) if motions else None,
        )

    def __getitem__(self, sessions: slice) -> Measurements:
        """Some of the sessions."""
        return replace(
            self,
            pixels=self.pixels[sessions],
            confidence=self.confidence[sessions],
            cameras=self.cameras[sessions],
            lengths_m=self.lengths_m[sessions],
            unknowns=self.unknowns and self.unknowns[sessions],
            motion=self.motion and ImageMotion(*(tensor[sessions] for tensor in self.motion)),
        )

    def within(self, window: slice) -> Measurements:
        """The measurements of some frames."""
        columns = self.columns_of(window)
        return replace(
            self,
            pixels=self.pixels[..., columns],
            confidence=self.confidence[..., columns],
            frames=len(range(*window.indices(self.frames))),
            motion=self.motion and self.motion.at(columns),
        )

    def columns_of(self, window: slice) -> slice:
        """The columns of some frames, one after another."""
        start, stop, _ = window.indices(self.frames)
        return slice(start * self.points_per_frame, stop * self.points_per_frame)

    def keeping(self, kept: Tensor) -> Measurements:
        """The measurements without the keypoints outside a mask (B, C, N), and without points left with a single view."""
        confidence = self.confidence * kept
        return replace(self, confidence=confidence.mul_((confidence > 0).sum(-2, keepdim=True) >= 2))

    def squared_residuals(self, state: State) -> Tensor:
        """Squared distances (B, C, N) between projections and keypoints, square pixels, times the keypoint's confidence.

        Infinite where a keypoint is not seen or its point lies behind the camera.
        """
        squared = torch.empty_like(self.confidence)
        for columns, residuals, depth in self.residuals(state):
            confidence = self.confidence[..., columns]
            distance = residuals.square().sum(-2) * confidence
            squared[..., columns] = distance.where((confidence > 0) & (depth > 0), torch.inf)
        return squared

    def residuals(self, state: State) -> Iterator[tuple[slice, Tensor, Tensor]]:
        """Projections minus keypoints (B, C, 2, n), pixels, and the points' depths (B, C, n), metres, by chunks of columns."""
        cameras = self.cameras_at(state)
        for columns in self.chunks():
            x, y, z = state.in_cameras(columns, self.pixels.dtype).unbind(-2)
            yield columns, torch.stack(cameras.project_components(x, y, z), dim=-2) - self.pixels_at(state, columns), z

    def cameras_at(self, state: State) -> Intrinsics:
        """The cameras as a state has them, in the dtype of the pixels."""
        if self.unknowns is None or state.unknowns is None:
            return self._cameras_in_dtype
        return self.unknowns.applied(self.cameras, state.unknowns).to(self.pixels.dtype)

    def pixels_at(self, state: State, columns: Columns = slice(None)) -> Tensor:
        """Keypoints (B, C, 2, n) of some columns, on the clocks as a state has them."""
        pixels = self.pixels[..., columns]
        if self.unknowns is None or state.unknowns is None or self.motion is None:
            return pixels
        return self.unknowns.displaced(pixels, state.unknowns, self.motion.at(columns))

    @cached_property
    def _cameras_in_dtype(self) -> Intrinsics:
        return self.cameras.to(self.pixels.dtype)

    @cached_property
    def visible(self) -> Tensor:
        """(B, C, N), True where a keypoint counts."""
        return self.confidence > 0

    @cached_property
    def active(self) -> Tensor:
        """(B, N), True where two cameras or more see the point."""
        return self.visible.any(-2)

    @cached_property
    def pair_active(self) -> Tensor:
        """(B, F, S), True where both ends of a stick are active."""
        return self.by_frame(self.active)[..., self.pairs].all(-1)

    @property
    def sessions(self) -> int:
        """B"""
        return self.confidence.shape[0]

    @property
    def num_cameras(self) -> int:
        """C"""
        return self.confidence.shape[1]

    @property
    def num_columns(self) -> int:
        """N"""
        return self.confidence.shape[2]

    @property
    def points_per_frame(self) -> int:
        """P"""
        return self.num_columns // self.frames

    def chunks(self) -> list[slice]:
        """Slices of the columns, whole frames each, small enough to be worked on at a time."""
        keypoints_per_frame = self.sessions * self.num_cameras * self.points_per_frame
        width = self.points_per_frame * max(1, self.chunk_keypoints // keypoints_per_frame)
        return [slice(start, min(start + width, self.num_columns)) for start in range(0, self.num_columns, width)]

    @property
    def chunk_keypoints(self) -> int:
        """Keypoints worked on at a time."""
        return _CHUNK_KEYPOINTS["cpu" if self.pixels.device.type == "cpu" else "cuda"]

    def frame_slices(self) -> list[slice]:
        """The frames of each of :meth:`chunks`."""
        points = self.points_per_frame
        return [slice(columns.start // points, columns.stop // points) for columns in self.chunks()]

    def stick_lengths_m(self, points: Tensor) -> Tensor:
        """Lengths (B, F, S) of the sticks among points (B, 3, N); NaN in frames where an end is not active."""
        ends = self.by_frame(points)[..., self.pairs]
        return (ends[..., 1] - ends[..., 0]).square().sum(1).sqrt().where(self.pair_active, torch.nan)

    def by_frame(self, columns: Tensor) -> Tensor:
        """A tensor (..., N) as (..., F, P)."""
        return columns.unflatten(-1, (self.frames, -1))


@dataclass(frozen=True)
class State:
    """What is looked for, in float64.

    Args:
        rotations: (B, C, 3, 3), world to camera.
        translations: (B, C, 3), world to camera, metres.
        points: (B, 3, N), metres.
        unknowns: (B, K), values of the measurements' further unknowns; None for cameras as given.
    """

    rotations: Tensor
    translations: Tensor
    points: Tensor
    unknowns: Tensor | None = None

    @staticmethod
    def stack(states: Sequence[State]) -> State:
        """The states of several sessions as those of one batch."""
        return _each(lambda *tensors: torch.cat(tensors), *states)

    def __getitem__(self, sessions: slice) -> State:
        """Those of some of the sessions."""
        return _each(lambda tensor: tensor[sessions], self)

    def replaced(self, where: Tensor, other: State) -> State:
        """The state with some sessions (B,), True where, taken from another."""
        return _each(lambda mine, theirs: torch.where(where.view(-1, *[1] * (mine.ndim - 1)), theirs, mine), self, other)

    def scaled(self, factors: Tensor) -> State:
        """The same scenes, each its factor (B,) times as large."""
        factor = factors[:, None, None]
        return replace(self, translations=self.translations * factor, points=self.points * factor)

    def retracted(self, camera_step: Tensor, point_step: Tensor, unknown_step: Tensor | None = None) -> State:
        """The state after a step.

        Args:
            camera_step: tangents (B, C - 1, 6) of all cameras but the first, or (B, 0, 6).
            point_step: (B, 3, N).
            unknown_step: (B, K), or (B, 0) for none.
        """
        rotations, translations, unknowns = self.rotations, self.translations, self.unknowns
        if camera_step.shape[1]:
            moved = se3.retract(rotations[:, 1:], translations[:, 1:], camera_step)
            rotations = torch.cat([rotations[:, :1], moved[0]], dim=1)
            translations = torch.cat([translations[:, :1], moved[1]], dim=1)
        if unknown_step is not None and unknown_step.shape[1]:
            unknowns = unknown_step if unknowns is None else unknowns + unknown_step
        return State(rotations, translations, self.points + point_step, unknowns)

    def in_cameras(self, columns: Columns = slice(None), dtype: torch.dtype = torch.float64) -> Tensor:
        """The points in every camera's frame, (B, C, 3, N), computed in float64 and then rounded."""
        return se3.moved(self.rotations, self.translations, self.points[..., columns]).to(dtype)


def _each(function: Callable[..., Tensor], *states: State) -> State:
    """A state made of others, tensor by tensor."""
    tensors = [[getattr(state, field.name) for state in states] for field in fields(State)]
    return State(*(None if of[0] is None else function(*of) for of in tensors))  # pyright: ignore[reportArgumentType]
