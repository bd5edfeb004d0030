"""The core of Kineo (Javerliat et al., "Kineo: calibration-free metric motion capture from sparse RGB cameras", 2025).

Relative poses of all pairs, refined one by one; rotations averaged over the graph of pairs, then positions; an adjustment of
cameras and a sample of the keypoints. The intrinsics, which the published method estimates too, are known here.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchstickcal.benchmark.baselines.base import (
    Estimate,
    Inputs,
    joint_measurements,
    required,
    scaled_by_height,
    triangulated,
)
from torchstickcal.config import InitialiseSettings
from torchstickcal.errors import RigError
from torchstickcal.geometry import se3
from torchstickcal.losses import Huber, ReprojectionLoss
from torchstickcal.metrics import rotation_angle
from torchstickcal.model.measurements import Measurements
from torchstickcal.model.objective import Objective
from torchstickcal.pipeline.initialise.pairs import relate
from torchstickcal.pipeline.initialise.views import Views, spread
from torchstickcal.solvers import Termination, gauss_newton

_SAMPLED_POINTS = 200
_REFINEMENTS = 5
_REWEIGHTINGS = 20
_SMALLEST_RESIDUAL = 1e-6


def kineo(inputs: Inputs) -> Estimate:
    """Pairs, Sampson refinement, rotation and translation averaging, adjustment of a sample, height.

    Args:
        inputs: needs ``height_m``.

    Raises:
        MissingInputError: if the height is not given.
        RigError: if the cameras do not hang together.
    """
    observations = inputs.observations
    required(inputs, "height_m")
    measurements = joint_measurements(observations)
    pairs = _related(measurements, [observations.camera_label(camera) for camera in range(observations.num_cameras)])
    rotations = average_rotations(observations.num_cameras, pairs)
    translations = average_translations(rotations, pairs)

    active = measurements.active[0].nonzero()[:, 0]
    sample = torch.zeros_like(measurements.active[0])
    sample[active[torch.from_numpy(spread(len(active), _SAMPLED_POINTS))]] = True
    sampled = measurements.keeping(sample)
    objective = Objective(sampled, {"reprojection": ReprojectionLoss(kernel=Huber())})
    outcome = gauss_newton(
        objective,
        triangulated(sampled, rotations[None], translations[None]),
        cameras_free=True,
        termination=Termination(),
        stage="sample",
        listener=lambda record: None,
    )
    whole = triangulated(measurements, outcome.state.rotations, outcome.state.translations)
    state = scaled_by_height(inputs, measurements, whole)
    stop = outcome.stops[0]
    return Estimate.of(state, "converged" if stop.converged else str(stop))


@dataclass(frozen=True)
class RelatedPair:
    """Two cameras' relative pose: ``x_second = R x_first + s direction``."""

    first: int
    second: int
    rotation: Tensor
    """(3, 3)"""
    direction: Tensor
    """(3,), a unit vector in the second camera's frame"""
    weight: float
    """inliers"""


def average_rotations(cameras: int, pairs: list[RelatedPair]) -> Tensor:
    """Rotations (C, 3, 3) that fit those of the pairs, the first one being the identity.

    The chordal problem ``min sum w |R_j - R_ij R_i|_F^2`` is linear without the constraint: the eigenvectors of the three
    least eigenvalues, laid onto the nearest rotations. Re-weighting by the inverse of each pair's angle makes it the L1
    average.
    """
    weights = torch.tensor([pair.weight for pair in pairs], dtype=torch.float64)
    relative = torch.stack([pair.rotation for pair in pairs])
    firsts, seconds = [pair.first for pair in pairs], [pair.second for pair in pairs]
    rotations, current = relative, weights
    for _ in range(_REWEIGHTINGS):
        matrix = weights.new_zeros(cameras, cameras, 3, 3)
        for pair, weight in zip(pairs, current, strict=True):
            matrix[pair.first, pair.first] += weight * torch.eye(3)
            matrix[pair.second, pair.second] += weight * torch.eye(3)
            matrix[pair.second, pair.first] -= weight * pair.rotation
            matrix[pair.first, pair.second] -= weight * pair.rotation.mT
        vectors = torch.linalg.eigh(matrix.movedim(2, 1).reshape(3 * cameras, 3 * cameras)).eigenvectors[:, :3]
        blocks = vectors.view(cameras, 3, 3)
        u, _, vh = torch.linalg.svd(blocks * torch.det(blocks).sum().sign())
        rotations = u @ vh @ (u[0] @ vh[0]).mT
        angles = rotation_angle(relative @ rotations[firsts] @ rotations[seconds].mT)
        current = weights / angles.clamp_min(_SMALLEST_RESIDUAL)
    return rotations


