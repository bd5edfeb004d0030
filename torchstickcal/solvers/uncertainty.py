"""Covariances of cameras and points.

The inverse of the reduced camera system is the covariance of the cameras' tangents, including the uncertainty of the points,
where the errors of the keypoints are independent. Errors that last for several frames add to it.
The covariance of a point is the covariance of its triangulation plus the propagated covariance of the cameras. So no matrix
larger than the reduced camera system is inverted.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from torchstickcal.geometry import se3
from torchstickcal.geometry.cameras import Intrinsics
from torchstickcal.geometry.singular import covariance_root, definite, propagated
from torchstickcal.geometry.symmetric import backward, cholesky, forward
from torchstickcal.losses import Loss, ReprojectionLoss, StickLengthLoss
from torchstickcal.model.correlation import ErrorCorrelation
from torchstickcal.model.measurements import Measurements
from torchstickcal.model.objective import Objective
from torchstickcal.model.state import State
from torchstickcal.solvers.correlated import inflation
from torchstickcal.solvers.elimination.cross_blocks import cross_rows
from torchstickcal.solvers.elimination.normal_equations import NormalEquations

_CHUNK_POINTS = 2000


def likelihood(measurements: Measurements, losses: Mapping[str, Loss], sigma_px: Tensor) -> Objective:
    """The negative log-likelihood for normally distributed errors, times 2. Its Hessian is the inverse covariance.

    If no loss on the stick lengths has a standard deviation, the tolerances of the sticks are used.

    Args:
        measurements: the inliers.
        losses: the losses of the stage that estimated the cameras. Losses with a weight other than 1 are ignored, because their
            sigma is not a standard deviation.
        sigma_px: noise of each point's keypoints, (B, P), pixels.
    """
    likelihoods = {name: loss.likelihood(sigma_px) for name, loss in losses.items()}
    normal: dict[str, Loss] = {name: loss for name, loss in likelihoods.items() if loss is not None}
    if not any(isinstance(loss, StickLengthLoss) for loss in normal.values()):
        normal["stick_length"] = StickLengthLoss(measurements.stick_sigma_m)
    return Objective(measurements, normal)


def camera_covariance(
    objective: Objective, state: State, correlation: ErrorCorrelation | None = None, times: Tensor | None = None
) -> Tensor:
    """Covariance of the cameras, (B, 6 (C - 1) + K, 6 (C - 1) + K).

    Its rows are the tangents of all cameras but the first (translation in metres, rotation in radians), then the K lens and
    clock unknowns. Along undetermined directions the variance is far beyond anything that is known.

    Args:
        objective: the likelihood, from :func:`likelihood`.
        state: the solution.
        correlation: of the keypoint errors; None where they are independent.
        times: (B, P), as many keypoints of each point count as one in the likelihood; None for 1.
    """
    root = covariance_root(NormalEquations(objective, state, cameras_free=True).reduced)
    if correlation is None or not correlation.lasts:
        return root @ root.mT
    times = torch.ones_like(correlation.times) if times is None else times
    return definite(root @ inflation(objective, state, root, correlation, times) @ root.mT)


def ruler_covariance(measurements: Measurements, state: State, sigma_px: Tensor) -> Tensor:
    """Covariance that errors of the sticks' given lengths add, (6 (C - 1) + K, 6 (C - 1) + K), for one session.

    A length that is wrong is wrong in every frame: the whole scene has another scale. Where several sticks are given, each has
    the share of the scale that it determines.

    Args:
        measurements: the inliers.
        state: the solution.
        sigma_px: noise of each point's keypoints, (B, P).
    """
    m = measurements
    noise = m.by_frame(point_variances(m, state, sigma_px))[0][:, m.sticks].sum(-1)
    tolerance, lengths = m.stick_sigma_m, m.lengths_m[0]
    information = (lengths.square() / (tolerance.square() + noise)).where(m.stick_active[0], 0.0).sum(0)
    share = information / information.sum().clamp_min(1e-300)
    return scale_covariance(m, state, float((share * tolerance / lengths).square().sum().sqrt()))


def scale_covariance(measurements: Measurements, state: State, std: float) -> Tensor:
    """Covariance (6 (C - 1) + K, 6 (C - 1) + K) that an error of the whole scene's scale adds, for one session.

    Args:
        measurements: the session.
        state: the solution.
        std: standard deviation of the scale, as a share of it.
    """
    direction = _scale_direction(measurements, state)
    return std**2 * torch.outer(direction, direction)


def without_scale(covariance: Tensor, measurements: Measurements, state: State) -> Tensor:
    """A covariance (6 (C - 1) + K, 6 (C - 1) + K) of a session whose scale is given, where the keypoints say nothing of it."""
    direction = _scale_direction(measurements, state)
    unit = direction / direction.norm()
    kept = torch.eye(len(unit), dtype=unit.dtype, device=unit.device) - torch.outer(unit, unit)
    return kept @ covariance @ kept


def _scale_direction(measurements: Measurements, state: State) -> Tensor:
    """How cameras' tangents and further unknowns (6 (C - 1) + K) change with the logarithm of the scale."""
    centres = (state.rotations[0].mT @ state.translations[0][..., None])[1:, :, 0]
    tangents = torch.nn.functional.pad(centres, (0, 3)).flatten()
    return torch.nn.functional.pad(tangents, (0, measurements.unknowns.count))


def point_variances(measurements: Measurements, state: State, sigma_px: Tensor) -> Tensor:
    """Variance of each point for known cameras, mean over the three axes, (B, N), square metres. Infinite for points not seen.

    Args:
        measurements: the inliers.
        state: the cameras and points.
        sigma_px: noise of each point's keypoints, (B, P).
    """
    objective = Objective(measurements, {"reprojection": ReprojectionLoss(sigma_px[:, None, None])})
    variance = objective.point_variance(state)
    return variance.where(measurements.active, torch.inf)


