"""The Gauss-Newton system of an objective, reduced to the cameras by exact elimination of the structure.

With the world-side perturbation ``T <- T Exp(delta)`` the derivative of a projection by its camera is its derivative by
the point times ``B(X) = [I, -[X]x]``, the same for all cameras. So everything follows from one 3 x 3 block N and one
gradient g per camera and point: H_xx = sum_c N_c, H_xc = N_c B, H_cc = sum B^T N_c B. With H_xx = L L^T and W = L^-1 H_xc
the reduced camera system is S = H_cc - W^T W. What else is unknown of the cameras, lenses and clocks, joins them in that system
as further columns of W.

One pass over the parts of the structure builds a part's blocks, eliminates it and adds its share to S while all of it is in
the cache. What the back-substitution needs again is kept where it is small, and computed again where it is not.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache, reduce
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchstickcal.geometry import se3
from torchstickcal.geometry.symmetric import DIAGONAL, IDENTITY, inverse_diagonal, raised, six_entries
from torchstickcal.losses.camera_point import CameraPointTerms, UnknownTerms
from torchstickcal.model.objective import PRIOR, Objective
from torchstickcal.model.state import State
from torchstickcal.model.unknowns import Columns, RigUnknowns
from torchstickcal.solvers.base import IterationRecord
from torchstickcal.solvers.elimination.cross_blocks import cross_rows, symmetric_times
from torchstickcal.solvers.elimination.parts import BetweenFrames, Couplings, Part, WithinFrame, parts
from torchstickcal.solvers.elimination.points import PointElimination
from torchstickcal.solvers.elimination.tracks import TrackElimination

_KEPT_BYTES = 2**28
"""Size of the blocks N_c up to which they are kept for the back-substitution."""


class Step(NamedTuple):
    """A step of the unknowns and the decrease of the cost that the quadratic model promises for it, for B sessions."""

    cameras: Tensor
    """(B, C - 1, 6) tangents, (B, 0, 6) where the cameras are held"""
    points: Tensor
    """(B, 3, N), metres"""
    unknowns: Tensor
    """(B, K), (B, 0) where there are none or the cameras are held"""
    solved: Tensor
    """(B,), False where the damped system is not positive definite and the step is worthless"""
    predicted_decrease: Tensor
    """(B,)"""
    leash: Tensor
    """(B,), share of the descent that damping holds back, 0 to 1: near 1 the step is short because it is damped"""
    camera_sigmas: Tensor
    """(B,), length of the cameras' step in standard deviations of their estimate; infinite where they are held"""


class _Coupled(NamedTuple):
    """What ties points to the cameras."""

    cross: Tensor
    """(B, C', 6, n), the blocks N_c"""
    twist: Tensor | None
    """(B, C', 3, n), the cameras' gradients, where the Hessian is exact"""
    coupling: Tensor | None
    """(B, K, 3, n), the blocks with the cameras' further unknowns"""


class _Eliminated(NamedTuple):
    """A part with its coupling to the cameras, as of :class:`_Coupled`, and the factor of its own Hessian."""

    cross: Tensor
    twist: Tensor | None
    coupling: Tensor | None
    elimination: PointElimination | TrackElimination

    def reductions(self, points: Tensor, gradient: Tensor) -> tuple[Tensor, Tensor]:
        """Those of the elimination, at points and for a gradient (B, 3, n)."""
        return self.elimination.reductions(self.cross, points, gradient, self.twist, self.coupling)

    def carried(self, points: Tensor, camera_step: Tensor, unknown_step: Tensor) -> Tensor:
        """``H_xc`` times a step (B, C', 6) of the cameras and (B, K) of their further unknowns, (B, 3, n)."""
        turns = se3.hat(camera_step[..., 3:])
        moved = symmetric_times(self.cross, se3.moved(turns, camera_step[..., :3], points).to(self.cross.dtype))
        if self.twist is not None:
            moved = moved - (turns.to(moved.dtype) @ self.twist).sum(1)
        if self.coupling is not None:
            moved = moved + torch.einsum("bj,bjan->ban", unknown_step.to(moved.dtype), self.coupling)
        return moved


