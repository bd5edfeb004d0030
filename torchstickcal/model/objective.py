"""The objective: the losses of a stage, applied to one batch of sessions.

Its value comes in two forms that the tests hold equal: as scalars that autograd can differentiate, for LBFGS and training
loops, and linearised block by block, for Gauss-Newton.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeVar

import torch
from torch import Tensor

from torchstickcal.geometry import se3
from torchstickcal.geometry.cameras import Intrinsics, PixelMap
from torchstickcal.geometry.symmetric import IDENTITY, inverse_diagonal
from torchstickcal.inference import differentiates, ordinary
from torchstickcal.lazy import cached_property
from torchstickcal.losses import CameraPointLoss, FrameLoss, Loss, TrackLoss
from torchstickcal.losses.camera_point import CameraPointSlopes, CameraPointTerms, UnknownTerms
from torchstickcal.losses.frame import FrameTerms
from torchstickcal.losses.track import TrackTerms
from torchstickcal.model.measurements import Measurements
from torchstickcal.model.state import State
from torchstickcal.model.unknowns import Columns, ImageMotion, RigUnknowns
from torchstickcal.workers import map_with_idle_workers

PRIOR = "prior"
"""Name of the term that keeps the further unknowns of the cameras near what was given."""

_Kind = TypeVar("_Kind", bound=Loss)


class Objective:
    """The weighted sum of named losses over a batch of sessions.

    Args:
        measurements: the sessions.
        losses: the losses by name; their weights and standard deviations are their own.
    """

    def __init__(self, measurements: Measurements, losses: Mapping[str, Loss]) -> None:
        self.measurements = measurements
        self.losses = dict(losses)
        self._camera_point = self._of_kind(CameraPointLoss)
        frame = self._of_kind(FrameLoss)
        points = measurements.points_per_frame
        self.groups = {name: loss.checked_groups(measurements.sticks, points) for name, loss in frame.items()}
        """the points (G, k) that each frame loss couples"""
        self._frame = {name: loss for name, loss in frame.items() if len(self.groups[name])}
        self._track = {n: loss for n, loss in self._of_kind(TrackLoss).items() if len(loss.stencil) <= measurements.frames}
        self._information = {name: self._by_column(loss) for name, loss in self._camera_point.items()}

    def __getitem__(self, sessions: slice) -> Objective:
        """The objective of some of the sessions."""
        return Objective(self.measurements[sessions], {name: loss.of(sessions) for name, loss in self.losses.items()})

    def within(self, window: slice) -> Objective:
        """The objective of some frames. What couples them with others is no part of it."""
        frames = self.measurements.frames
        losses = {n: loss.within(window, frames) if isinstance(loss, TrackLoss) else loss for n, loss in self.losses.items()}
        return Objective(self.measurements.within(window), losses)

    def information_of(self, name: str) -> Tensor:
        """1 / sigma^2 of a camera-point loss at every column, (1 | B, 1, N)."""
        return self._information[name]

    @property
    def track_losses(self) -> dict[str, TrackLoss]:
        """The losses that couple consecutive frames."""
        return self._track

    @cached_property
    def clusters(self) -> list[tuple[int, ...]]:
        """The points of one frame that losses couple with one another, directly or through others; two or more each."""
        cluster_of = {point: {point} for point in range(self.measurements.points_per_frame)}
        for name in self._frame:
            for group in self.groups[name].tolist():
                together = set().union(*(cluster_of[point] for point in group))
                for point in together:
                    cluster_of[point] = together
        found = {min(cluster): tuple(sorted(cluster)) for cluster in cluster_of.values() if len(cluster) > 1}
        return [found[first] for first in sorted(found)]

    def terms(self, state: State) -> dict[str, Tensor]:
        """The value of every loss at a state, summed over the sessions, differentiable by the state and the measurements."""
        m = self.measurements
        cameras = m.unknowns.applied(m.cameras, state.unknowns)
        confidence = m.by_frame(m.confidence)
        keypoints = m.by_frame(m.pixels_at(state)).movedim(2, -1).where(confidence[..., None] > 0, torch.nan)
        points = m.by_frame(state.points).movedim(1, -1).where(m.by_frame(m.active)[..., None], torch.nan)
        values: dict[str, Tensor] = {}
        for name, loss in self._camera_point.items():
            values[name] = loss(points, state.rotations, state.translations, keypoints, cameras, confidence)
        for name, loss in self._frame.items():
            values[name] = loss.of_session(points, m.sticks, m.lengths_m[:, None])
        for name, loss in self._track.items():
            values[name] = loss(points)
        if m.unknowns.count:
            values[PRIOR] = (state.unknowns / m.unknowns.prior_sigma).square().sum()
        return values

    def slope(self, state: State, camera_step: Tensor, point_step: Tensor, unknown_step: Tensor) -> Tensor:
        """Half the derivative of the objective along a step from a state, differentiable by measurements and state.

        Args:
            state: where.
            camera_step: (B, C, 6), tangents.
            point_step: (B, 3, N).
            unknown_step: (B, K), of what else is unknown of the cameras.
        """
        by_images = self.slope_of_images(state, camera_step, point_step, unknown_step, slice(0, self.measurements.num_columns))
        return by_images + self.slope_of_scene(state, point_step, unknown_step)

    def slope_of_images(
        self, state: State, camera_step: Tensor, point_step: Tensor, unknown_step: Tensor, columns: slice
    ) -> Tensor:
        """The part of :meth:`slope` that some columns have through the losses of camera and point."""
        m = self.measurements
        turned = se3.moved(se3.hat(camera_step[..., 3:]), camera_step[..., :3], state.points[..., columns])
        points_cam, moved_cam = state.in_cameras(columns), state.rotations @ (point_step[:, None, :, columns] + turned)
        at = self._unknowns_at(state, columns)
        step = m.unknowns.by_camera(unknown_step)
        total = state.points.new_zeros(())
        for name, loss in self._camera_point.items():
            information = m.confidence[..., columns] * self._information[name][..., columns]
            loss = loss.of_columns(columns, m.points_per_frame)
            total = total + loss.slope(points_cam, moved_cam, at.pixels, information, at.cameras, at.if_any, step)
        return total

    def slope_of_scene(self, state: State, point_step: Tensor, unknown_step: Tensor) -> Tensor:
        """The part of :meth:`slope` by the other losses and the prior."""
        m = self.measurements
        total = (state.unknowns * unknown_step / m.unknowns.prior_sigma.square()).sum()
        points, point_step, active = m.by_frame(state.points), m.by_frame(point_step), m.by_frame(m.active)
        for loss in self._frame.values():
            total = total + loss.slope(points, point_step, m.sticks, m.lengths_m[:, None], active)
        for loss in self._track.values():
            total = total + loss.slope(points, point_step, active)
        return total

    def point_variance(self, state: State) -> Tensor:
        """Variance of each point for known cameras and without track losses, mean over the three axes, (B, N), square metres.

        Couplings between points are ignored. It is that of the normal equations, differentiable by measurements and state; zero
        where a point is not known.
        """
        by_chunk = map_with_idle_workers(lambda columns: self._point_variance(state, columns), self.measurements.chunks())
        return torch.cat(by_chunk, dim=-1)

    def _point_variance(self, state: State, columns: slice) -> Tensor:
        """That of the points of some frames' columns n, (B, n); differentiable."""
        m, information = self.measurements, self._image_information(state, columns)
        points, active = (tensor[..., columns].unflatten(-1, (-1, m.points_per_frame)) for tensor in (state.points, m.active))
        for loss in self._frame.values():
            own = loss.point_information(points, m.sticks, m.lengths_m[:, None], active)
            information = information + own.flatten(-2)
        known = m.active[:, columns]
        identity = information.new_tensor(IDENTITY)[:, None]
        return inverse_diagonal(torch.where(known[:, None], information, identity)).mean(1).where(known, 0.0)

    def _image_information(self, state: State, columns: slice) -> Tensor:
        """What the camera-point losses know of the points of some columns n, (B, 6, n); differentiable."""
        m, at = self.measurements, self._unknowns_at(state, columns)
        points_cam = state.in_cameras(columns)
        information = torch.zeros_like(points_cam[:, 0, :1]).expand(-1, 6, -1)
        for name, loss in self._camera_point.items():
            own = m.confidence[..., columns] * self._information[name][..., columns]
            loss = loss.of_columns(columns, m.points_per_frame)
            information = information + loss.point_information(points_cam, state.rotations, at.pixels, own, at.cameras)
        return information

    def linearise_chunk(
        self, state: State, columns: Columns, exact: bool = False, by_unknowns: bool = True
    ) -> dict[str, CameraPointTerms]:
        """The camera-point losses, linearised at some of the columns N, if wanted also by the cameras' further unknowns."""
        m = self.measurements
        at, confidence = self._unknowns_at(state, columns), m.confidence[..., columns]
        points_cam, rotations = state.in_cameras(columns, at.pixels.dtype), state.rotations.to(at.pixels.dtype)
        unknowns = at.if_any if by_unknowns else None
        found: dict[str, CameraPointTerms] = {}
        for name, loss in self._camera_point.items():
            information = confidence * self._information[name][..., columns]
            further = None if exact else unknowns
            loss = loss.of_columns(columns, m.points_per_frame)
            terms = loss.linearise(points_cam, rotations, at.pixels, information, at.cameras, exact, further)
            if unknowns is not None and exact:
                terms = terms._replace(unknown=self._exact_by_unknowns(loss, state, columns, information))
            found[name] = terms
        return found

    def slopes_of_chunk(
        self, state: State, columns: Columns, by_unknowns: bool = True, dtype: torch.dtype | None = None
    ) -> dict[str, CameraPointSlopes]:
        """The first derivatives of the camera-point losses at some of the columns; the arguments are as above.

        Args:
            state: where.
            columns: the columns.
            by_unknowns: whether also those by the cameras' further unknowns.
            dtype: in which they are computed; None for that of the keypoints.
        """
        m = self.measurements
        at, confidence = self._unknowns_at(state, columns), m.confidence[..., columns]
        dtype = at.pixels.dtype if dtype is None else dtype
        points_cam, rotations = state.in_cameras(columns, dtype), state.rotations.to(dtype)
        found: dict[str, CameraPointSlopes] = {}
        for name, loss in self._camera_point.items():
            information = confidence * self._information[name][..., columns]
            loss = loss.of_columns(columns, m.points_per_frame)
            unknowns = at.if_any if by_unknowns else None
            found[name] = loss.slopes(points_cam, rotations, at.pixels, information, at.cameras, unknowns)
        return found

    @differentiates
    def _exact_by_unknowns(self, loss: CameraPointLoss, state: State, columns: Columns, information: Tensor) -> UnknownTerms:
        """A loss's terms with the exact Hessian at columns of information (B, C, n): the slope's derivatives, by autograd."""
        m = self.measurements
        points_cam = state.in_cameras(columns).detach().requires_grad_()
        at = ordinary(self._unknowns_at(state, columns))
        deviations = torch.zeros_like(m.unknowns.by_camera(state.unknowns)).requires_grad_()
        step = torch.zeros_like(deviations).requires_grad_()
        # copies: an unknown of a user may write into its own copy of a matrix
        with torch.autograd.graph.saved_tensors_hooks(Tensor.clone, lambda saved: saved):
            moved = at.at(deviations)
            still = torch.zeros_like(points_cam)
            slope = loss.slope(points_cam, still, moved.pixels, information, moved.cameras, moved, step)
            (gradient,) = torch.autograd.grad(slope, step, create_graph=True)
            rows = [torch.autograd.grad(row.sum(), (deviations, points_cam), retain_graph=True) for row in gradient.unbind(-1)]
        hessian, by_points = (torch.stack(of, dim=2) for of in zip(*rows, strict=True))
        by_points = (state.rotations.mT.unsqueeze(2) @ by_points).to(information.dtype)
        return UnknownTerms(gradient.detach(), hessian, by_points)

    def linearise_prior(self, state: State) -> tuple[Tensor, Tensor, Tensor]:
        """The prior of the cameras' further unknowns: its value (B,), half its gradient (B, K), and its information (B, K)."""
        information = self.measurements.unknowns.prior_sigma.square().reciprocal()
        return (information * state.unknowns.square()).sum(1), information * state.unknowns, information

    def linearise_frames(self, state: State, exact: bool = False) -> dict[str, FrameTerms]:
        """The frame losses, linearised."""
        m = self.measurements
        arguments = m.by_frame(state.points), m.sticks, m.lengths_m[:, None], m.by_frame(m.active), exact
        return {name: loss.linearise(*arguments) for name, loss in self._frame.items()}

    def linearise_tracks(self, state: State) -> dict[str, TrackTerms]:
        """The track losses, linearised."""
        m = self.measurements
        arguments = m.by_frame(state.points), m.by_frame(m.active)
        return {name: loss.linearise(*arguments) for name, loss in self._track.items()}

    def _unknowns_at(self, state: State, columns: Columns = slice(None)) -> _UnknownsAt:
        m = self.measurements
        motion = m.motion and m.motion.at(columns)
        return _UnknownsAt(m.unknowns, m.cameras_at(state), m.pixels_at(state, columns), motion)

    def _of_kind(self, kind: type[_Kind]) -> dict[str, _Kind]:
        return {name: loss for name, loss in self.losses.items() if isinstance(loss, kind)}

    def _by_column(self, loss: Loss) -> Tensor:
        """1 / sigma^2 of a loss (1 | B, 1, N) at every column."""
        m = self.measurements
        information = loss.information(m.confidence)
        shape = (*information.shape[:1], 1) if information.ndim == 4 else (1, 1)
        return information.reshape(*shape, 1, -1).expand(*shape, m.frames, m.points_per_frame).flatten(2)


