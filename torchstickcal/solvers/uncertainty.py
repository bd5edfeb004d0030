"""How uncertain cameras and points are: covariances from the reduced camera system.

The inverse of the reduced system is the covariance of the cameras' tangents, the points' share included; a point's own
covariance is that of its triangulation, plus what the cameras' uncertainty carries into it. Nothing larger is ever inverted.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from torchstickcal.geometry import se3
from torchstickcal.geometry.cameras import Intrinsics
from torchstickcal.geometry.symmetric import backward, cholesky, forward
from torchstickcal.losses import Loss, ReprojectionLoss, StickLengthLoss
from torchstickcal.model.measurements import Measurements
from torchstickcal.model.objective import Objective
from torchstickcal.model.state import State
from torchstickcal.solvers.elimination.cross_blocks import cross_rows
from torchstickcal.solvers.elimination.normal_equations import NormalEquations

_POINTS_AT_ONCE = 2000
_OPEN = 1e-12


def likelihood(measurements: Measurements, losses: Mapping[str, Loss], sigma_px: Tensor) -> Objective:
    """The objective of normally distributed errors: its Hessian is the inverse covariance.

    Sticks count with their own tolerances where no loss says how well their lengths are known.

    Args:
        measurements: those that took part.
        losses: of the stage that adjusted the cameras; those with a weight other than 1 have no standard deviation, and are
            left out.
        sigma_px: noise of each point's keypoints, (B, P), pixels.
    """
    found = {name: loss.likelihood(sigma_px) for name, loss in losses.items()}
    normal: dict[str, Loss] = {name: loss for name, loss in found.items() if loss is not None}
    if not any(isinstance(loss, StickLengthLoss) for loss in normal.values()):
        normal["stick_length"] = StickLengthLoss(measurements.stick_sigma_m)
    return Objective(measurements, normal)


def camera_covariance(objective: Objective, state: State) -> Tensor:
    """Covariance of the tangents of all cameras but the first, metres and radians, and then of the cameras' K further unknowns.

    (B, 6 (C - 1) + K, 6 (C - 1) + K). A direction that nothing determines, as the scale without a stick, is left out.

    Args:
        objective: of normally distributed errors, :func:`likelihood`.
        state: the solution.
    """
    information = NormalEquations(objective, state, cameras_free=True).reduced
    scale = information.diagonal(dim1=1, dim2=2).clamp_min(1e-300).rsqrt()
    values, vectors = torch.linalg.eigh(information * scale[:, :, None] * scale[:, None])
    inverse = torch.where(values > _OPEN * values[:, -1:], values.reciprocal(), 0.0)
    vectors = vectors * scale[..., None]
    return (vectors * inverse[:, None]) @ vectors.mT


def point_variances(measurements: Measurements, state: State, sigma_px: Tensor) -> Tensor:
    """Mean variance along the axes of each point (B, N), the cameras known, square metres; infinite where none is seen.

    Args:
        measurements: those that took part.
        state: the cameras and points.
        sigma_px: noise of each point's keypoints, (B, P).
    """
    objective = Objective(measurements, {"reprojection": ReprojectionLoss(sigma_px[:, None, None])})
    variance = NormalEquations(objective, state, cameras_free=False).point_variance().double()
    return variance.where(measurements.active, torch.inf)


def centre_covariances(centres: Tensor, covariance: Tensor) -> Tensor:
    """Covariances (C, 3, 3) of camera centres (C, 3), square metres, of that of the tangents; zero for the first."""
    by_tangents = -_motion(centres[1:])
    blocks = covariance.unflatten(0, (-1, 6)).unflatten(2, (-1, 6)).diagonal(dim1=0, dim2=2).movedim(-1, 0)
    return torch.nn.functional.pad(by_tangents @ blocks @ by_tangents.mT, (0, 0, 0, 0, 1, 0))


def relative_scale_std(centres: Tensor, covariance: Tensor) -> Tensor:
    """Standard deviation, as a share, of the scale that lays the camera centres (C, 3) onto their true places."""
    by_tangents = -(centres[1:, None] @ _motion(centres[1:])).flatten() / centres.square().sum()
    return (by_tangents @ covariance @ by_tangents).clamp_min(0.0).sqrt()


def point_covariances(
    points: Tensor, visible: Tensor, sigma_px: Tensor, poses: tuple[Tensor, Tensor], cameras: Intrinsics, covariance: Tensor
) -> Tensor:
    """Covariances (N, 3, 3) of triangulated points, square metres; NaN where fewer than two cameras see a point.

    Args:
        points: (N, 3), metres.
        visible: (C, N), which camera sees which point.
        sigma_px: (N,), noise of a point's keypoints.
        poses: rotations (C, 3, 3) and translations (C, 3) of all cameras.
        cameras: the C cameras.
        covariance: of the cameras' tangents, (6 (C - 1), 6 (C - 1)).
    """
    found = points.new_empty(len(points), 3, 3)
    for first in range(0, len(points), _POINTS_AT_ONCE):
        part = slice(first, first + _POINTS_AT_ONCE)
        found[part] = _point_covariances(points[part].mT[None], visible[:, part], sigma_px[part], poses, cameras, covariance)
    return found.where(((visible.sum(0) >= 2) & points.isfinite().all(1))[:, None, None], torch.nan)


def _point_covariances(
    points: Tensor, visible: Tensor, sigma_px: Tensor, poses: tuple[Tensor, Tensor], cameras: Intrinsics, covariance: Tensor
) -> Tensor:
    rotations, translations = poses
    points = points.nan_to_num()
    points_cam = se3.moved(rotations[None], translations[None], points)
    information = (visible & (points_cam[0, :, 2] > 0)) / sigma_px.square()
    nothing = torch.zeros_like(points_cam[:, :, :2])
    blocks = ReprojectionLoss().linearise(points_cam, rotations[None], nothing, information[None], cameras.batched()).hessian
    lower = cholesky(blocks.sum(1))
    rows = cross_rows(blocks[:, 1:], points).flatten(1, 2)
    carried = backward(lower[:, None], forward(lower[:, None], rows))[0]
    identity = torch.eye(3).to(points)[..., None]
    own = backward(lower[0, None], forward(lower[0, None], identity))
    return own.movedim(-1, 0) + torch.einsum("ian,ij,jbn->nab", carried, covariance, carried)


def _motion(points: Tensor) -> Tensor:
    """How tangents move a point of the world, ``[I, -[X]x]`` (..., 3, 6) of points (..., 3)."""
    identity = torch.eye(3).to(points).expand(*points.shape, 3)
    return torch.cat([identity, -se3.hat(points)], dim=-1)
