"""The objective: the losses of a stage, bound to one batch of sessions.

It can be asked for its value in two ways that the tests hold equal: as scalars through autograd, for LBFGS and training
loops, and linearised block by block, for the Gauss-Newton solver.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import TypeVar

import torch
from torch import Tensor

from torchstickcal.geometry import se3
from torchstickcal.losses import CameraPointLoss, Loss, PairLoss, TrackLoss
from torchstickcal.losses.base import CameraPointTerms, PairTerms, TrackTerms, UnknownTerms
from torchstickcal.model.measurements import Measurements, State
from torchstickcal.model.unknowns import CameraUnknowns, Columns

PRIOR = "prior"
"""Name of the term that holds the cameras' further unknowns to what was given."""

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
        self._pair = self._of_kind(PairLoss) if len(measurements.pairs) else {}
        self._track = self._of_kind(TrackLoss) if measurements.frames > 2 else {}
        self._information = {name: self._by_column(loss) for name, loss in self._camera_point.items()}

    def __getitem__(self, sessions: slice) -> Objective:
        """The objective of some of the sessions."""
        return Objective(self.measurements[sessions], {name: loss.of(sessions) for name, loss in self.losses.items()})

    @property
    def couples_frames(self) -> bool:
        """Whether a loss ties one frame to another."""
        return bool(self._track)

    def terms(
        self, rotations: Tensor, translations: Tensor, points: Tensor, unknowns: Tensor | None = None
    ) -> dict[str, Tensor]:
        """The value of every loss, summed over the sessions, differentiable.

        Args:
            rotations: (B, C, 3, 3).
            translations: (B, C, 3).
            points: (B, F, P, 3).
            unknowns: (B, K), what else is unknown of the cameras; None for cameras as given.
        """
        m = self.measurements
        cameras, pixels = m.cameras, m.pixels
        if m.unknowns is not None and unknowns is not None:
            cameras = m.unknowns.applied(cameras, unknowns)
            pixels = m.unknowns.displaced(pixels, unknowns, m.motion)
        confidence = m.by_frame(m.confidence)
        keypoints = m.by_frame(pixels).movedim(2, -1).where(confidence[..., None] > 0, torch.nan)
        points = points.where(m.by_frame(m.active)[..., None], torch.nan)
        starts, ends = m.pairs.unbind(1)
        values: dict[str, Tensor] = {}
        for name, loss in self._camera_point.items():
            values[name] = loss(points, rotations, translations, keypoints, cameras, confidence)
        for name, loss in self._pair.items():
            values[name] = loss(points[..., starts, :], points[..., ends, :], m.lengths_m[:, None])
        for name, loss in self._track.items():
            values[name] = loss(points)
        if m.unknowns is not None and unknowns is not None:
            values[PRIOR] = (unknowns / m.unknowns.prior_sigma).square().sum()
        return values

    def slope(self, state: State, camera_step: Tensor, point_step: Tensor, unknown_step: Tensor | None = None) -> Tensor:
        """Half the derivative of the objective along a step from a state, differentiable by measurements and state.

        Args:
            state: where.
            camera_step: (B, C, 6), tangents.
            point_step: (B, 3, N).
            unknown_step: (B, K), of what else is unknown of the cameras; None where it stays as it is.
        """
        m = self.measurements
        moved = point_step[:, None] + se3.moved(se3.hat(camera_step[..., 3:]), camera_step[..., :3], state.points)
        points_cam, moved_cam = state.in_cameras(), state.rotations @ moved
        cameras, pixels, image_step = m.cameras_at(state), m.pixels_at(state), None
        total = points_cam.new_zeros(())
        if m.unknowns is not None and unknown_step is not None:
            image_step = partial(m.unknowns.moved, cameras=cameras, motion=m.motion, step=unknown_step)
            total = total + (_values(state, m.unknowns) * unknown_step / m.unknowns.prior_sigma.square()).sum()
        for name, loss in self._camera_point.items():
            information = m.confidence * self._information[name]
            total = total + loss.slope(points_cam, moved_cam, pixels, information, cameras, image_step)
        for loss in self._pair.values():
            difference, moved_ends = self._differences(state.points), self._differences(point_step)
            total = total + loss.slope(difference, moved_ends, m.lengths_m[:, None], m.pair_active)
        for loss in self._track.values():
            total = total + loss.slope(m.by_frame(state.points), m.by_frame(point_step), m.by_frame(m.active))
        return total

    def linearise_chunk(
        self, state: State, columns: Columns, exact: bool = False, by_unknowns: bool = True
    ) -> dict[str, CameraPointTerms]:
        """The camera-point losses, linearised at some of the columns N, if wanted by the cameras' further unknowns too."""
        m = self.measurements
        pixels, confidence = m.pixels_at(state, columns), m.confidence[..., columns]
        points_cam, rotations = state.in_cameras(columns, pixels.dtype), state.rotations.to(pixels.dtype)
        cameras, further = m.cameras_at(state), None
        unknowns = m.unknowns if by_unknowns else None
        if unknowns is not None and not exact:
            further = partial(unknowns.columns, cameras=cameras, motion=m.motion and m.motion.at(columns))
        found: dict[str, CameraPointTerms] = {}
        for name, loss in self._camera_point.items():
            information = confidence * self._information[name][..., columns]
            terms = loss.linearise(points_cam, rotations, pixels, information, cameras, exact, further)
            if unknowns is not None and exact:
                terms = terms._replace(unknown=self._exact_by_unknowns(loss, unknowns, state, columns, information))
            found[name] = terms
        return found

    @torch.enable_grad()
    def _exact_by_unknowns(
        self, loss: CameraPointLoss, unknowns: CameraUnknowns, state: State, columns: Columns, information: Tensor
    ) -> UnknownTerms:
        """A loss's terms with the exact Hessian at columns of information (B, C, n): the slope's derivatives, by autograd."""
        m = self.measurements
        each, motion = unknowns.unshared(), m.motion and m.motion.at(columns)
        if motion is not None:
            motion = motion._replace(reckoned=unknowns.by_camera(motion.reckoned).flatten(1))
        points_cam = state.in_cameras(columns).detach().requires_grad_()
        values = unknowns.by_camera(_values(state, unknowns)).detach().requires_grad_()
        step = torch.zeros_like(values).requires_grad_()
        cameras = each.applied(m.cameras, values.flatten(1))
        pixels = each.displaced(m.pixels[..., columns], values.flatten(1), motion)
        image_step = partial(each.moved, cameras=cameras, motion=motion, step=step.flatten(1))
        slope = loss.slope(points_cam, torch.zeros_like(points_cam), pixels, information, cameras, image_step)
        (gradient,) = torch.autograd.grad(slope, step, create_graph=True)
        rows = [torch.autograd.grad(row.sum(), (values, points_cam), retain_graph=True) for row in gradient.unbind(-1)]
        hessian, by_points = (torch.stack(of, dim=2) for of in zip(*rows, strict=True))
        return UnknownTerms(gradient.detach(), hessian, state.rotations.mT.unsqueeze(2) @ by_points)

    def linearise_prior(self, state: State) -> tuple[Tensor, Tensor, Tensor] | None:
        """The prior of the cameras' further unknowns: its value (B,), half its gradient (B, K), and its information (B, K)."""
        unknowns = self.measurements.unknowns
        if unknowns is None:
            return None
        information = unknowns.prior_sigma.square().reciprocal()
        values = _values(state, unknowns)
        return (information * values.square()).sum(1), information * values, information

    def linearise_pairs(self, state: State, exact: bool = False) -> dict[str, PairTerms]:
        """The pair losses, linearised."""
        if not self._pair:
            return {}
        m = self.measurements
        arguments = self._differences(state.points), m.lengths_m[:, None], m.pair_active, exact
        return {name: loss.linearise(*arguments) for name, loss in self._pair.items()}

    def linearise_tracks(self, state: State) -> dict[str, TrackTerms]:
        """The track losses, linearised."""
        if not self._track:
            return {}
        m = self.measurements
        active = m.by_frame(m.active)
        return {name: loss.linearise(m.by_frame(state.points), active) for name, loss in self._track.items()}

    def _differences(self, points: Tensor) -> Tensor:
        """From one end of every stick to the other, (B, 3, F, S), of points (B, 3, N)."""
        ends = self.measurements.by_frame(points)[..., self.measurements.pairs]
        return ends[..., 1] - ends[..., 0]

    def _of_kind(self, kind: type[_Kind]) -> dict[str, _Kind]:
        return {name: loss for name, loss in self.losses.items() if isinstance(loss, kind)}

    def _by_column(self, loss: Loss) -> Tensor:
        """1 / sigma^2 of a loss (1 | B, 1, N) at every column."""
        m = self.measurements
        information = loss.information(m.confidence)
        shape = (*information.shape[:1], 1) if information.ndim == 4 else (1, 1)
        return information.reshape(*shape, 1, -1).expand(*shape, m.frames, m.points_per_frame).flatten(2)


def _values(state: State, unknowns: CameraUnknowns) -> Tensor:
    """A state's values (B, K) of the cameras' further unknowns: those of cameras as given where it has none."""
    return torch.zeros_like(unknowns.prior_sigma) if state.unknowns is None else state.unknowns
