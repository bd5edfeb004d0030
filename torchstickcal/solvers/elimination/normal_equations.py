"""The Gauss-Newton system of an objective, reduced to the cameras by exact elimination of the points.

Poses are perturbed on the world side, ``T <- T Exp(delta)``. The derivative of a projection with respect to its
camera is then its derivative with respect to the point times ``B(X) = [I, -[X]x]``, with the same B for all cameras. So one
3 x 3 block N_c and one gradient g_c per camera and point are sufficient:

    H_xx = sum_c N_c        H_xc = N_c B        H_cc = sum_points B^T N_c B

With H_xx = L L^T and W = L^-1 H_xc the reduced camera system (Schur complement) is S = H_cc - W^T W. Lens and clock unknowns
are further columns of W.

The points are divided into parts that no loss couples. One pass over the parts linearises a part, eliminates it, and adds its
share to S, while its arrays are in the cache. The back-substitution needs the blocks of each part again. They are cached if
they are small, and otherwise computed again.

Hessians and gradients are halves of the derivatives of the cost, since a cost is a sum of squares.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from functools import reduce
from typing import Any, NamedTuple, TypeVar

import torch
from torch import Tensor

from torchstickcal.geometry import se3
from torchstickcal.geometry.symmetric import DIAGONAL, IDENTITY, raised
from torchstickcal.geometry.vectors import times_vectors
from torchstickcal.losses.camera_point import CameraPointTerms, UnknownTerms
from torchstickcal.model.objective import Objective
from torchstickcal.model.state import State
from torchstickcal.model.unknowns import Columns
from torchstickcal.solvers.elimination.camera_sums import CameraSums
from torchstickcal.solvers.elimination.cross_blocks import symmetric_times
from torchstickcal.solvers.elimination.evaluated import Evaluated
from torchstickcal.solvers.elimination.parts import BetweenFrames, Couplings, Part, WithinFrame, parts
from torchstickcal.solvers.elimination.points import PointElimination
from torchstickcal.solvers.elimination.tracks import TrackElimination
from torchstickcal.workers import map_with_idle_workers

_Result = TypeVar("_Result")

_MAX_CACHED_BYTES = 2**28
"""Memory up to which the blocks N_c are cached for the back-substitution."""
_MAX_SOLVED_BYTES = 2**24
"""Memory up to which the rows W^T are cached in their place. They save work, as long as they fit into the processor's cache."""


class Step(NamedTuple):
    """A Levenberg-Marquardt step s of B sessions, ``(H + lambda D) s = -g`` with D the diagonal of H."""

    cameras: Tensor
    """(B, C - 1, 6) tangents; (B, 0, 6) if the cameras are held fixed"""
    points: Tensor
    """(B, 3, N), metres"""
    unknowns: Tensor
    """(B, K); (B, 0) without lens and clock unknowns, and if the cameras are held fixed"""
    solved: Tensor
    """(B,), False if the damped system is not positive definite. The step is then invalid."""
    predicted_decrease: Tensor
    """(B,), decrease of the cost that the quadratic model predicts"""
    damped_share: Tensor
    """(B,), ``lambda s^T D s / -g^T s``, from 0 to 1. Near 1, the damping is what makes the step short."""
    camera_sigmas: Tensor
    """(B,), length of the cameras' step in standard deviations of the cameras; infinite if they are held fixed"""


class _CameraCoupling(NamedTuple):
    """What couples n columns with the cameras."""

    camera_blocks: Tensor
    """(B, C', 6, n), the blocks N_c"""
    camera_gradients: Tensor | None
    """(B, C', 3, n), the gradients g_c, for the exact Hessian; None for the Gauss-Newton Hessian"""
    unknown_blocks: Tensor | None
    """(B, K, 3, n), the blocks between the points and the lens and clock unknowns; None without such unknowns"""


