"""The Gauss-Newton system of an objective, reduced to the cameras by exact elimination of the structure.

With the world-side perturbation ``T <- T Exp(delta)`` the derivative of a projection by its camera is its derivative by
the point times ``B(X) = [I, -[X]x]``, the same for all cameras. So everything follows from one 3 x 3 block N and one
gradient g per camera and point: H_xx = sum_c N_c, H_xc = N_c B, H_cc = sum B^T N_c B. With H_xx = L L^T and W = L^-1 H_xc
the reduced camera system is S = H_cc - W^T W.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from functools import lru_cache, reduce
from typing import NamedTuple

import torch
from torch import Tensor

from torchstickcal import se3
from torchstickcal.objective import Objective
from torchstickcal.problem import State
from torchstickcal.solvers.base import IterationRecord
from torchstickcal.solvers.cross_blocks import cross_rows, symmetric_times
from torchstickcal.solvers.point_elimination import PointElimination
from torchstickcal.solvers.track_elimination import TrackElimination
from torchstickcal.symmetric import DIAGONAL, IDENTITY, outer

_ELIMINATED_COLUMNS = 30000


class Step(NamedTuple):
    """A step of the unknowns and the decrease of the cost that the quadratic model promises for it."""

    cameras: Tensor
    """(C - 1, 6) tangents, (0, 6) where the cameras are held"""
    points: Tensor
    """(3, N), metres"""
    predicted_decrease: float
    leash: float
    """share of the descent that damping holds back, 0 to 1: near 1 the step is short because it is damped"""
    camera_sigmas: float
    """length of the cameras' step in standard deviations of their estimate; infinite where they are held"""


