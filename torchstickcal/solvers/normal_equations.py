"""The Gauss-Newton system of an objective, reduced to the cameras by exact elimination of the structure.

With the world-side perturbation ``T <- T Exp(delta)`` the derivative of a projection by its camera is its derivative by
the point times ``B(X) = [I, -[X]x]``, the same for all cameras. So everything follows from one 3 x 3 block N and one
gradient g per camera and point: H_xx = sum_c N_c, H_xc = N_c B, H_cc = sum B^T N_c B. With H_xx = L L^T and W = L^-1 H_xc
the reduced camera system is S = H_cc - W^T W.

One pass over the parts of the structure builds a part's blocks, eliminates it and adds its share to S while all of it is in
the cache. What the back-substitution needs again is kept where it is small, and computed again where it is not.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping
from functools import lru_cache, reduce
from typing import NamedTuple

import torch
from torch import Tensor

from torchstickcal import se3
from torchstickcal.losses.base import CameraPointTerms
from torchstickcal.objective import Objective
from torchstickcal.problem import Columns, State
from torchstickcal.solvers.base import IterationRecord
from torchstickcal.solvers.cross_blocks import cross_rows, symmetric_times
from torchstickcal.solvers.parts import Couplings, Part, parts
from torchstickcal.solvers.point_elimination import PointElimination
from torchstickcal.solvers.track_elimination import TrackElimination
from torchstickcal.symmetric import DIAGONAL, IDENTITY, inverse_diagonal, raised

_KEPT_BYTES = 2**28
"""Size of the blocks N_c up to which they are kept for the back-substitution."""


class Step(NamedTuple):
    """A step of the unknowns and the decrease of the cost that the quadratic model promises for it, for B sessions."""

    cameras: Tensor
    """(B, C - 1, 6) tangents, (B, 0, 6) where the cameras are held"""
    points: Tensor
    """(B, 3, N), metres"""
    solved: Tensor
    """(B,), False where the damped system is not positive definite and the step is worthless"""
    predicted_decrease: Tensor
    """(B,)"""
    leash: Tensor
    """(B,), share of the descent that damping holds back, 0 to 1: near 1 the step is short because it is damped"""
    camera_sigmas: Tensor
    """(B,), length of the cameras' step in standard deviations of their estimate; infinite where they are held"""


class _Eliminated(NamedTuple):
    """A part with its coupling to the cameras and the factor of its own Hessian."""

    cross: Tensor
    """(B, C', 6, n), the blocks N_c"""
    twist: Tensor | None
    """(B, C', 3, n), the cameras' gradients, where the Hessian is exact"""
    elimination: PointElimination | TrackElimination

    def reductions(self, points: Tensor, gradient: Tensor) -> tuple[Tensor, Tensor]:
        """Those of the elimination, at points and for a gradient (B, 3, n)."""
        return self.elimination.reductions(self.cross, points, gradient, self.twist)

    def carried(self, points: Tensor, camera_step: Tensor) -> Tensor:
        """``H_xc`` times a step (B, C', 6) of the cameras, (B, 3, n)."""
        turns = se3.hat(camera_step[..., 3:])
        moved = symmetric_times(self.cross, se3.moved(turns, camera_step[..., :3], points).to(self.cross.dtype))
        return moved if self.twist is None else moved - (turns.to(moved.dtype) @ self.twist).sum(1)