class _EliminatedPart(NamedTuple):
    """A part: its coupling with the cameras and the factor of its Hessian."""

    coupling: _CameraCoupling
    elimination: PointElimination | TrackElimination
    rows: Tensor | None = None
    """``W^T = (L^-1 H_xc)^T``, where it is kept"""

    def solved_rows(self, points: Tensor) -> Tensor:
        """``W^T = (L^-1 H_xc)^T`` (B, 6 C' + K, 3 n), for points (B, 3, n)."""
        return self.elimination.forward_solve_cross(*self.coupling, points) if self.rows is None else self.rows

    def back_substituted(
        self, rhs: Tensor, points: Tensor, camera_step: Tensor, unknown_step: Tensor, forward: Tensor | None = None
    ) -> Tensor:
        """``H_xx^-1 (b - H_xc s)`` (B, 3, n), for a right-hand side b (B, 3, n) and a step s of cameras and unknowns.

        ``forward`` is ``L^-1 b``, where it is known.
        """
        if not self.coupling.camera_blocks.shape[1]:
            return self.elimination.solve(rhs)
        if self.rows is None:
            return self.elimination.solve(rhs - self._cross_product(points, camera_step, unknown_step))
        step = torch.cat([camera_step.flatten(1), unknown_step], dim=1).to(rhs.dtype)
        forward = self.elimination.forward_solve(rhs) if forward is None else forward
        return self.elimination.backward_solve(torch.baddbmm(forward[:, None], step[:, None], self.rows, alpha=-1)[:, 0])

    def _cross_product(self, points: Tensor, camera_step: Tensor, unknown_step: Tensor) -> Tensor:
        """``H_xc`` times a step of the cameras, (B, C', 6), and of the lens and clock unknowns, (B, K): (B, 3, n)."""
        camera_blocks, camera_gradients, unknown_blocks = self.coupling
        rotation = se3.hat(camera_step[..., 3:])
        moved = se3.moved(rotation, camera_step[..., :3], points)
        product = symmetric_times(camera_blocks, moved.to(camera_blocks.dtype))
        if camera_gradients is not None:
            product = product - (rotation.to(product.dtype) @ camera_gradients).sum(1)
        if unknown_blocks is not None:
            product = product + torch.einsum("bj,bjan->ban", unknown_step.to(product.dtype), unknown_blocks)
        return product


class _PartTerms(NamedTuple):
    """What a part adds to the system of the cameras."""

    images: list[tuple[str, CameraPointTerms]]
    """the camera-point losses, without what there is one of per column"""
    sums: CameraSums
    rows_squared: Tensor
    """W^T W"""
    rows_gradient: Tensor
    """``W^T L^-1 g``"""
    eliminated: _EliminatedPart | None
    """the part, where it is kept"""


