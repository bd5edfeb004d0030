"""Bundle adjustment with residuals among the points of a frame, and priors of cameras, that the library's solvers do not know.

Levenberg-Marquardt on a dense system. The reprojection comes linearised from the library, a further residual by autograd;
all points of a frame are eliminated together. One session at a time.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from torchstickcal.geometry import se3
from torchstickcal.geometry.symmetric import IDENTITY, expand
from torchstickcal.losses import ReprojectionLoss
from torchstickcal.model.measurements import Measurements
from torchstickcal.model.objective import Objective
from torchstickcal.model.state import State
from torchstickcal.solvers.elimination.cross_blocks import cross_rows

_INITIAL_DAMPING = 1e-5
_MIN_DAMPING, _MAX_DAMPING = 1e-12, 1e8
_COST_TOLERANCE = 1e-6
_EXACT_COST_PER_KEYPOINT = 1e-18

FrameResiduals = Callable[[Tensor], Tensor]
"""Whitened residuals (F, M) of points (F, P, 3), those of a frame from that frame's points alone."""


class CameraPrior(NamedTuple):
    """Where the cameras are believed to be: the state's poses, and the information (C - 1, 6, 6) of their tangents."""

    rotations: Tensor
    translations: Tensor
    information: Tensor


class Adjusted(NamedTuple):
    """Where an adjustment ended."""

    state: State
    converged: bool
    reduced: Tensor
    """(6 (C - 1), 6 (C - 1)), the information of all cameras' tangents, the points eliminated"""


def adjust(
    measurements: Measurements,
    state: State,
    reprojection: ReprojectionLoss,
    frame_residuals: FrameResiduals | None = None,
    prior: CameraPrior | None = None,
    max_iterations: int = 50,
) -> Adjusted:
    """Minimise reprojection, further residuals and prior over all points and all cameras but the first."""
    objective = Objective(measurements, {"reprojection": reprojection})
    exact = _EXACT_COST_PER_KEYPOINT * float(measurements.visible.sum())
    damping = _INITIAL_DAMPING
    system = _linearise(objective, state, frame_residuals, prior)
    converged = system.cost <= exact
    for _ in range(max_iterations):
        if converged or damping > _MAX_DAMPING:
            break
        camera_step, point_step, promised = system.step(damping)
        candidate = state.retracted(camera_step, point_step)
        reached = _linearise(objective, candidate, frame_residuals, prior)
        decrease = system.cost - reached.cost
        converged = abs(promised) <= _COST_TOLERANCE * system.cost or reached.cost <= exact
        if decrease > 0:
            converged = converged or decrease <= _COST_TOLERANCE * system.cost
            state, system, damping = candidate, reached, max(damping * 0.1, _MIN_DAMPING)
        else:
            damping *= 10
    return Adjusted(state, converged, system.reduce(0.0)[0])


@dataclass(frozen=True)
class _System:
    """Gauss-Newton blocks at a state; n = 6 (C - 1) tangents, F frames of 3 P coordinates."""

    cost: float
    camera_hessian: Tensor
    """(n, n)"""
    camera_gradient: Tensor
    """(n,)"""
    cross: Tensor
    """(F, 3 P, n), of points with cameras"""
    point_hessian: Tensor
    """(F, 3 P, 3 P)"""
    point_gradient: Tensor
    """(F, 3 P)"""

    def reduce(self, damping: float) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """The camera system without the points, its gradient, and the factors L^-1 H_xc and L of the elimination."""
        lower = torch.linalg.cholesky(_damped(self.point_hessian, damping))
        half = torch.linalg.solve_triangular(lower, self.cross, upper=False)
        gradient = torch.linalg.solve_triangular(lower, self.point_gradient[..., None], upper=False)
        flat = half.flatten(0, 1)
        reduced = _damped(self.camera_hessian, damping) - flat.mT @ flat
        return reduced, self.camera_gradient - flat.mT @ gradient.flatten(), half, lower

    def step(self, damping: float) -> tuple[Tensor, Tensor, float]:
        """Steps (C - 1, 6) of the cameras and (3, F P) of the points, and the decrease they promise."""
        reduced, rhs, half, lower = self.reduce(damping)
        cameras = -torch.linalg.solve(reduced, rhs)
        gradient = torch.linalg.solve_triangular(lower, self.point_gradient[..., None], upper=False)
        points = -torch.linalg.solve_triangular(lower.mT, gradient + (half @ cameras)[..., None], upper=True)[..., 0]
        promised = -float(self.camera_gradient @ cameras + (self.point_gradient * points).sum())
        return cameras.view(1, -1, 6), points.reshape(1, -1, 3).mT, promised