class NormalEquations:
    """The system of B sessions at one state; C' is the number of cameras solved for (all but the first, or none).

    Args:
        objective: the losses on their sessions.
        state: where.
        cameras_free: whether the cameras are unknowns; the first one never is.
        damping: factor by which the diagonal of the Hessian is raised, one number or one per session (B,).
        exact: whether the Hessian is the exact one, with the curvature of kernels, projections and lengths, instead of Gauss
            and Newton's (track losses have to be quadratic). It need not be definite anywhere but at a minimum.
    """

    terms: dict[str, Tensor]
    """value of each loss, (B,)"""
    reprojection_px: Tensor
    """(B, C), weighted root mean square of the reprojection residuals"""
    point_hessian: Tensor
    """(B, 6, N), diagonal blocks H_xx, undamped"""
    point_gradient: Tensor
    """(B, 3, N)"""
    camera_gradient: Tensor
    """(B, C', 6)"""
    reduced: Tensor
    """(B, 6 C', 6 C'), the reduced camera system S"""
    reduced_gradient: Tensor
    """(B, 6 C'), the gradient that is left for the cameras once the points follow them"""

    def __init__(
        self,
        objective: Objective,
        state: State,
        cameras_free: bool,
        damping: float | Tensor = 0.0,
        exact: bool = False,
    ) -> None:
        m = objective.measurements
        self._exact = exact
        self.objective, self.state = objective, state
        self._count = m.num_cameras - 1 if cameras_free else 0
        self._damping = torch.as_tensor(damping, dtype=torch.float64, device=state.points.device).expand(m.sessions)
        self.terms = {name: state.points.new_zeros(m.sessions) for name in objective.losses}
        self._add_structure()
        self._parts = parts(m, self._couplings)
        self._kept: list[_Eliminated] | None = None
        self._add_keypoints()

    @property
    def cost(self) -> Tensor:
        """The objective's value, (B,)."""
        return torch.stack(list(self.terms.values())).sum(0)

    def step(self) -> Step:
        """The Levenberg-Marquardt step."""
        sessions, gradient, hessian = len(self.reduced), self.point_gradient, self.point_hessian
        factor, failed = torch.linalg.cholesky_ex(self.reduced)
        camera_step = -torch.cholesky_solve(self.reduced_gradient[..., None], factor)[..., 0].view(sessions, -1, 6)
        point_step = torch.empty_like(gradient)
        descent = -(self.camera_gradient * camera_step).sum((1, 2))
        held = (self._camera_diagonal * camera_step.square()).sum((1, 2))
        for part, eliminated in self._eliminations():
            rhs = gradient[..., part.columns]
            carried = eliminated.carried(self.state.points[..., part.columns], camera_step)
            solved = eliminated.elimination.solve(rhs + carried).neg_()
            point_step[..., part.columns] = solved
            descent -= (rhs * solved).sum((1, 2), dtype=torch.float64)
            held += (hessian[..., part.columns][:, DIAGONAL] * solved.square()).sum((1, 2), dtype=torch.float64)
        held = held * self._damping
        squared_sigmas = -(self.reduced_gradient * camera_step.flatten(1)).sum(1)
        return Step(
            cameras=camera_step,
            points=point_step,
            solved=(failed == 0) & camera_step.flatten(1).isfinite().all(1),
            predicted_decrease=descent + held,
            leash=held / descent.clamp_min(1e-300),
            camera_sigmas=squared_sigmas.clamp_min(0.0).sqrt() if self._count else squared_sigmas.fill_(math.inf),
        )

    def solve(self, camera_rhs: Tensor, point_rhs: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The whole Hessian's inverse times a right-hand side of cameras (B, C', 6) and points (B, 3, N).

        Returns:
            Both parts of the solution, and (B,) whether the Hessian is positive definite.
        """
        reduced_rhs = camera_rhs.flatten(1)
        for part, eliminated in self._eliminations() if self._count else ():
            rows, half = eliminated.reductions(self._points(part.columns), point_rhs[..., part.columns])
            reduced_rhs = reduced_rhs - (rows @ half[..., None])[..., 0]
        factor, failed = torch.linalg.cholesky_ex(self.reduced)
        cameras = torch.cholesky_solve(reduced_rhs[..., None], factor)[..., 0].view_as(camera_rhs)
        points = torch.empty_like(point_rhs)
        for part, eliminated in self._eliminations():
            carried = eliminated.carried(self.state.points[..., part.columns], cameras)
            points[..., part.columns] = eliminated.elimination.solve(point_rhs[..., part.columns] - carried)
        return cameras, points, (failed == 0) & cameras.flatten(1).isfinite().all(1) & points.flatten(1).isfinite().all(1)

    def point_variance(self) -> Tensor:
        """Mean variance along the axes of each point (B, N), cameras known, stick ends taken singly, square metres."""
        variance = torch.empty_like(self.point_hessian[:, 0])
        for columns in self.objective.measurements.chunks():
            variance[:, columns] = inverse_diagonal(self.point_hessian[..., columns]).mean(1)
        return variance

    def response(self) -> Tensor:
        """How the points follow the cameras: ``-H_xx^-1 H_xc`` as (B, 6 C', 3, N), a step of the points per unit of tangent."""
        points = self.state.points
        response = points.new_empty(len(points), 6 * self._count, *points.shape[1:])
        for part in self._parts:
            eliminated = self._eliminated(part)
            rows = cross_rows(eliminated.cross, self._points(part.columns)).flatten(1, 2)
            for row in range(rows.shape[1]):
                response[:, row][..., part.columns] = -eliminated.elimination.solve(rows[:, row])
        return response

    def records(self, stage: str, iterations: list[int], dampings: list[float], steps_m: list[float]) -> list[IterationRecord]:
        """The records of the iterations that end here, one for each session."""
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
            )
            for session, pixels in enumerate(self.reprojection_px.tolist())
        ]

    def _add_structure(self) -> None:
        """What the losses on points alone contribute, and the couplings they make."""
        m = self.objective.measurements
        self.point_hessian = m.pixels.new_zeros(m.sessions, 6, m.num_columns)
        self.point_gradient = m.pixels.new_zeros(m.sessions, 3, m.num_columns)
        if not bool(m.active.all()):
            identity = self.point_hessian.new_tensor(IDENTITY)[:, None]
            self.point_hessian.copy_(torch.where(m.active[:, None], self.point_hessian, identity))
        self._couplings = Couplings(self._add_pairs(), *self._add_tracks())

    def _add_pairs(self) -> Tensor | None:
        """Add the pair losses to the points' blocks; returns the coupling (B, 6, F, S)."""
        m, coupling = self.objective.measurements, None
        starts, ends = m.pairs.unbind(1)
        hessian, gradient = m.by_frame(self.point_hessian), m.by_frame(self.point_gradient)
        for name, pair in self.objective.linearise_pairs(self.state, self._exact).items():
            self.terms[name] = self.terms[name] + pair.cost
            block, slope = pair.hessian.to(hessian.dtype), pair.gradient.to(hessian.dtype)
            hessian[..., starts] += block
            hessian[..., ends] += block
            gradient[..., starts] -= slope
            gradient[..., ends] += slope
            coupling = block if coupling is None else coupling + block
        return coupling

    def _add_tracks(self) -> tuple[Tensor | None, Tensor | None]:
        """Add the track losses to the points' blocks; returns the couplings to the next and the second-next frame."""
        m = self.objective.measurements
        if not self.objective.couples_frames:
            return None, None
        hessian, gradient = m.by_frame(self.point_hessian), m.by_frame(self.point_gradient)
        next_frame, second_frame = (hessian.new_zeros(m.sessions, m.frames - k, m.points_per_frame) for k in (1, 2))
        frames = m.frames - 2
        for name, track in self.objective.linearise_tracks(self.state).items():
            self.terms[name] = self.terms[name] + track.cost
            information, slope = track.scale.square().to(hessian.dtype), (track.scale[:, None] * track.residual)
            for offset, factor in enumerate((1.0, -2.0, 1.0)):
                gradient[:, :, offset : offset + frames] += factor * slope
                for axis in DIAGONAL:
                    hessian[:, axis, offset : offset + frames] += factor**2 * information
            next_frame[:, :-1] -= 2 * information
            next_frame[:, 1:] -= 2 * information
            second_frame += information
        return next_frame, second_frame

    def _add_keypoints(self) -> None:
        """The camera-point losses of every part, and its elimination where the cameras are unknowns."""
        m, count, zeros = self.objective.measurements, self._count, self.state.points.new_zeros
        squares, weights = zeros(m.sessions, m.num_cameras), zeros(m.sessions, m.num_cameras)
        gradient_moments, hessian_moments = zeros(m.sessions, 3 * count, 4), zeros(m.sessions, 6 * count, 10)
        reduced, reduced_gradient = zeros(m.sessions, 6 * count, 6 * count), zeros(m.sessions, 6 * count)
        if count * m.sessions * m.num_columns * 6 * m.pixels.element_size() <= _KEPT_BYTES:
            self._kept = []
        for part in self._parts:
            crosses: list[tuple[Tensor, Tensor]] = []
            for columns in part.chunks:
                blocks = self.objective.linearise_chunk(self.state, columns, self._exact)
                for name, block in blocks.items():
                    self.terms[name] = self.terms[name] + block.cost
                    squares += block.squares
                    weights += block.weights
                gradient, hessian = _summed(blocks)
                self.point_gradient[..., columns] += gradient.sum(1)
                self.point_hessian[..., columns] += hessian.sum(1)
                if count:
                    points = self._points(columns)
                    homogeneous = torch.cat([torch.ones_like(points[:, :1]), points], dim=1)
                    products = homogeneous[:, _PRODUCTS[0]] * homogeneous[:, _PRODUCTS[1]]
                    gradient_moments += gradient[:, 1:].flatten(1, 2) @ homogeneous.mT
                    hessian_moments += hessian[:, 1:].flatten(1, 2) @ products.mT
                    crosses.append((hessian[:, 1:], gradient[:, 1:]))
            if count:
                eliminated = self._eliminated(part, crosses)
                rows, half = eliminated.reductions(self._points(part.columns), self.point_gradient[..., part.columns])
                reduced -= rows @ rows.mT
                reduced_gradient -= (rows @ half[..., None])[..., 0]
                if self._kept is not None:
                    self._kept.append(eliminated)
        gradient_map, hessian_map = _moment_maps(self.state.points.device)
        blocks = (hessian_moments.view(m.sessions, count, 60) @ hessian_map).view(m.sessions, count, 6, 6)
        if self._exact:
            blocks += _turning(gradient_moments.view(m.sessions, count, 3, 4))
        self._camera_diagonal = blocks.diagonal(dim1=2, dim2=3).clone()
        blocks.diagonal(dim1=2, dim2=3).mul_(1 + self._damping[:, None, None])
        on_diagonal = reduced.view(m.sessions, count, 6, count, 6).diagonal(dim1=1, dim2=3)
        on_diagonal += blocks.permute(0, 2, 3, 1)
        self.camera_gradient = gradient_moments.view(m.sessions, count, 12) @ gradient_map
        self.reduced, self.reduced_gradient = reduced, reduced_gradient + self.camera_gradient.flatten(1)
        self.reprojection_px = (squares / weights.clamp_min(1e-300)).sqrt()

    def _eliminations(self) -> Iterator[tuple[Part, _Eliminated]]:
        """All parts, eliminated: kept ones, or done again."""
        for index, part in enumerate(self._parts):
            yield part, self._kept[index] if self._kept else self._eliminated(part)

    def _eliminated(self, part: Part, blocks: list[tuple[Tensor, Tensor]] | None = None) -> _Eliminated:
        """A part's factor and coupling to the cameras, of its blocks N_c and gradients by chunk where they are at hand."""
        elimination = part.eliminate(raised(self.point_hessian[..., part.columns], self._damping))
        if not self._count:
            nothing = self.point_hessian[:, None, :, part.columns][:, :0]
            return _Eliminated(nothing, None, elimination)
        if blocks is None:
            chunks = (self.objective.linearise_chunk(self.state, columns, self._exact) for columns in part.chunks)
            blocks = [(hessian[:, 1:], gradient[:, 1:]) for gradient, hessian in map(_summed, chunks)]
        cross, twist = (pieces[0] if len(pieces) == 1 else torch.cat(pieces, dim=-1) for pieces in zip(*blocks, strict=True))
        return _Eliminated(cross, twist if self._exact else None, elimination)

    def _points(self, columns: Columns) -> Tensor:
        return self.state.points[..., columns].to(self.point_hessian.dtype)