class NormalEquations(Evaluated):
    """The Gauss-Newton system of B sessions at a state.

    C' is the number of free cameras: all but the first, or none. K is the number of lens and clock unknowns, 0 if the cameras
    are held fixed.

    Args:
        objective: the losses and measurements.
        state: where to linearise.
        cameras_free: whether the cameras are unknowns. The first camera never is.
        damping: lambda. The diagonal of the Hessian is multiplied by 1 + lambda. One number, or one per session (B,).
        exact: whether to use the exact Hessian instead of the Gauss-Newton approximation. It includes the second derivatives of
            robust kernels, projections and lengths. Track losses must be quadratic. The exact Hessian need not be positive
            definite except at a minimum.
        exact_frames: whether it then also includes those of lengths. They are negative at many ends of sticks.
    """

    point_hessian: Tensor
    """(B, 6, N), diagonal blocks of H_xx, without damping"""
    reduced: Tensor
    """(B, 6 C' + K, 6 C' + K), the reduced camera system S"""
    reduced_gradient: Tensor
    """(B, 6 C' + K), the right-hand side of the reduced camera system: g_c - H_cx H_xx^-1 g_x"""

    def __init__(
        self,
        objective: Objective,
        state: State,
        cameras_free: bool,
        damping: float | Tensor = 0.0,
        exact: bool = False,
        exact_frames: bool = True,
    ) -> None:
        super().__init__(objective, state, cameras_free)
        m, self._exact, self._exact_frames = objective.measurements, exact, exact and exact_frames
        self._damping = torch.as_tensor(damping, dtype=torch.float64, device=state.points.device).expand(m.sessions)
        self._parts = parts(m, objective.clusters, self._add_point_losses(), cameras_free)
        self._cache: dict[int, _EliminatedPart] = {}
        if cameras_free:
            self._add_camera_point_losses()
        else:
            self._add_images_to_points()

    def step(self) -> Step:
        """The Levenberg-Marquardt step."""
        gradient, hessian = self.point_gradient, self.point_hessian
        factor, failed = torch.linalg.cholesky_ex(self.reduced)
        camera_step, unknown_step = self._split(-torch.cholesky_solve(self.reduced_gradient[..., None], factor)[..., 0])
        point_step = torch.empty_like(gradient)
        rig_step = torch.cat([camera_step.flatten(1), unknown_step], dim=1)
        rig_gradient = torch.cat([self.camera_gradient.flatten(1), self.unknown_gradient], dim=1)
        descent = -(rig_gradient * rig_step).sum(1)
        squared = (self._rig_diagonal * rig_step.square()).sum(1)

        def step_of(part: Part, eliminated: _EliminatedPart) -> tuple[Tensor, Tensor]:
            rhs = -gradient[..., part.columns]
            solved = eliminated.back_substituted(rhs, self.state.points[..., part.columns], camera_step, unknown_step)
            point_step[..., part.columns] = solved
            weighted = hessian[..., part.columns][:, DIAGONAL] * solved.square()
            return (rhs * solved).sum((1, 2), dtype=torch.float64), weighted.sum((1, 2), dtype=torch.float64)

        for own_descent, own_squared in self._of_parts(step_of):
            descent += own_descent
            squared += own_squared
        damped = squared * self._damping
        squared_sigmas = -(self.reduced_gradient * rig_step).sum(1)
        return Step(
            cameras=camera_step,
            points=point_step,
            unknowns=unknown_step,
            solved=(failed == 0) & rig_step.isfinite().all(1),
            predicted_decrease=descent + damped,
            damped_share=damped / descent.clamp_min(1e-300),
            camera_sigmas=squared_sigmas.clamp_min(0.0).sqrt() if self._free_cameras else squared_sigmas.fill_(math.inf),
        )

    def solve(self, camera_rhs: Tensor, unknown_rhs: Tensor, point_rhs: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """``H^-1 b`` with the whole (damped) Hessian, for a right-hand side b.

        Args:
            camera_rhs: (B, C', 6).
            unknown_rhs: (B, K).
            point_rhs: (B, 3, N).

        Returns:
            The solution in the same three parts, and whether the Hessian is positive definite (B,).
        """
        point_rhs = point_rhs.to(self.point_hessian.dtype)
        reduced_rhs = torch.cat([camera_rhs.flatten(1), unknown_rhs], dim=1)

        forward: dict[Part, Tensor] = {}

        def reduced_share(part: Part, eliminated: _EliminatedPart) -> Tensor:
            forward[part] = eliminated.elimination.forward_solve(point_rhs[..., part.columns])
            return times_vectors(eliminated.solved_rows(self._points(part.columns)), forward[part])

        for share in self._of_parts(reduced_share) if self._free_cameras else ():
            reduced_rhs = reduced_rhs - share
        factor, failed = torch.linalg.cholesky_ex(self.reduced)
        rig = torch.cholesky_solve(reduced_rhs[..., None], factor)[..., 0]
        cameras, unknowns = self._split(rig)
        points = torch.empty_like(point_rhs)

        def back_substitute(part: Part, eliminated: _EliminatedPart) -> None:
            own = point_rhs[..., part.columns], self.state.points[..., part.columns]
            points[..., part.columns] = eliminated.back_substituted(*own, cameras, unknowns, forward.get(part))

        self._of_parts(back_substitute)
        finite = rig.isfinite().all(1) & points.flatten(1).isfinite().all(1)
        return cameras, unknowns, points, (failed == 0) & finite

    def solve_points(self, point_rhs: Tensor) -> Tensor:
        """``H_xx^-1 b`` (B, 3, N), for a right-hand side b (B, 3, N): what the points do while the cameras are held."""
        points = torch.empty_like(point_rhs)

        def solve(part: Part) -> None:
            elimination = part.eliminate(raised(self.point_hessian[..., part.columns], self._damping))
            points[..., part.columns] = elimination.solve(point_rhs[..., part.columns].to(self.point_hessian.dtype)).to(points)

        map_with_idle_workers(solve, self._parts)
        return points

    def moved(self, state: State, rig_step: Tensor) -> State:
        """A state after a step (B, 6 C' + K) of the cameras alone."""
        cameras, unknowns = self._split(rig_step)
        return state.retracted(cameras, torch.zeros_like(state.points[..., :1]), unknowns)

    def point_response(self) -> Tensor:
        """``-H_xx^-1 H_xc``: movement of the points per unit step of the cameras, (B, 6 C' + K, 3, N)."""
        points = self.state.points
        response = points.new_empty(len(points), self.reduced.shape[1], *points.shape[1:])

        def respond(part: Part, eliminated: _EliminatedPart) -> None:
            rows = eliminated.solved_rows(self._points(part.columns))
            for row in range(rows.shape[1]):
                response[:, row][..., part.columns] = -eliminated.elimination.backward_solve(rows[:, row]).to(response)

        self._of_parts(respond)
        return response

    def _add_point_losses(self) -> Couplings:
        """Add the losses without cameras to the points' gradient and Hessian. Returns the blocks off the diagonal."""
        m = self.objective.measurements
        self.point_hessian = m.pixels.new_zeros(m.sessions, 6, m.num_columns)
        self.point_gradient = m.pixels.new_zeros(m.sessions, 3, m.num_columns)
        if not bool(m.active.all()):
            identity = self.point_hessian.new_tensor(IDENTITY)[:, None]
            self.point_hessian.copy_(torch.where(m.active[:, None], self.point_hessian, identity))
        return Couplings(self._add_frame_losses(), self._add_track_losses())

    def _add_frame_losses(self) -> WithinFrame:
        """Add the frame losses. Returns the blocks between different points of a frame."""
        m, within = self.objective.measurements, WithinFrame()
        hessian = m.by_frame(self.point_hessian)
        for name, terms in self.objective.linearise_frames(self.state, self._exact_frames).items():
            self._add_frame_gradient(name, terms)
            members = self.objective.groups[name].unbind(1)
            for number, points in enumerate(members):
                hessian.index_add_(-1, points, terms.hessian[:, number].to(hessian.dtype))
            for (first, second), blocks in zip(itertools.combinations(members, 2), terms.cross.unbind(1), strict=True):
                within.add(first, second, blocks.to(hessian.dtype))
        return within

    def _add_track_losses(self) -> BetweenFrames | None:
        """Add the track losses. Returns the blocks between different frames of a point."""
        m = self.objective.measurements
        if not self.objective.track_losses:
            return None
        hessian = m.by_frame(self.point_hessian)
        between = [hessian.new_zeros(m.sessions, max(0, m.frames - step), m.points_per_frame) for step in (1, 2)]
        for name, terms in self.objective.linearise_tracks(self.state).items():
            self._add_track_gradient(name, terms)
            stencil, frames = self.objective.track_losses[name].stencil, terms.scale.shape[1]
            information = terms.scale.square().to(hessian.dtype)
            own = torch.zeros_like(hessian[:, 0])
            for i, factor in enumerate(stencil):
                own[:, i : i + frames].add_(information, alpha=factor**2)
                for j, other in enumerate(stencil[i + 1 :], i + 1):
                    between[j - i - 1][:, i : i + frames].add_(information, alpha=factor * other)
            for axis in DIAGONAL:
                hessian[:, axis] += own
        return BetweenFrames(*between)

    def _add_images_to_points(self) -> None:
        """Linearise the camera-point losses for cameras that are held."""

        def linearised(columns: slice) -> dict[str, CameraPointTerms]:
            terms = self._linearise(columns)
            for term in terms.values():
                self.point_gradient[..., columns] += term.gradient.sum(1)
                self.point_hessian[..., columns] += term.hessian.sum(1)
            return {name: term._replace(gradient=empty, hessian=empty) for name, term in terms.items()}

        empty = self.state.points[:, :0, 0]
        for terms in map_with_idle_workers(linearised, self.objective.measurements.chunks()):
            for name, term in terms.items():
                self._add_images(name, term)
        self._sum_up_images(self._new_sums())
        self.reduced, self.reduced_gradient = empty.new_zeros(len(empty), 0, 0), empty.new_zeros(len(empty), 0)
        self._rig_diagonal = self.reduced_gradient

    def _add_camera_point_losses(self) -> None:
        """Linearise the camera-point losses of every part, and build the reduced camera system."""
        m, zeros = self.objective.measurements, self.state.points.new_zeros
        size = 6 * self._free_cameras + self._unknowns.count
        reduced, reduced_gradient, sums = zeros(m.sessions, size, size), zeros(m.sessions, size), self._new_sums()
        bytes_per_row = 3 * m.sessions * m.num_columns * m.pixels.element_size()
        keeps_rows = size * bytes_per_row <= _MAX_SOLVED_BYTES
        keeps = keeps_rows or (2 * self._free_cameras + self._unknowns.count) * bytes_per_row <= _MAX_CACHED_BYTES
        found = map_with_idle_workers(lambda part: self._part_terms(part, keeps, keeps_rows), self._parts)
        for index, terms in enumerate(found):
            for name, term in terms.images:
                self._add_images(name, term)
            sums.include(terms.sums)
            reduced -= terms.rows_squared
            reduced_gradient -= terms.rows_gradient
            if terms.eliminated is not None:
                self._cache[index] = terms.eliminated
        self._sum_up_images(sums)
        rig_hessian = self._rig_hessian(sums)
        self._rig_diagonal = rig_hessian.diagonal(dim1=1, dim2=2).clone()
        rig_hessian.diagonal(dim1=1, dim2=2).mul_(1 + self._damping[:, None])
        self.reduced = reduced.add_(rig_hessian)
        self.reduced_gradient = reduced_gradient + torch.cat([self.camera_gradient.flatten(1), self.unknown_gradient], dim=1)

    def _part_terms(self, part: Part, keeps: bool, keeps_rows: bool) -> _PartTerms:
        """Linearise a part's camera-point losses, add them to the points' blocks, and eliminate it."""
        images: list[tuple[str, CameraPointTerms]] = []
        chunks: list[_CameraCoupling] = []
        sums, empty = self._new_sums(), self.state.points[:, :0, 0]
        for columns in part.chunks:
            terms = self._linearise(columns)
            images += [(name, term._replace(gradient=empty, hessian=empty, unknown=None)) for name, term in terms.items()]
            gradient, hessian, unknown = _sum_over_losses(terms)
            self.point_gradient[..., columns] += gradient.sum(1)
            self.point_hessian[..., columns] += hessian.sum(1)
            sums.add(self._points(columns), gradient, hessian, unknown)
            chunks.append(self._camera_coupling(gradient, hessian, unknown))
        eliminated = self._eliminate(part, chunks)
        rows = eliminated.solved_rows(self._points(part.columns))
        solved = eliminated.elimination.forward_solve(self.point_gradient[..., part.columns])
        kept = eliminated._replace(rows=rows) if keeps_rows else eliminated
        return _PartTerms(images, sums, rows @ rows.mT, times_vectors(rows, solved), kept if keeps else None)

    def _rig_hessian(self, sums: CameraSums) -> Tensor:
        """H_cc with the lens and clock unknowns and their prior, (B, 6 C' + K, 6 C' + K)."""
        free, unknowns = self._free_cameras, self._unknowns
        tangents, size = 6 * free, 6 * free + unknowns.count
        hessian = self.state.points.new_zeros(len(self.state.points), size, size)
        poses = hessian[:, :tangents, :tangents].view(len(hessian), free, 6, free, 6)
        poses.diagonal(dim1=1, dim2=3).copy_(sums.pose_hessian(self._exact).permute(0, 2, 3, 1))
        if unknowns.count:
            share = unknowns.share
            with_poses = torch.einsum("ckj,bckt->bctj", share[1:], sums.unknown_pose_hessian()).flatten(1, 2)
            hessian[:, :tangents, tangents:] = with_poses
            hessian[:, tangents:, :tangents] = with_poses.mT
            hessian[:, tangents:, tangents:] = torch.einsum("cki,bckl,clj->bij", share, sums.unknown_hessian, share)
            hessian[:, tangents:, tangents:].diagonal(dim1=1, dim2=2).add_(self._prior_information)
        return hessian

    def _linearise(self, columns: Columns) -> dict[str, CameraPointTerms]:
        return self.objective.linearise_chunk(self.state, columns, self._exact, self._unknowns.count > 0)

    def _split(self, rig: Tensor) -> tuple[Tensor, Tensor]:
        """Tangents (B, C', 6) and lens and clock unknowns (B, K) of a vector (B, 6 C' + K)."""
        tangents = 6 * self._free_cameras
        return rig[:, :tangents].unflatten(1, (self._free_cameras, 6)), rig[:, tangents:]

    def _of_parts(self, function: Callable[[Part, _EliminatedPart], _Result]) -> list[_Result]:
        """The results of a function of every part, eliminated: from the cache, or computed again."""

        def of_part(index: int) -> _Result:
            part, eliminated = self._parts[index], self._cache.get(index)
            if eliminated is None:
                eliminated = self._eliminate(part)
                if not self._free_cameras:
                    self._cache[index] = eliminated
            return function(part, eliminated)

        return map_with_idle_workers(of_part, range(len(self._parts)))

    def _eliminate(self, part: Part, chunks: list[_CameraCoupling] | None = None) -> _EliminatedPart:
        """Factor a part. ``chunks`` are the couplings of its chunks; None to compute them."""
        elimination = part.eliminate(raised(self.point_hessian[..., part.columns], self._damping))
        if not self._free_cameras:
            no_cameras = self.point_hessian[:, None, :, part.columns][:, :0]
            return _EliminatedPart(_CameraCoupling(no_cameras, None, None), elimination)
        if chunks is None:
            terms = (self._linearise(columns) for columns in part.chunks)
            chunks = [self._camera_coupling(*_sum_over_losses(chunk)) for chunk in terms]
        coupling = _CameraCoupling(*(_concatenate(tensors) for tensors in zip(*chunks, strict=True)))
        return _EliminatedPart(coupling, elimination)

    def _camera_coupling(self, gradient: Tensor, hessian: Tensor, unknown: UnknownTerms | None) -> _CameraCoupling:
        """The coupling of some columns with the free cameras, from the result of :func:`_sum_over_losses`."""
        unknown_blocks = None
        if unknown is not None:
            share = self._unknowns.share.to(unknown.coupling.dtype).flatten(0, 1).mT
            unknown_blocks = (share @ unknown.coupling.flatten(3).flatten(1, 2)).unflatten(2, (3, -1))
        return _CameraCoupling(hessian[:, 1:], gradient[:, 1:] if self._exact else None, unknown_blocks)

    def _points(self, columns: Columns) -> Tensor:
        return self.state.points[..., columns].to(self.point_hessian.dtype)


def _concatenate(tensors: Sequence[Tensor | None]) -> Any:
    """Tensors concatenated along the columns; None if they are None."""
    found = [tensor for tensor in tensors if tensor is not None]
    return torch.cat(found, dim=-1) if len(found) > 1 else next(iter(found), None)


def _sum_over_losses(terms: Mapping[str, CameraPointTerms]) -> tuple[Tensor, Tensor, UnknownTerms | None]:
    """Sums over the camera-point losses: gradients (B, C, 3, n), Hessians (B, C, 6, n), terms of lens and clock unknowns."""
    gradient = reduce(torch.add, (term.gradient for term in terms.values()))
    hessian = reduce(torch.add, (term.hessian for term in terms.values()))
    found = [term.unknown for term in terms.values() if term.unknown is not None]
    unknown = UnknownTerms(*(reduce(torch.add, tensors) for tensors in zip(*found, strict=True))) if found else None
    return gradient, hessian, unknown