class NormalEquations:
    """The system of B sessions at one state.

    C' is the number of cameras solved for (all but the first, or none), K that of their further unknowns (none where they are
    held).

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
    unknown_gradient: Tensor
    """(B, K)"""
    reduced: Tensor
    """(B, 6 C' + K, 6 C' + K), the reduced camera system S"""
    reduced_gradient: Tensor
    """(B, 6 C' + K), the gradient that is left for the cameras once the points follow them"""

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
        self._unknowns = m.unknowns if cameras_free else RigUnknowns.of((), m.cameras)
        self._damping = torch.as_tensor(damping, dtype=torch.float64, device=state.points.device).expand(m.sessions)
        self.terms = {name: state.points.new_zeros(m.sessions) for name in objective.losses}
        self._add_structure()
        self._parts = parts(m, objective.clusters, self._couplings)
        self._kept: list[_Eliminated] | None = None
        self._add_keypoints()

    @property
    def cost(self) -> Tensor:
        """The objective's value, (B,)."""
        return torch.stack(list(self.terms.values())).sum(0)

    def step(self) -> Step:
        """The Levenberg-Marquardt step."""
        gradient, hessian = self.point_gradient, self.point_hessian
        factor, failed = torch.linalg.cholesky_ex(self.reduced)
        camera_step, unknown_step = self._split(-torch.cholesky_solve(self.reduced_gradient[..., None], factor)[..., 0])
        point_step = torch.empty_like(gradient)
        together = torch.cat([camera_step.flatten(1), unknown_step], dim=1)
        descent = -(torch.cat([self.camera_gradient.flatten(1), self.unknown_gradient], dim=1) * together).sum(1)
        held = (self._diagonal * together.square()).sum(1)
        for part, eliminated in self._eliminations():
            rhs = gradient[..., part.columns]
            carried = eliminated.carried(self.state.points[..., part.columns], camera_step, unknown_step)
            solved = eliminated.elimination.solve(rhs + carried).neg_()
            point_step[..., part.columns] = solved
            descent -= (rhs * solved).sum((1, 2), dtype=torch.float64)
            held += (hessian[..., part.columns][:, DIAGONAL] * solved.square()).sum((1, 2), dtype=torch.float64)
        held = held * self._damping
        squared_sigmas = -(self.reduced_gradient * together).sum(1)
        return Step(
            cameras=camera_step,
            points=point_step,
            unknowns=unknown_step,
            solved=(failed == 0) & together.isfinite().all(1),
            predicted_decrease=descent + held,
            leash=held / descent.clamp_min(1e-300),
            camera_sigmas=squared_sigmas.clamp_min(0.0).sqrt() if self._count else squared_sigmas.fill_(math.inf),
        )

    def solve(self, camera_rhs: Tensor, unknown_rhs: Tensor, point_rhs: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """The whole Hessian's inverse times a right-hand side of cameras (B, C', 6), unknowns (B, K) and points (B, 3, N).

        Returns:
            The three parts of the solution, and (B,) whether the Hessian is positive definite.
        """
        reduced_rhs = torch.cat([camera_rhs.flatten(1), unknown_rhs], dim=1)
        for part, eliminated in self._eliminations() if self._count else ():
            rows, half = eliminated.reductions(self._points(part.columns), point_rhs[..., part.columns])
            reduced_rhs = reduced_rhs - (rows @ half[..., None])[..., 0]
        factor, failed = torch.linalg.cholesky_ex(self.reduced)
        together = torch.cholesky_solve(reduced_rhs[..., None], factor)[..., 0]
        cameras, unknowns = self._split(together)
        points = torch.empty_like(point_rhs)
        for part, eliminated in self._eliminations():
            carried = eliminated.carried(self.state.points[..., part.columns], cameras, unknowns)
            points[..., part.columns] = eliminated.elimination.solve(point_rhs[..., part.columns] - carried)
        finite = together.isfinite().all(1) & points.flatten(1).isfinite().all(1)
        return cameras, unknowns, points, (failed == 0) & finite

    def point_variance(self) -> Tensor:
        """Mean variance along the axes of each point (B, N), cameras known, stick ends taken singly, square metres."""
        variance = torch.empty_like(self.point_hessian[:, 0])
        for columns in self.objective.measurements.chunks():
            variance[:, columns] = inverse_diagonal(self.point_hessian[..., columns]).mean(1)
        return variance

    def response(self) -> Tensor:
        """How the points follow the cameras: ``-H_xx^-1 H_xc`` as (B, 6 C' + K, 3, N), a step of the points per unit."""
        points = self.state.points
        response = points.new_empty(len(points), self.reduced.shape[1], *points.shape[1:])
        for part in self._parts:
            eliminated = self._eliminated(part)
            rows = cross_rows(eliminated.cross, self._points(part.columns)).flatten(1, 2)
            if eliminated.coupling is not None:
                rows = torch.cat([rows, eliminated.coupling], dim=1)
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
        self._couplings = Couplings(self._add_frame_losses(), self._add_track_losses())

    def _add_frame_losses(self) -> WithinFrame:
        """Add the frame losses to the points' blocks; returns the blocks between different points of a frame."""
        m, between = self.objective.measurements, WithinFrame()
        hessian, gradient = m.by_frame(self.point_hessian), m.by_frame(self.point_gradient)
        for name, terms in self.objective.linearise_frames(self.state, self._exact).items():
            self.terms[name] = self.terms[name] + terms.cost
            blocks, slopes = terms.hessian.to(hessian.dtype), terms.gradient.to(hessian.dtype)
            members = self.objective.groups[name].unbind(1)
            for i, first in enumerate(members):
                gradient.index_add_(-1, first, slopes[:, i])
                hessian.index_add_(-1, first, six_entries(blocks[:, i, i].flatten(-2)).unflatten(-1, blocks.shape[-2:]))
                for j, second in enumerate(members[i + 1 :], i + 1):
                    between.add(first, second, blocks[:, i, j])
        return between

    def _add_track_losses(self) -> BetweenFrames | None:
        """Add the track losses to the points' blocks; returns the couplings of a point's frames."""
        m = self.objective.measurements
        if not self.objective.track_losses:
            return None
        hessian, gradient = m.by_frame(self.point_hessian), m.by_frame(self.point_gradient)
        coupling = [hessian.new_zeros(m.sessions, max(0, m.frames - step), m.points_per_frame) for step in (1, 2)]
        for name, terms in self.objective.linearise_tracks(self.state).items():
            self.terms[name] = self.terms[name] + terms.cost
            stencil, frames = self.objective.track_losses[name].stencil, terms.scale.shape[1]
            information, slope = terms.scale.square().to(hessian.dtype), terms.scale[:, None] * terms.residual
            for i, factor in enumerate(stencil):
                gradient[:, :, i : i + frames] += factor * slope
                for axis in DIAGONAL:
                    hessian[:, axis, i : i + frames] += factor**2 * information
                for j, other in enumerate(stencil[i + 1 :], i + 1):
                    coupling[j - i - 1][:, i : i + frames] += factor * other * information
        return BetweenFrames(*coupling)

    def _add_keypoints(self) -> None:
        """The camera-point losses of every part, and its elimination where the cameras are unknowns."""
        m, count, zeros = self.objective.measurements, self._count, self.state.points.new_zeros
        further, kinds = self._unknowns.count, self._unknowns.components
        squares, weights = zeros(m.sessions, m.num_cameras), zeros(m.sessions, m.num_cameras)
        gradient_moments, hessian_moments = zeros(m.sessions, 3 * count, 4), zeros(m.sessions, 6 * count, 10)
        own_gradient, own_hessian = zeros(m.sessions, m.num_cameras, kinds), zeros(m.sessions, m.num_cameras, kinds, kinds)
        own_moments = zeros(m.sessions, count, kinds, 3, 4)
        size = 6 * count + further
        reduced, reduced_gradient = zeros(m.sessions, size, size), zeros(m.sessions, size)
        if (2 * count + further) * m.sessions * m.num_columns * 3 * m.pixels.element_size() <= _KEPT_BYTES:
            self._kept = []
        for part in self._parts:
            couplings: list[_Coupled] = []
            for columns in part.chunks:
                blocks = self._linearised(columns)
                for name, block in blocks.items():
                    self.terms[name] = self.terms[name] + block.cost
                    squares += block.squares
                    weights += block.weights
                gradient, hessian, unknown = _summed(blocks)
                self.point_gradient[..., columns] += gradient.sum(1)
                self.point_hessian[..., columns] += hessian.sum(1)
                if count:
                    points = self._points(columns)
                    homogeneous = torch.cat([torch.ones_like(points[:, :1]), points], dim=1)
                    products = homogeneous[:, _PRODUCTS[0]] * homogeneous[:, _PRODUCTS[1]]
                    gradient_moments += gradient[:, 1:].flatten(1, 2) @ homogeneous.mT
                    hessian_moments += hessian[:, 1:].flatten(1, 2) @ products.mT
                    if unknown is not None:
                        own_gradient += unknown.gradient
                        own_hessian += unknown.hessian
                        own_moments += unknown.coupling[:, 1:] @ homogeneous.mT[:, None, None]
                    couplings.append(self._coupled(gradient, hessian, unknown))
            if count:
                eliminated = self._eliminated(part, couplings)
                rows, half = eliminated.reductions(self._points(part.columns), self.point_gradient[..., part.columns])
                reduced -= rows @ rows.mT
                reduced_gradient -= (rows @ half[..., None])[..., 0]
                if self._kept is not None:
                    self._kept.append(eliminated)
        gradient_map, hessian_map = _moment_maps(self.state.points.device)
        blocks = (hessian_moments.view(m.sessions, count, 60) @ hessian_map).view(m.sessions, count, 6, 6)
        if self._exact:
            blocks += _turning(gradient_moments.view(m.sessions, count, 3, 4))
        own = reduced.new_zeros(m.sessions, size, size)
        own[:, : 6 * count, : 6 * count].view(m.sessions, count, 6, count, 6).diagonal(dim1=1, dim2=3).copy_(
            blocks.permute(0, 2, 3, 1)
        )
        self.camera_gradient = gradient_moments.view(m.sessions, count, 12) @ gradient_map
        self.unknown_gradient = reduced.new_zeros(m.sessions, further)
        if further:
            share = self._unknowns.share
            with_poses = own_moments.flatten(3) @ gradient_map
            own[:, : 6 * count, 6 * count :] = torch.einsum("ckj,bckt->bctj", share[1:], with_poses).flatten(1, 2)
            own[:, 6 * count :, : 6 * count] = own[:, : 6 * count, 6 * count :].mT
            own[:, 6 * count :, 6 * count :] = torch.einsum("cki,bckl,clj->bij", share, own_hessian, share)
            self.unknown_gradient = torch.einsum("ckj,bck->bj", share, own_gradient)
            self._add_prior(own[:, 6 * count :, 6 * count :])
        self._diagonal = own.diagonal(dim1=1, dim2=2).clone()
        own.diagonal(dim1=1, dim2=2).mul_(1 + self._damping[:, None])
        self.reduced = reduced.add_(own)
        self.reduced_gradient = reduced_gradient + torch.cat([self.camera_gradient.flatten(1), self.unknown_gradient], dim=1)
        self.reprojection_px = (squares / weights.clamp_min(1e-300)).sqrt()

    def _linearised(self, columns: Columns) -> dict[str, CameraPointTerms]:
        return self.objective.linearise_chunk(self.state, columns, self._exact, self._unknowns.count > 0)

    def _add_prior(self, hessian: Tensor) -> None:
        """The prior of the cameras' further unknowns, to the terms, their gradient and their block (B, K, K)."""
        self.terms[PRIOR], gradient, information = self.objective.linearise_prior(self.state)
        self.unknown_gradient += gradient
        hessian.diagonal(dim1=1, dim2=2).add_(information)

    def _split(self, together: Tensor) -> tuple[Tensor, Tensor]:
        """Tangents (B, C', 6) and further unknowns (B, K) of both side by side."""
        cameras = 6 * self._count
        return together[:, :cameras].unflatten(1, (self._count, 6)), together[:, cameras:]

    def _eliminations(self) -> Iterator[tuple[Part, _Eliminated]]:
        """All parts, eliminated: kept ones, or done again."""
        for index, part in enumerate(self._parts):
            yield part, self._kept[index] if self._kept else self._eliminated(part)

    def _eliminated(self, part: Part, couplings: list[_Coupled] | None = None) -> _Eliminated:
        """A part's factor and its coupling to the cameras, by chunk where that is at hand."""
        elimination = part.eliminate(raised(self.point_hessian[..., part.columns], self._damping))
        if not self._count:
            nothing = self.point_hessian[:, None, :, part.columns][:, :0]
            return _Eliminated(nothing, None, None, elimination)
        if couplings is None:
            chunks = (self._linearised(columns) for columns in part.chunks)
            couplings = [self._coupled(*_summed(chunk)) for chunk in chunks]
        coupled = _Coupled(*(_joined(pieces) for pieces in zip(*couplings, strict=True)))
        return _Eliminated(*coupled, elimination)

    def _coupled(self, gradient: Tensor, hessian: Tensor, unknown: UnknownTerms | None) -> _Coupled:
        """What ties some points to the cameras, of :func:`_summed`."""
        coupling = None
        if unknown is not None:
            share = self._unknowns.share.to(unknown.coupling.dtype).flatten(0, 1).mT
            coupling = (share @ unknown.coupling.flatten(3).flatten(1, 2)).unflatten(2, (3, -1))
        return _Coupled(hessian[:, 1:], gradient[:, 1:] if self._exact else None, coupling)

    def _points(self, columns: Columns) -> Tensor:
        return self.state.points[..., columns].to(self.point_hessian.dtype)


def _joined(pieces: Sequence[Tensor | None]) -> Any:
    """Tensors of columns side by side, or None if they are none."""
    found = [piece for piece in pieces if piece is not None]
    return torch.cat(found, dim=-1) if len(found) > 1 else next(iter(found), None)


def _summed(blocks: Mapping[str, CameraPointTerms]) -> tuple[Tensor, Tensor, UnknownTerms | None]:
    """Gradients (B, C, 3, n), Hessians (B, C, 6, n) and the terms of further unknowns, of all camera-point losses."""
    gradient = reduce(torch.add, (block.gradient for block in blocks.values()))
    hessian = reduce(torch.add, (block.hessian for block in blocks.values()))
    found = [block.unknown for block in blocks.values() if block.unknown is not None]
    unknown = UnknownTerms(*(reduce(torch.add, of) for of in zip(*found, strict=True))) if found else None
    return gradient, hessian, unknown


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