def _summed(blocks: Mapping[str, CameraPointTerms]) -> tuple[Tensor, Tensor]:
    """Gradients (B, C, 3, n) and Hessians (B, C, 6, n) of all camera-point losses."""
    gradient = reduce(torch.add, (block.gradient for block in blocks.values()))
    return gradient, reduce(torch.add, (block.hessian for block in blocks.values()))


def _turning(moments: Tensor) -> Tensor:
    """What the exact Hessian adds for turning a camera about the world's origin, (B, C', 6, 6), of moments of g (B, C', 3, 4).

    To second order ``Exp(nu, omega) X = X + nu + omega x X + (omega x nu + omega x (omega x X)) / 2``.
    """
    gradient, by_point = moments[..., 0], moments[..., 1:]
    added = moments.new_zeros(*moments.shape[:2], 6, 6)
    added[..., :3, 3:] = se3.hat(gradient) / 2
    added[..., 3:, :3] = added[..., :3, 3:].mT
    trace = by_point.diagonal(dim1=-2, dim2=-1).sum(-1)
    added[..., 3:, 3:] = (by_point + by_point.mT) / 2 - trace[..., None, None] * torch.eye(3).to(moments)
    return added


_PRODUCTS = ([0, 0, 0, 0, 1, 1, 1, 2, 2, 3], [0, 1, 2, 3, 1, 2, 3, 2, 3, 3])
"""The ten distinct products of the homogeneous coordinates (1, x, y, z)."""


@lru_cache(maxsize=8)
def _moment_maps(device: torch.device) -> tuple[Tensor, Tensor]:
    """The maps from moments of gradients (12) and of Hessians (60) to those of a camera, (12, 6) and (60, 36).

    With B(X) = sum_a (1, X)_a B_a the sums of B^T g and B^T N B over the points are linear in the moments of g with
    (1, x, y, z) and of N with their ten products.
    """
    basis = torch.zeros(4, 3, 6, dtype=torch.float64)
    basis[0, :, :3] = torch.eye(3)
    basis[1:, :, 3:] = -se3.hat(torch.eye(3, dtype=torch.float64))
    hessian_map = torch.zeros(6, 10, 6, 6, dtype=torch.float64)
    entries = torch.tensor([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
    product = torch.zeros(4, 4, dtype=torch.long)
    product[_PRODUCTS] = product[_PRODUCTS[::-1]] = torch.arange(10)
    for a, b, i, j in itertools.product(range(4), range(4), range(3), range(3)):
        hessian_map[entries[i, j], product[a, b]] += torch.outer(basis[a, i], basis[b, j])
    gradient_map = basis.transpose(0, 1).reshape(12, 6)
    return gradient_map.to(device), hessian_map.view(60, 36).to(device)
