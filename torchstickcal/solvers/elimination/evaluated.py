"""An objective at a state: its value, and its gradient without the Hessian."""

from __future__ import annotations

import torch
from torch import Tensor

from torchstickcal.losses.camera_point import CameraPointSlopes, CameraPointTerms
from torchstickcal.losses.frame import FrameTerms
from torchstickcal.losses.track import TrackTerms
from torchstickcal.model.objective import PRIOR, Objective
from torchstickcal.model.state import State
from torchstickcal.model.unknowns import RigUnknowns
from torchstickcal.solvers.base import IterationRecord
from torchstickcal.solvers.elimination.camera_sums import CameraSums
from torchstickcal.workers import map_with_idle_workers


class Evaluated:
    """The value of an objective for B sessions at a state.

    C' is the number of free cameras: all but the first, or none. K is the number of lens and clock unknowns, 0 if the cameras
    are held fixed.

    Args:
        objective: the losses and measurements.
        state: where.
        cameras_free: whether the cameras are unknowns. The first camera never is.
    """

    terms: dict[str, Tensor]
    """value of each loss, (B,)"""
    reprojection_px: Tensor
    """(B, C), weighted root mean square reprojection error"""
    point_gradient: Tensor
    """(B, 3, N)"""
    camera_gradient: Tensor
    """(B, C', 6)"""
    unknown_gradient: Tensor
    """(B, K)"""

    def __init__(self, objective: Objective, state: State, cameras_free: bool) -> None:
        m = objective.measurements
        self.objective, self.state = objective, state
        self._free_cameras = m.num_cameras - 1 if cameras_free else 0
        self._unknowns = m.unknowns if cameras_free else RigUnknowns.of((), m.cameras)
        self.terms = {name: state.points.new_zeros(m.sessions) for name in objective.losses}
        self._squares, self._weights = (state.points.new_zeros(m.sessions, m.num_cameras) for _ in range(2))

    @property
    def cost(self) -> Tensor:
        """The objective's value, (B,)."""
        return torch.stack(list(self.terms.values())).sum(0)

    def records(self, stage: str, iterations: list[int], dampings: list[float], steps_m: list[float]) -> list[IterationRecord]:
        """The record of each session for an iteration that ends at this state."""
        m = self.objective.measurements
        terms = {name: value.tolist() for name, value in self.terms.items()}
        lengths = m.stick_lengths_m(self.state.points).flatten(1).nanmean(1).tolist()
        return [
            IterationRecord(
                session=session,
                stage=stage,
                iteration=iterations[session],
                cost=sum(values[session] for values in terms.values()),
                terms={name: values[session] for name, values in terms.items()},
                damping=dampings[session],
                step_m=steps_m[session],
                reprojection_px=tuple(pixels),
                stick_length_m=lengths[session],
                rotations=self.state.rotations[session],
                translations=self.state.translations[session],
            )
            for session, pixels in enumerate(self.reprojection_px.tolist())
        ]

    def _add_frame_gradient(self, name: str, terms: FrameTerms) -> None:
        """Add a frame loss to the terms and to the points' gradient."""
        gradient = self.objective.measurements.by_frame(self.point_gradient)
        self.terms[name] = self.terms[name] + terms.cost
        for number, points in enumerate(self.objective.groups[name].unbind(1)):
            gradient.index_add_(-1, points, terms.gradient[:, number].to(gradient.dtype))

    def _add_track_gradient(self, name: str, terms: TrackTerms) -> None:
        """Add a track loss to the terms and to the points' gradient."""
        gradient = self.objective.measurements.by_frame(self.point_gradient)
        self.terms[name] = self.terms[name] + terms.cost
        slope, frames = terms.scale[:, None] * terms.residual, terms.scale.shape[1]
        for first, factor in enumerate(self.objective.track_losses[name].stencil):
            gradient[:, :, first : first + frames] += factor * slope

    def _add_images(self, name: str, found: CameraPointSlopes | CameraPointTerms) -> None:
        """Add a camera-point loss at some columns to the terms and to the reprojection error."""
        self.terms[name] = self.terms[name] + found.cost
        self._squares += found.squares
        self._weights += found.weights

    def _new_sums(self) -> CameraSums:
        m = self.objective.measurements
        return CameraSums(self.state.points, m.num_cameras, self._free_cameras, self._unknowns.components)

    def _sum_up_images(self, sums: CameraSums) -> None:
        """Set the reprojection error, and the gradients by the cameras, after all columns."""
        self.reprojection_px = (self._squares / self._weights.clamp_min(1e-300)).sqrt()
        self.camera_gradient, share = sums.pose_gradient(), self._unknowns.share
        self.unknown_gradient = self.state.points.new_zeros(len(self.state.points), self._unknowns.count)
        if self._unknowns.count:
            self.unknown_gradient += torch.einsum("ckj,bck->bj", share, sums.unknown_gradient)
            self.terms[PRIOR], gradient, self._prior_information = self.objective.linearise_prior(self.state)
            self.unknown_gradient += gradient


class Gradient(Evaluated):
    """The value of an objective for B sessions at a state, and half its derivatives. It costs a small part of the Hessian.

    Args:
        objective: the losses and measurements.
        state: where.
        cameras_free: whether the cameras are unknowns. The first camera never is.
        dtype: in which it is computed; None for that of the keypoints.
    """

    def __init__(self, objective: Objective, state: State, cameras_free: bool, dtype: torch.dtype | None = None) -> None:
        super().__init__(objective, state, cameras_free)
        m = objective.measurements
        self.point_gradient = m.pixels.new_zeros(m.sessions, 3, m.num_columns, dtype=dtype)
        for name, terms in objective.linearise_frames(state).items():
            self._add_frame_gradient(name, terms)
        for name, terms in objective.linearise_tracks(state).items():
            self._add_track_gradient(name, terms)
        (first, sums), *others = map_with_idle_workers(lambda columns: self._chunk(columns, dtype), m.chunks())
        for found in (first, *(found for found, _ in others)):
            for name, slopes in found.items():
                self._add_images(name, slopes)
        for _, own_sums in others:
            sums.include(own_sums)
        self._sum_up_images(sums)

    def _chunk(self, columns: slice, dtype: torch.dtype | None) -> tuple[dict[str, CameraPointSlopes], CameraSums]:
        """The camera-point losses at some columns. Adds them to the points' gradient."""
        found = self.objective.slopes_of_chunk(self.state, columns, self._unknowns.count > 0, dtype)
        sums = self._new_sums()
        for slopes in found.values():
            self.point_gradient[..., columns] += slopes.gradient.sum(1)
            if self._free_cameras:
                points = self.state.points[..., columns].to(slopes.gradient)
                sums.add_gradient(points, slopes.gradient, slopes.unknown_gradient)
        empty = self.point_gradient[..., :0]  # a view of a chunk's own gradient would keep that
        return {name: slopes._replace(gradient=empty) for name, slopes in found.items()}, sums
