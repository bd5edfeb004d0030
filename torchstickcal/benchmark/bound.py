"""The Cramér-Rao bound of the camera errors: the smallest mean errors that an unbiased method can have."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchstickcal.benchmark.cases import Case
from torchstickcal.geometry import se3
from torchstickcal.io.truth import Truth
from torchstickcal.losses import ReprojectionLoss, StickLengthLoss
from torchstickcal.metrics import pose_errors
from torchstickcal.model.measurements import Measurements
from torchstickcal.model.objective import Objective
from torchstickcal.model.state import State
from torchstickcal.model.unknowns import RigUnknowns
from torchstickcal.solvers.elimination.normal_equations import NormalEquations

_SIGMA_LENGTH_M = 1e-5
"""Practically exact: the keypoints of a frame determine the length far less accurately."""


@dataclass(frozen=True)
class Bound:
    """Smallest expected errors of an unbiased estimate, averaged over the cameras."""

    rotation_deg: float
    translation_m: float


def camera_bound(case: Case, draws: int = 2000, seed: int = 0, unknown: Sequence[str] = ()) -> Bound | None:
    """The Cramér-Rao bound of a case.

    It holds for a method that knows the inliers, their noise, the length of the stick and the intrinsics exactly. The
    covariance of the camera poses is the inverse of the reduced camera system at the truth. Errors are drawn from it, aligned
    and averaged like the errors of an estimate.

    Args:
        case: a session with true points.
        draws: number of drawn errors; the standard error of their mean is about 50 % / sqrt(draws).
        seed: of the draws.
        unknown: names of intrinsics or clock parameters that the method has to estimate too, see
            :data:`torchstickcal.model.unknowns.REFINEMENTS`.

    Returns:
        The bound; None if truth, noise or inliers are not known, or if the inliers do not determine the cameras.

    Example:
        >>> from torchstickcal.benchmark import camera_bound, sources
        >>> bound = camera_bound(sources("sports-stick-syn", 1)[0].load())
        >>> 0.001 < bound.rotation_deg < 0.003  # 0.1 px of noise, 3 cameras
        True
    """
    truth = case.truth
    if truth.points is None or case.sigma_px is None or case.inliers is None:
        return None
    observations = case.observations
    if truth.intrinsics is not None:
        observations = replace(observations, intrinsics=truth.intrinsics, distortion=truth.distortion)
    measurements = Measurements.of(observations).keeping(torch.from_numpy(case.inliers).flatten(1)[None])
    sigma_px = torch.from_numpy(case.sigma_px).flatten(1).clamp_min(1e-6)
    measurements = replace(measurements, confidence=measurements.visible / sigma_px.square())
    if unknown:
        unknowns = RigUnknowns.of(unknown, measurements.cameras)
        unknowns = replace(unknowns, prior_sigma=torch.full_like(unknowns.prior_sigma, torch.inf))
        measurements = replace(measurements, unknowns=unknowns)
    objective = Objective(measurements, {"reprojection": ReprojectionLoss(), "stick_length": StickLengthLoss(_SIGMA_LENGTH_M)})
    points = truth.points.flatten(0, 1).mT.contiguous()
    state = State(truth.rotations[None], truth.translations[None], points[None], measurements.unknowns.given)
    return expected_errors(NormalEquations(objective, state, cameras_free=True).reduced[0], truth, draws, seed)


def expected_errors(information: Tensor, truth: Truth, draws: int = 2000, seed: int = 0) -> Bound | None:
    """The mean errors of estimates that scatter around the true cameras as an information says.

    Args:
        information: inverse covariance of the tangents of all cameras but the first, (D, D), D >= 6 (C - 1).
        truth: the true cameras.
        draws, seed: as of :func:`camera_bound`.

    Returns:
        The errors; None if the information does not determine the cameras.
    """
    factor, failed = torch.linalg.cholesky_ex(information)
    if int(failed):
        return None
    normal = torch.randn(len(factor), draws, generator=torch.Generator().manual_seed(seed), dtype=factor.dtype)
    drawn = torch.linalg.solve_triangular(factor.mT, normal, upper=True).mT
    tangents = drawn[:, : 6 * (len(truth.rotations) - 1)].unflatten(1, (-1, 6))
    tangents = torch.nn.functional.pad(tangents, (0, 0, 1, 0))
    drawn = se3.retract(truth.rotations.expand(draws, -1, 3, 3), truth.translations.expand(draws, -1, 3), tangents)
    errors = pose_errors(*drawn, truth.rotations, truth.translations)
    return Bound(errors.mean_rotation_deg, errors.mean_translation_m)