def _linearise(
    objective: Objective, state: State, frame_residuals: FrameResiduals | None, prior: CameraPrior | None
) -> _System:
    m, points = objective.measurements, state.points[0]
    frames, count = m.frames, m.points_per_frame
    terms = objective.linearise_chunk(state, slice(None))["reprojection"]
    blocks, slopes = terms.hessian[0], terms.gradient[0]
    cost = float(terms.cost)

    diagonal = torch.where(m.active[0], blocks.sum(0), points.new_tensor(IDENTITY)[:, None])
    hessian = points.new_zeros(frames, count, 3, count, 3)
    hessian.diagonal(dim1=1, dim2=3).copy_(m.by_frame(expand(diagonal)).permute(2, 0, 1, 3))
    hessian = hessian.flatten(3).flatten(1, 2)
    gradient = m.by_frame(slopes.sum(0)).permute(1, 2, 0).flatten(1)
    rows = cross_rows(blocks[None, 1:], points[None])[0]
    cross = m.by_frame(rows.flatten(0, 1)).permute(2, 3, 1, 0).flatten(1, 2)
    camera_hessian = torch.block_diag(*_by_tangent(rows, points))
    camera_gradient = _by_tangent(slopes[1:], points).flatten()

    if frame_residuals is not None:
        residuals, jacobian = _differentiate(frame_residuals, m.by_frame(points).permute(1, 2, 0))
        hessian = hessian + jacobian.mT @ jacobian
        gradient = gradient + (jacobian.mT @ residuals[..., None])[..., 0]
        cost += float(residuals.square().sum())
    if prior is not None:
        deviation = _tangents(prior, state)
        slope = (prior.information @ deviation[..., None])[..., 0]
        camera_hessian = camera_hessian + torch.block_diag(*prior.information)
        camera_gradient = camera_gradient + slope.flatten()
        cost += float((deviation * slope).sum())
    return _System(cost, camera_hessian, camera_gradient, cross, hessian, gradient)


def _by_tangent(slopes: Tensor, points: Tensor) -> Tensor:
    """Derivatives (..., 3, N) by the points as those by a camera's tangent, (..., 6): ``sum B^T g`` with B = [I, -[X]x]."""
    return torch.cat([slopes.sum(-1), torch.linalg.cross(points.expand_as(slopes), slopes, dim=-2).sum(-1)], dim=-1)


def _differentiate(frame_residuals: FrameResiduals, points: Tensor) -> tuple[Tensor, Tensor]:
    """Residuals (F, M) and their derivatives (F, M, 3 P) by the points of their own frame."""
    points = points.detach().requires_grad_()
    residuals = frame_residuals(points)
    count = residuals.shape[1]
    selected = torch.eye(count, dtype=points.dtype)[:, None].expand(count, len(points), count)
    (rows,) = torch.autograd.grad(residuals, points, selected, is_grads_batched=True)
    return residuals.detach(), rows.movedim(0, 1).flatten(2)


def _tangents(prior: CameraPrior, state: State) -> Tensor:
    """Small tangents (C - 1, 6) that lead from the prior's poses to the state's, to first order."""
    to_world = prior.rotations[0, 1:].mT
    turn = to_world @ state.rotations[0, 1:]
    shift = (to_world @ (state.translations[0, 1:] - prior.translations[0, 1:])[..., None])[..., 0]
    return torch.cat([shift, se3.vee(turn)], dim=1)


def _damped(matrices: Tensor, damping: float) -> Tensor:
    return matrices + damping * matrices.diagonal(dim1=-2, dim2=-1).diag_embed()