@dataclass(frozen=True)
class NormalEquations:
    """The undamped system at one state; C' is the number of cameras solved for (all but the first, or none)."""

    terms: dict[str, float]
    """value of each loss"""
    reprojection_px: Tensor
    """(C,), weighted root mean square of the reprojection residuals"""
    points: Tensor
    """(3, N), where the system was built"""
    camera_hessian: Tensor
    """(C', 6, 6), blocks H_cc"""
    camera_gradient: Tensor
    """(C', 6)"""
    cross: Tensor
    """(C', 6, N), the blocks N_c, entries xx xy xz yy yz zz"""
    point_hessian: Tensor
    """(6, N), diagonal blocks H_xx"""
    point_gradient: Tensor
    """(3, N)"""
    objective: Objective
    pair_coupling: Tensor | None
    """(6, F, S), minus the blocks between a stick's ends"""
    next_frame: Tensor | None
    second_frame: Tensor | None
    """multiples of the identity between a point's frames, (F - 1, P) and (F - 2, P)"""

    @property
    def cost(self) -> float:
        """The objective's value."""
        return sum(self.terms.values())

    def step(self, damping: float) -> Step | None:
        """The Levenberg-Marquardt step; None where the damped system is not positive definite.

        Args:
            damping: factor by which the diagonal of the Hessian is raised.
        """
        reduced, rhs, eliminations = self._reduce(damping)
        factor, failed = torch.linalg.cholesky_ex(reduced)
        if int(failed) or not bool(factor.isfinite().all()):
            return None
        camera_step = -torch.cholesky_solve(rhs[:, None], factor).view(-1, 6)
        point_step = torch.empty_like(self.point_gradient)
        for columns, elimination in eliminations:
            point_step[:, columns] = -elimination.solve(self.point_gradient[:, columns] + self._carried(columns, camera_step))
        diagonal = self.point_hessian[DIAGONAL]
        descent = -float((self.camera_gradient * camera_step).sum() + (self.point_gradient * point_step).sum())
        camera_diagonal = self.camera_hessian.diagonal(dim1=1, dim2=2)
        held = damping * float((camera_diagonal * camera_step**2).sum() + (diagonal * point_step**2).sum())
        squared_sigmas = -float((rhs * camera_step.flatten()).sum()) if rhs.numel() else math.inf
        return Step(
            cameras=camera_step,
            points=point_step,
            predicted_decrease=descent + held,
            leash=held / max(descent, 1e-300),
            camera_sigmas=math.sqrt(max(squared_sigmas, 0.0)),
        )

    def point_variance(self) -> Tensor:
        """Mean variance along the axes of each point (N,), cameras known, stick ends taken singly, square metres."""
        by_frame = self.objective.measurements.by_frame(self.point_hessian)
        return PointElimination(by_frame, self.objective.measurements.pairs, None).variances().mean(0)

    def record(self, stage: str, iteration: int, damping: float, step_m: float) -> IterationRecord:
        """The record of the iteration that ends here."""
        lengths = self.objective.measurements.stick_lengths_m(self.points)
        return IterationRecord(
            stage=stage,
            iteration=iteration,
            cost=self.cost,
            terms=self.terms,
            damping=damping,
            step_m=step_m,
            reprojection_px=tuple(self.reprojection_px.tolist()),
            stick_length_m=float(lengths.nanmean()) if lengths.numel() else math.nan,
        )

    def reduced_system(self, damping: float = 0.0) -> tuple[Tensor, Tensor]:
        """The reduced camera system: S (6 C', 6 C') and its right-hand side's negative (6 C',)."""
        reduced, rhs, _ = self._reduce(damping)
        return reduced, rhs

    def response(self, damping: float) -> Tensor:
        """How the points follow the cameras: ``-H_xx^-1 H_xc`` as (6 C', 3, N), a step of the points per unit of tangent."""
        response = self.points.new_empty(6 * self.camera_hessian.shape[0], *self.points.shape)
        for columns in self._slices():
            elimination = self._eliminate(columns, damping)
            rows = cross_rows(self.cross[:, :, columns], self.points[:, columns]).flatten(0, 1)
            for row, solved in zip(rows, response[..., columns], strict=True):
                solved.copy_(-elimination.solve(row))
        return response

    def _carried(self, columns: slice, camera_step: Tensor) -> Tensor:
        """``H_xc`` times a step of the cameras, (3, n)."""
        carried = torch.empty_like(self.points[:, columns])
        twists, shifts = se3.hat(camera_step[:, 3:]), camera_step[:, :3, None]
        for part in self.objective.measurements.chunks(columns):
            moved = torch.baddbmm(shifts, twists, self.points[:, part].expand(len(twists), -1, -1))
            offset = columns.start or 0
            carried[:, part.start - offset : part.stop - offset] = symmetric_times(self.cross[:, :, part], moved)
        return carried

    def _reduce(self, damping: float) -> tuple[Tensor, Tensor, list[tuple[slice, PointElimination | TrackElimination]]]:
        """The reduced system, and the eliminations of the points with the columns they hold."""
        count = self.camera_hessian.shape[0]
        reduced = torch.block_diag(*_damped(self.camera_hessian, damping)) if count else self.cross.new_zeros(0, 0)
        rhs = self.camera_gradient.flatten().clone()
        eliminations: list[tuple[slice, PointElimination | TrackElimination]] = []
        for columns in self._slices():
            elimination = self._eliminate(columns, damping)
            if count:
                arguments = self.cross[:, :, columns], self.points[:, columns], self.point_gradient[:, columns]
                for rows, half in elimination.reductions(*arguments):
                    reduced.addmm_(rows, rows.mT, alpha=-1)
                    rhs.addmv_(rows, half, alpha=-1)
            eliminations.append((columns, elimination))
        return reduced, rhs, eliminations

    def _slices(self) -> list[slice]:
        """Columns that are eliminated together: all where tracks couple them, else as many as keep torch from threading."""
        m = self.objective.measurements
        frames = m.frames if self.next_frame is not None else max(1, _ELIMINATED_COLUMNS // m.points_per_frame)
        width = frames * m.points_per_frame
        return [slice(first, min(first + width, self.points.shape[1])) for first in range(0, self.points.shape[1], width)]

    def _eliminate(self, columns: slice, damping: float) -> PointElimination | TrackElimination:
        m = self.objective.measurements
        hessian = self.point_hessian[:, columns].clone()
        hessian[DIAGONAL] *= 1 + damping
        by_frame = hessian.unflatten(1, (-1, m.points_per_frame))
        if self.next_frame is not None and self.second_frame is not None:
            return TrackElimination(by_frame, m.pairs, self.pair_coupling, self.next_frame, self.second_frame)
        coupling = self.pair_coupling
        if coupling is not None:
            coupling = coupling[:, columns.start // m.points_per_frame : columns.stop // m.points_per_frame]
        return PointElimination(by_frame, m.pairs, coupling)


def linearise(
    objective: Objective, state: State, cameras_free: bool, replaced: NormalEquations | None = None
) -> NormalEquations:
    """Build the Gauss-Newton system of an objective at a state.

    Args:
        objective: the losses on their session.
        state: where.
        cameras_free: whether the cameras are unknowns; the first one never is.
        replaced: a system of the same objective that is not needed any more, whose largest array may be overwritten.
    """
    m = objective.measurements
    free = slice(1, None) if cameras_free else slice(0, 0)
    cameras, total = m.confidence.shape
    count = cameras - 1 if cameras_free else 0
    points = state.points
    costs = {name: points.new_zeros(()) for name in objective.losses}
    squares, weights = points.new_zeros(cameras), points.new_zeros(cameras)
    cross = points.new_empty(count, 6, total) if replaced is None else replaced.cross
    point_hessian, point_gradient = points.new_empty(6, total), points.new_empty(3, total)
    gradient_moments, hessian_moments = points.new_zeros(3 * count, 4), points.new_zeros(6 * count, 10)
    for columns in m.chunks():
        homogeneous = torch.cat([torch.ones_like(points[:1, columns]), points[:, columns]])
        products = homogeneous[_PRODUCTS[0]] * homogeneous[_PRODUCTS[1]]
        blocks = objective.linearise_chunk(state, columns)
        for name, block in blocks.items():
            costs[name] += block.cost
            squares += block.squares
            weights += block.weights
        gradient = reduce(torch.add, (block.gradient for block in blocks.values()))
        hessian = reduce(torch.add, (block.hessian for block in blocks.values()))
        torch.sum(gradient, 0, out=point_gradient[:, columns])
        torch.sum(hessian, 0, out=point_hessian[:, columns])
        if count:
            cross[:, :, columns] = hessian[free]
            gradient_moments.addmm_(gradient[free].flatten(0, 1), homogeneous.mT)
            hessian_moments.addmm_(hessian[free].flatten(0, 1), products.mT)
    terms = {name: float(cost) for name, cost in costs.items()}
    if len(m.inactive_columns):
        point_hessian[:, m.inactive_columns] = point_hessian.new_tensor(IDENTITY)[:, None]
    pair_coupling = _add_pairs(objective, state, terms, m.by_frame(point_hessian), m.by_frame(point_gradient))
    bands = _add_tracks(objective, state, terms, m.by_frame(point_hessian), m.by_frame(point_gradient))
    gradient_map, hessian_map = _moment_maps(points.dtype, points.device)
    return NormalEquations(
        terms=terms,
        reprojection_px=(squares / weights.clamp_min(1e-300)).sqrt(),
        points=points,
        camera_hessian=(hessian_moments.view(count, 60) @ hessian_map).view(count, 6, 6),
        camera_gradient=gradient_moments.view(count, 12) @ gradient_map,
        cross=cross,
        point_hessian=point_hessian,
        point_gradient=point_gradient,
        objective=objective,
        pair_coupling=pair_coupling,
        next_frame=bands[0],
        second_frame=bands[1],
    )


def _add_pairs(objective: Objective, state: State, terms: dict[str, float], hessian: Tensor, gradient: Tensor) -> Tensor | None:
    """Add the pair losses to the points' blocks (6, F, P) and (3, F, P); returns the coupling (6, F, S)."""
    coupling: Tensor | None = None
    starts, ends = objective.measurements.pairs.unbind(1)
    for name, pair in objective.linearise_pairs(state).items():
        terms[name] += float(pair.cost)
        block, slope = outer(pair.jacobian), pair.jacobian * pair.residual
        hessian[..., starts] += block
        hessian[..., ends] += block
        gradient[..., starts] -= slope
        gradient[..., ends] += slope
        coupling = block if coupling is None else coupling + block
    return coupling


def _add_tracks(
    objective: Objective, state: State, terms: dict[str, float], hessian: Tensor, gradient: Tensor
) -> tuple[Tensor | None, Tensor | None]:
    """Add the track losses to the points' blocks; returns the couplings to the next and the second-next frame."""
    if not objective.couples_frames:
        return None, None
    next_frame, second_frame = (hessian.new_zeros(hessian.shape[1] - k, hessian.shape[2]) for k in (1, 2))
    frames = second_frame.shape[0]
    for name, track in objective.linearise_tracks(state).items():
        terms[name] += float(track.cost)
        information = track.scale.square()
        for offset, factor in enumerate((1.0, -2.0, 1.0)):
            gradient[:, offset : offset + frames] += factor * track.scale * track.residual
            hessian[DIAGONAL, offset : offset + frames] += factor**2 * information
        next_frame[:-1] -= 2 * information
        next_frame[1:] -= 2 * information
        second_frame += information
    return next_frame, second_frame


def _damped(blocks: Tensor, damping: float) -> Tensor:
    return blocks + damping * blocks.diagonal(dim1=1, dim2=2).diag_embed()


_PRODUCTS = ([0, 0, 0, 0, 1, 1, 1, 2, 2, 3], [0, 1, 2, 3, 1, 2, 3, 2, 3, 3])
"""The ten distinct products of the homogeneous coordinates (1, x, y, z)."""


@lru_cache(maxsize=8)
def _moment_maps(dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor]:
    """The maps from moments of gradients (12) and of Hessians (60) to those of a camera, (12, 6) and (60, 36).

    With B(X) = sum_a (1, X)_a B_a the sums of B^T g and B^T N B over the points are linear in the moments of g with
    (1, x, y, z) and of N with their ten products.
    """
    basis = torch.zeros(4, 3, 6, dtype=dtype)
    basis[0, :, :3] = torch.eye(3)
    basis[1:, :, 3:] = -se3.hat(torch.eye(3, dtype=dtype))
    hessian_map = torch.zeros(6, 10, 6, 6, dtype=dtype)
    entries = torch.tensor([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
    product = torch.zeros(4, 4, dtype=torch.long)
    product[_PRODUCTS] = product[_PRODUCTS[::-1]] = torch.arange(10)
    for a, b, i, j in itertools.product(range(4), range(4), range(3), range(3)):
        hessian_map[entries[i, j], product[a, b]] += torch.outer(basis[a, i], basis[b, j])
    gradient_map = basis.transpose(0, 1).reshape(12, 6)
    return gradient_map.to(device), hessian_map.view(60, 36).to(device)