def average_translations(rotations: Tensor, pairs: list[RelatedPair]) -> Tensor:
    """Translations (C, 3), up to scale, whose centres lie along the pairs' directions; zero for the first camera.

    The part of ``c_i - c_j`` across the direction of each pair is to vanish, all centres together having length 1.
    """
    cameras = len(rotations)
    weights = torch.tensor([pair.weight for pair in pairs], dtype=torch.float64)
    baselines = torch.stack([rotations[pair.second].mT @ pair.direction for pair in pairs])
    across = torch.eye(3, dtype=torch.float64) - baselines[:, :, None] * baselines[:, None]
    ends = torch.tensor([(pair.first, pair.second) for pair in pairs])
    signs = torch.nn.functional.one_hot(ends, cameras).to(weights)
    incidence = (signs[:, 0] - signs[:, 1])[:, 1:]
    rows = torch.einsum("kab,kc->kacb", across, incidence).flatten(2)
    matrix = torch.einsum("kai,kaj,k->ij", rows, rows, weights)
    centres = torch.linalg.eigh(matrix).eigenvectors[:, 0].view(-1, 3)
    centres = centres * (weights * ((incidence @ centres) * baselines).sum(1)).sum().sign()
    centres = torch.cat([centres.new_zeros(1, 3), centres])
    return -(rotations @ centres[..., None])[..., 0]


def refine_by_sampson(
    rotation: Tensor, direction: Tensor, first: Tensor, second: Tensor, sigma: float
) -> tuple[Tensor, Tensor]:
    """Gauss-Newton on the Sampson distances of a pair's rays, robustly, over its rotation and its direction.

    Args:
        rotation: (3, 3) and direction: (3,), ``x_second = R x_first + s direction``.
        first: (N, 3) and second: (N, 3), homogeneous normalised coordinates.
        sigma: distance at which the robust kernel starts to bend.
    """
    for _ in range(_REFINEMENTS):
        plane = torch.linalg.svd(direction[None]).Vh[1:]
        zero = rotation.new_zeros(5)
        jacobian, residuals = torch.func.jacfwd(_sampson_distances, has_aux=True)(
            zero, rotation, direction, plane, first, second
        )
        weights = Huber().weight((residuals / sigma).square())[:, None]
        step = -torch.linalg.solve(jacobian.mT @ (weights * jacobian), (jacobian * weights).mT @ residuals)
        rotation = rotation @ se3.exp(torch.cat([zero[:3], step[:3]]))[0]
        direction = torch.nn.functional.normalize(direction + step[3:] @ plane, dim=0)
    return rotation, direction


def _sampson_distances(
    step: Tensor, rotation: Tensor, direction: Tensor, plane: Tensor, first: Tensor, second: Tensor
) -> tuple[Tensor, Tensor]:
    """Signed Sampson distances (N,), twice, at a small step: three of the rotation, two of the direction in a plane."""
    essential = se3.hat(direction + step[3:] @ plane) @ rotation @ (torch.eye(3).to(step) + se3.hat(step[:3]))
    lines_second, lines_first = first @ essential.mT, second @ essential
    gradient = lines_second[:, :2].square().sum(1) + lines_first[:, :2].square().sum(1)
    distances = (second * lines_second).sum(1) / gradient.sqrt()
    return distances, distances


def _related(measurements: Measurements, labels: list[str]) -> list[RelatedPair]:
    """All pairs of cameras with enough in common, related by RANSAC and refined.

    Raises:
        RigError: if they leave a camera out.
    """
    settings, views = InitialiseSettings(), Views(measurements)
    common, cameras = views.common(), range(len(labels))
    pairs: list[RelatedPair] = []
    for first, second in ((i, j) for i in cameras for j in cameras if i < j and common[i, j] >= settings.min_common_points):
        found = relate(views, first, second, max_points=settings.max_points, threshold_px=settings.threshold_px)
        if found.inliers >= settings.min_common_points:
            pose = found.poses[0]
            rays, seen = views.rays([first, second], (views.visible[first] & views.visible[second]).nonzero()[0])
            a, b = (torch.nn.functional.pad(torch.from_numpy(r[:, seen.all(0)].T), (0, 1), value=1.0) for r in rays)
            sigma = 1 / float(views.focal_px[[first, second]].mean())
            refined = refine_by_sampson(torch.from_numpy(pose.rotation), torch.from_numpy(pose.translation), a, b, sigma)
            pairs.append(RelatedPair(first, second, *refined, float(found.inliers)))
    linked = {0}
    for _ in cameras:
        linked = linked.union(*({pair.first, pair.second} for pair in pairs if linked & {pair.first, pair.second}))
    if len(linked) < len(labels):
        raise RigError(
            "cameras see too little in common to be placed in one rig",
            where="keypoints",
            got=f"{', '.join(label for camera, label in enumerate(labels) if camera not in linked)} cut off",
            expected=f"at least {settings.min_common_points} common points that fit one pose, between some pair",
        )
    return pairs
