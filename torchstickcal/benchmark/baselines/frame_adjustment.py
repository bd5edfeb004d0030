"""Bundle adjustment for baselines, with any residuals between the points of a frame, and with priors of the camera poses.

Levenberg-Marquardt with dense blocks, for one session. The reprojection is linearised by the library, the other residuals by
autograd. All points of a frame are eliminated together (Schur complement).
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
"""Whitened residuals (F, M) of points (F, P, 3); the residuals of a frame depend only on the points of this frame."""


class CameraPrior(NamedTuple):
    """A Gaussian prior of the camera poses."""

    rotations: Tensor
    """(1, C, 3, 3)"""
    translations: Tensor
    """(1, C, 3), metres"""
    information: Tensor
    """(C - 1, 6, 6), inverse covariance of the tangents (translation, rotation) of all cameras but the first"""


class Adjusted(NamedTuple):
    """Result of an adjustment."""

    state: State
    converged: bool
    reduced: Tensor
    """(6 (C - 1), 6 (C - 1)), information of the tangents of all cameras but the first, with the points eliminated"""


def adjust(
    measurements: Measurements,
    state: State,
    reprojection: ReprojectionLoss,
    frame_residuals: FrameResiduals | None = None,
    prior: CameraPrior | None = None,
    max_iterations: int = 50,
) -> Adjusted:
    """Minimise the sum of squared residuals over all points and over all cameras but the first.

    Args:
        measurements: of one session.
        state: at which to start.
        reprojection: loss of the reprojection.
        frame_residuals: further residuals between the points of a frame.
        prior: of the camera poses.
        max_iterations: largest number of steps.
    """
    objective = Objective(measurements, {"reprojection": reprojection})
    negligible = _EXACT_COST_PER_KEYPOINT * float(measurements.visible.sum())
    damping = _INITIAL_DAMPING
    system = _linearise(objective, state, frame_residuals, prior)
    converged = system.cost <= negligible
    for _ in range(max_iterations):
        if converged or damping > _MAX_DAMPING:
            break
        camera_step, point_step, predicted = system.step(damping)
        candidate = state.retracted(camera_step, point_step)
        candidate_system = _linearise(objective, candidate, frame_residuals, prior)
        decrease = system.cost - candidate_system.cost
        converged = abs(predicted) <= _COST_TOLERANCE * system.cost or candidate_system.cost <= negligible
        if decrease > 0:
            converged = converged or decrease <= _COST_TOLERANCE * system.cost
            state, system, damping = candidate, candidate_system, max(damping * 0.1, _MIN_DAMPING)
        else:
            damping *= 10
    return Adjusted(state, converged, system.reduce(0.0)[0])


@dataclass(frozen=True)
class _System:
    """Blocks of the normal equations at a state: n = 6 (C - 1) camera tangents, F frames with 3 P coordinates each."""

    cost: float
    camera_hessian: Tensor
    """(n, n)"""
    camera_gradient: Tensor
    """(n,)"""
    cross: Tensor
    """(F, 3 P, n), mixed second derivatives by points and cameras"""
    point_hessian: Tensor
    """(F, 3 P, 3 P)"""
    point_gradient: Tensor
    """(F, 3 P)"""

    def reduce(self, damping: float) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Eliminate the points.

        Returns:
            The reduced camera system (n, n), its gradient (n,), and of each frame ``L^-1 H_xc`` (F, 3 P, n) and the Cholesky
            factor ``L`` (F, 3 P, 3 P) of the damped point block.
        """
        lower = torch.linalg.cholesky(_damped(self.point_hessian, damping))
        half = torch.linalg.solve_triangular(lower, self.cross, upper=False)
        gradient = torch.linalg.solve_triangular(lower, self.point_gradient[..., None], upper=False)
        flat = half.flatten(0, 1)
        reduced = _damped(self.camera_hessian, damping) - flat.mT @ flat
        return reduced, self.camera_gradient - flat.mT @ gradient.flatten(), half, lower

    def step(self, damping: float) -> tuple[Tensor, Tensor, float]:
        """Steps of the cameras (1, C - 1, 6) and of the points (1, 3, F P), and the predicted decrease of the cost."""
        reduced, rhs, half, lower = self.reduce(damping)
        cameras = -torch.linalg.solve(reduced, rhs)
        gradient = torch.linalg.solve_triangular(lower, self.point_gradient[..., None], upper=False)
        points = -torch.linalg.solve_triangular(lower.mT, gradient + (half @ cameras)[..., None], upper=True)[..., 0]
        predicted = -float(self.camera_gradient @ cameras + (self.point_gradient * points).sum())
        return cameras.view(1, -1, 6), points.reshape(1, -1, 3).mT, predicted


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
    """Derivatives by the tangent of a camera (..., 6) from those by the points (..., 3, N): ``sum B^T g``, B = [I, -[X]x]."""
    return torch.cat([slopes.sum(-1), torch.linalg.cross(points.expand_as(slopes), slopes, dim=-2).sum(-1)], dim=-1)


def _differentiate(frame_residuals: FrameResiduals, points: Tensor) -> tuple[Tensor, Tensor]:
    """Residuals (F, M), and their derivatives (F, M, 3 P) by the points of the same frame."""
    points = points.detach().requires_grad_()
    residuals = frame_residuals(points)
    count = residuals.shape[1]
    selected = torch.eye(count, dtype=points.dtype)[:, None].expand(count, len(points), count)
    (rows,) = torch.autograd.grad(residuals, points, selected, is_grads_batched=True)
    return residuals.detach(), rows.movedim(0, 1).flatten(2)


def _tangents(prior: CameraPrior, state: State) -> Tensor:
    """Tangents (C - 1, 6) from the poses of the prior to those of the state, to first order."""
    to_world = prior.rotations[0, 1:].mT
    turn = to_world @ state.rotations[0, 1:]
    shift = (to_world @ (state.translations[0, 1:] - prior.translations[0, 1:])[..., None])[..., 0]
    return torch.cat([shift, se3.vee(turn)], dim=1)


def _damped(matrices: Tensor, damping: float) -> Tensor:
    """Matrices (..., N, N) with their diagonals multiplied by 1 + damping."""
    return matrices + damping * matrices.diagonal(dim1=-2, dim2=-1).diag_embed()