@dataclass(frozen=True)
class _UnknownsAt:
    """The cameras' further unknowns at their present values, as losses look at them."""

    unknowns: RigUnknowns
    cameras: Intrinsics
    """as they are at the present values"""
    pixels: Tensor
    """keypoints (B, C, 2, n), likewise"""
    motion: ImageMotion | None

    @property
    def components(self) -> int:
        return self.unknowns.components

    @property
    def if_any(self) -> _UnknownsAt | None:
        """None where nothing but the poses is unknown."""
        return self if self.unknowns.count else None

    def projection_derivatives(self, u: Tensor, v: Tensor, pixel: PixelMap) -> tuple[Tensor, Tensor]:
        return self.unknowns.projection_derivatives(u, v, pixel, self.cameras, self.motion)

    def moved(self, deviations: Tensor) -> tuple[Intrinsics, Tensor]:
        moved = self.at(deviations)
        return moved.cameras, moved.pixels

    def at(self, deviations: Tensor) -> _UnknownsAt:
        """The same at deviations (B, C, k) from the present values."""
        cameras = self.unknowns.applied_by_camera(self.cameras, deviations)
        pixels = self.pixels
        if self.motion is not None:
            delays = self.unknowns.delays_by_camera(self.motion.row, deviations)
            pixels = pixels - self.motion.velocity * delays.unsqueeze(-2)
        return _UnknownsAt(self.unknowns, cameras, pixels, self.motion)
