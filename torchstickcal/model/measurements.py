"""What was measured, in the layout of the solvers: coordinates before points, the points of all frames side by side.

A solver's tensors are (B, C, k, N), (B, k, N) or (B, N): B sessions of equal shape, C cameras, and N = F P columns, the P
points of frame 0, then those of frame 1, and so on, so that a slice of frames is a slice of columns. One session is a batch of
one.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import overload

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchstickcal.geometry.cameras import Intrinsics
from torchstickcal.lazy import cached_property
from torchstickcal.model.state import State
from torchstickcal.model.unknowns import Columns, ImageMotion, RigUnknowns
from torchstickcal.observations import Observations
from torchstickcal.stick import point_index, scale_sticks
from torchstickcal.workers import map_with_idle_workers

_CHUNK_KEYPOINTS = {"cpu": 32_000, "cuda": 1_000_000}
"""Keypoints worked on at a time. What a CPU works on stays in its cache; elsewhere an operation should be worth its launch."""

LONG_KEYPOINTS = 1_000_000
"""Keypoints from which on a session is long: more than enough for everything that is found of it but its points."""


@dataclass(frozen=True)
class Measurements:
    """What is known: pixels, weights, cameras and sticks.

    Args:
        pixels: (B, C, 2, N), zero where not seen.
        confidence: (B, C, N), zero where not seen and at points fewer than two cameras see.
        cameras: intrinsics of the B sessions' C cameras.
        frames: F.
        sticks: (S, 2), the points that are the ends of a stick.
        lengths_m: (B, S), the sticks' lengths, metres.
        stick_sigma_m: (S,), the tolerances of these lengths, metres.
        unknowns: what is unknown of the cameras beside their poses.
        motion: of the keypoints, where clocks are among the unknowns.
        point_names: P names; None where the points have none.
    """

    pixels: Tensor
    confidence: Tensor
    cameras: Intrinsics
    frames: int
    sticks: Tensor
    lengths_m: Tensor
    stick_sigma_m: Tensor
    unknowns: RigUnknowns
    motion: ImageMotion | None = None
    point_names: tuple[str, ...] | None = None

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
        keypoints = observations.keypoints
        pixels = keypoints.new_empty(len(keypoints), 2, *visible.shape[1:], dtype=dtype)
        for own, seen, given in zip(pixels, visible, keypoints, strict=True):  # one camera's copy at a time
            own.copy_(torch.where(seen[..., None], given, 0.0).movedim(-1, 0))
        confidence = visible.to(dtype) if observations.confidence is None else observations.confidence.to(dtype)
        sticks = [s for s in scale_sticks(observations.sticks) if use is None or set(s.ends) <= set(use)]
        cameras = observations.cameras.batched()
        device = keypoints.device
        return Measurements(
            pixels=pixels.flatten(2)[None],
            confidence=torch.where(visible, confidence, 0.0).flatten(1)[None],
            cameras=cameras,
            frames=observations.num_frames,
            sticks=torch.tensor([s.ends for s in sticks], dtype=torch.long).view(-1, 2).to(device),
            lengths_m=torch.tensor([[s.between_m for s in sticks]], dtype=torch.float64).to(device),
            stick_sigma_m=torch.tensor([s.sigma_m for s in sticks], dtype=torch.float64).to(device),
            unknowns=RigUnknowns.of((), cameras),
            point_names=observations.point_names,
        )

    @staticmethod
    def stack(sessions: Sequence[Measurements]) -> Measurements:
        """Sessions of equal shape, with the same sticks and the same unknowns, as one batch."""
        if len(sessions) == 1:
            return sessions[0]
        first = sessions[0]
        cameras = Intrinsics(
            torch.cat([session.cameras.matrix for session in sessions]),
            _lenses([session.cameras for session in sessions]),
            first.cameras.fisheye,
        )
        pixels, confidence, lengths_m = (
            torch.cat([getattr(session, name) for session in sessions]) for name in ("pixels", "confidence", "lengths_m")
        )
        motions = [session.motion for session in sessions if session.motion is not None]
        return Measurements(
            pixels,
            confidence,
            cameras,
            first.frames,
            first.sticks,
            lengths_m,
            first.stick_sigma_m,
            RigUnknowns.stack([session.unknowns for session in sessions]),
            ImageMotion(*map(torch.cat, zip(*motions, strict=True))) if motions else None,
            first.point_names,
        )

    def __getitem__(self, sessions: slice) -> Measurements:
        """Some of the sessions."""
        return replace(
            self,
            pixels=self.pixels[sessions],
            confidence=self.confidence[sessions],
            cameras=self.cameras[sessions],
            lengths_m=self.lengths_m[sessions],
            unknowns=self.unknowns[sessions],
            motion=self.motion and ImageMotion(*(tensor[sessions] for tensor in self.motion)),
        )

    def detached(self) -> Measurements:
        """The same measurements without gradients."""
        lens = self.cameras.distortion
        return replace(
            self,
            pixels=self.pixels.detach(),
            confidence=self.confidence.detach(),
            cameras=replace(
                self.cameras, matrix=self.cameras.matrix.detach(), distortion=None if lens is None else lens.detach()
            ),
            lengths_m=self.lengths_m.detach(),
            unknowns=replace(self.unknowns, prior_sigma=self.unknowns.prior_sigma.detach()),
        )

    def within(self, window: slice | Tensor) -> Measurements:
        """The measurements of some frames."""
        columns = self.columns_of(window)
        return replace(
            self,
            pixels=self.pixels[..., columns],
            confidence=self.confidence[..., columns],
            frames=len(range(*window.indices(self.frames))) if isinstance(window, slice) else len(window),
            motion=self.motion and self.motion.at(columns),
        )

    @overload
    def columns_of(self, window: slice) -> slice: ...
    @overload
    def columns_of(self, window: Tensor) -> Tensor: ...
    def columns_of(self, window: slice | Tensor) -> Columns:
        """The columns of some frames: those of a slice one after another, or of any by their numbers."""
        if isinstance(window, Tensor):
            own = torch.arange(self.points_per_frame, device=self.pixels.device)
            return (self.points_per_frame * window.to(own)[:, None] + own).flatten()
        start, stop, _ = window.indices(self.frames)
        return slice(start * self.points_per_frame, stop * self.points_per_frame)

    def keeping(self, kept: Tensor) -> Measurements:
        """The measurements without the keypoints outside a mask (B, C, N), and without points left with a single view."""
        kept = kept & self.visible
        return replace(self, confidence=self.confidence.where(kept & (views_of(kept) >= 2).unsqueeze(-2), 0.0))

    def without_sticks(self) -> Measurements:
        """The same keypoints, of which no distance is known."""
        none = {"sticks": self.sticks[:0], "lengths_m": self.lengths_m[:, :0], "stick_sigma_m": self.stick_sigma_m[:0]}
        return replace(self, **none)

    def squared_residuals(self, state: State) -> Tensor:
        """Squared distances (B, C, N) between projections and keypoints, square pixels, times the keypoint's confidence.

        Infinite where a keypoint is not seen or its point lies behind the camera.
        """
        cameras, chunks = self.cameras_at(state), self.chunks()

        def squared(columns: slice) -> Tensor:
            residuals, depth = self._residuals(state, cameras, columns)
            confidence = self.confidence[..., columns]
            distance = residuals.square().sum(-2) * confidence
            return distance.where((confidence > 0) & (depth > 0), torch.inf)

        first = squared(chunks[0])
        if len(chunks) == 1:
            return first
        # Threads may not write into one tensor where that has a graph of gradients, which would not survive it.
        if first.requires_grad:
            return torch.cat([first, *map_with_idle_workers(squared, chunks[1:])], dim=-1)
        found = first.new_empty(self.confidence.shape)
        found[..., chunks[0]] = first

        def put(columns: slice) -> None:
            found[..., columns] = squared(columns)

        map_with_idle_workers(put, chunks[1:])
        return found

    def residuals(self, state: State) -> Iterator[tuple[slice, Tensor, Tensor]]:
        """Projections minus keypoints (B, C, 2, n), pixels, and the points' depths (B, C, n), metres, by chunks of columns."""
        for columns in self.chunks():
            yield columns, *self.residuals_at(state, columns)

    def residuals_at(self, state: State, columns: slice) -> tuple[Tensor, Tensor]:
        """The same of some columns."""
        return self._residuals(state, self.cameras_at(state), columns)

    def _residuals(self, state: State, cameras: Intrinsics, columns: slice) -> tuple[Tensor, Tensor]:
        x, y, z = state.in_cameras(columns, self.pixels.dtype).unbind(-2)
        return torch.stack(cameras.project_components(x, y, z), dim=-2) - self.pixels_at(state, columns), z

    def cameras_at(self, state: State) -> Intrinsics:
        """The cameras as a state has them, in the dtype of the pixels."""
        if not self.unknowns.count:
            return self._cameras_in_dtype
        return self.unknowns.applied(self.cameras, state.unknowns).to(self.pixels.dtype)

    def pixels_at(self, state: State, columns: Columns = slice(None)) -> Tensor:
        """Keypoints (B, C, 2, n) of some columns, on the clocks as a state has them."""
        motion = self.motion and self.motion.at(columns)
        return self.unknowns.displaced(self.pixels[..., columns], state.unknowns, motion)

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
    def stick_active(self) -> Tensor:
        """(B, F, S), True where both ends of a stick are active."""
        return self.by_frame(self.active)[..., self.sticks].all(-1)

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

    @property
    def is_long(self) -> bool:
        """Whether this is one session of so many keypoints that what there is one of for each of them should not be kept."""
        return self.sessions == 1 and are_many(self.num_cameras * self.num_columns)

    def point_index(self, name: str) -> int:
        """The index of a named point.

        Raises:
            ObservationError: if no point has the name.
        """
        return point_index(name, self.point_names)

    def chunks(self) -> list[slice]:
        """Slices of the columns, whole frames each, small enough to be worked on at a time."""
        most_frames = max(1, self.chunk_keypoints // max(1, self.sessions * self.num_cameras * self.points_per_frame))
        chunks = -(-self.frames // most_frames)
        width = self.points_per_frame * -(-self.frames // max(1, chunks))  # of equal size, for threads of equal speed
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
        ends = self.by_frame(points)[..., self.sticks]
        return (ends[..., 1] - ends[..., 0]).square().sum(1).sqrt().where(self.stick_active, torch.nan)

    def by_frame(self, columns: Tensor) -> Tensor:
        """A tensor (..., N) as (..., F, P)."""
        return columns.unflatten(-1, (self.frames, -1))


def are_many(keypoints: int) -> bool:
    """Whether so many keypoints make a session long."""
    return keypoints >= LONG_KEYPOINTS


def views_of(seen: Tensor) -> Tensor:
    """How many cameras see each point, (B, N), of a mask (B, C, N). The sum of a mask would first be a copy of it in int64."""
    return seen.view(torch.uint8).sum(-2, dtype=torch.int16)


def count_of(seen: Tensor) -> Tensor:
    """How many are True in each row of a mask (B, C, N), (B, C); without such a copy where rows are long."""
    if not are_many(seen.numel()):
        return seen.sum(-1)
    return torch.stack([row.count_nonzero() for row in seen.flatten(0, 1)]).view(seen.shape[:-1])


def _lenses(sessions: Sequence[Intrinsics]) -> Tensor | None:
    """Coefficients (B, C, D) of sessions (1, C, ...), as many as the longest lens model has, the others zero; None for none."""
    longest = max((cameras.distortion.shape[-1] for cameras in sessions if cameras.distortion is not None), default=0)
    empty = sessions[0].matrix.new_zeros(*sessions[0].matrix.shape[:-2], 0)
    given = [empty if cameras.distortion is None else cameras.distortion for cameras in sessions]
    return torch.cat([pad(lens, (0, longest - lens.shape[-1])) for lens in given]) if longest else None