def centre_covariances(centres: Tensor, covariance: Tensor) -> Tensor:
    """Covariances (C, 3, 3) of camera centres (C, 3), square metres, from the covariance of the tangents. Zero for camera 0."""
    jacobian = -_point_jacobian(centres[1:])
    of_all = torch.stack([torch.nn.functional.pad(own, (6 * c, len(covariance) - 6 * c - 6)) for c, own in enumerate(jacobian)])
    return torch.nn.functional.pad(propagated(of_all, covariance), (0, 0, 0, 0, 1, 0))


def relative_scale_std(centres: Tensor, covariance: Tensor) -> Tensor:
    """Relative standard deviation of the scale of the rig, for camera centres (C, 3) and the covariance of the tangents.

    The scale is the factor that best fits the camera centres to their true positions, relative to the first one.
    """
    arms = centres[1:] - centres[0]
    jacobian = -(arms[:, None] @ _point_jacobian(centres[1:])).flatten() / arms.square().sum()
    return propagated(jacobian[None], covariance)[0, 0].sqrt()


def point_covariances(
    points: Tensor, visible: Tensor, sigma_px: Tensor, poses: tuple[Tensor, Tensor], cameras: Intrinsics, covariance: Tensor
) -> Tensor:
    """Covariances (N, 3, 3) of triangulated points, square metres. NaN for points that fewer than two cameras see.

    Args:
        points: (N, 3), metres.
        visible: (C, N), True if a camera sees a point.
        sigma_px: (N,), noise of each point's keypoints, pixels.
        poses: rotations (C, 3, 3) and translations (C, 3) of all cameras.
        cameras: intrinsics of the C cameras.
        covariance: covariance of the cameras' tangents, (6 (C - 1), 6 (C - 1)).
    """
    _, triangulation, by_tangents = triangulation_terms(points, visible, sigma_px, poses, cameras)
    return triangulation + propagated(by_tangents, covariance)


def triangulation_terms(
    points: Tensor,
    visible: Tensor,
    sigma_px: Tensor,
    poses: tuple[Tensor, Tensor],
    cameras: Intrinsics,
    pixels: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """How points follow from keypoints and cameras, to first order. NaN for points that fewer than two cameras see.

    Args:
        points: (N, 3), metres. visible, sigma_px, poses, cameras: as of :func:`point_covariances`.
        pixels: (C, N, 2), keypoints; None for the points' own projections.

    Returns:
        The steps (N, 3) to the points that fit the keypoints best, zero without keypoints; the covariances (N, 3, 3) that the
        keypoints' noise gives; and the derivatives (N, 3, 6 (C - 1)) with respect to the cameras' tangents.
    """
    tangents = 6 * (len(poses[0]) - 1)
    found = points.new_empty(len(points), 3), points.new_empty(len(points), 3, 3), points.new_empty(len(points), 3, tangents)
    for first in range(0, len(points), _CHUNK_POINTS):
        part = slice(first, first + _CHUNK_POINTS)
        of_part = None if pixels is None else pixels[:, part]
        terms = _chunk_terms(points[part].mT[None], visible[:, part], sigma_px[part], poses, cameras, of_part)
        for whole, term in zip(found, terms, strict=True):
            whole[part] = term
    known = (visible.sum(0) >= 2) & points.isfinite().all(1)
    steps, covariances, by_tangents = found
    return (
        steps.where(known[:, None], torch.nan),
        covariances.where(known[:, None, None], torch.nan),
        by_tangents.where(known[:, None, None], torch.nan),
    )


def _chunk_terms(
    points: Tensor,
    visible: Tensor,
    sigma_px: Tensor,
    poses: tuple[Tensor, Tensor],
    cameras: Intrinsics,
    pixels: Tensor | None,
) -> tuple[Tensor, Tensor, Tensor]:
    """``-H_xx^-1 g``, ``H_xx^-1`` and ``-H_xx^-1 H_xc`` of points (1, 3, n)."""
    rotations, translations = poses
    points = points.nan_to_num()
    points_cam = se3.moved(rotations[None], translations[None], points)
    information = (visible & (points_cam[0, :, 2] > 0)) / sigma_px.square()
    keypoints = torch.zeros_like(points_cam[:, :, :2]) if pixels is None else pixels.movedim(-1, 1)[None].nan_to_num()
    terms = ReprojectionLoss().linearise(points_cam, rotations[None], keypoints, information[None], cameras.batched())
    blocks = terms.hessian  # of Gauss-Newton, which does not depend on the keypoints
    lower = cholesky(blocks.sum(1))
    rows = cross_rows(blocks[:, 1:], points).flatten(1, 2)
    by_tangents = -backward(lower[:, None], forward(lower[:, None], rows))[0]
    identity = torch.eye(3).to(points)[..., None]
    triangulation = backward(lower[0, None], forward(lower[0, None], identity)).movedim(-1, 0)
    gradient = torch.zeros_like(points[0]) if pixels is None else terms.gradient.sum(1)[0]
    return -(triangulation @ gradient.mT[..., None])[..., 0], triangulation, by_tangents.movedim(-1, 0).mT


def _point_jacobian(points: Tensor) -> Tensor:
    """Derivative of ``Exp(tangent) X`` with respect to the tangent: ``[I, -[X]x]`` (..., 3, 6) for points (..., 3)."""
    identity = torch.eye(3).to(points).expand(*points.shape, 3)
    return torch.cat([identity, -se3.hat(points)], dim=-1)
