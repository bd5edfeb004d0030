"""The core of Kineo (Javerliat et al., "Kineo: calibration-free metric motion capture from sparse RGB cameras", 2025).

Relative poses of all pairs of cameras, each refined on its own; rotation averaging and translation averaging over the graph of
pairs; bundle adjustment of a sample of the keypoints. The published method also estimates the intrinsics; here they are known.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchstickcal.benchmark.baselines.base import Estimate, Inputs, Listing, PublishedErrors, baseline
from torchstickcal.benchmark.baselines.joints import joint_measurements, scaled_by_height, triangulated
from torchstickcal.benchmark.baselines.reasons import CONVERGED, HEIGHT
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


@baseline(
    "kineo",
    Listing("Kineo", {"sota": PublishedErrors(0.075, 0.098)}, (HEIGHT, CONVERGED), position=23),
    needs=("height_m",),
    title_in_motion="Kineo, true mean height in motion",
)
def kineo(inputs: Inputs) -> Estimate:
    """Pairs, Sampson refinement, rotation and translation averaging, bundle adjustment of a sample, scale from the height.

    Args:
        inputs: needs ``height_m``.

    Raises:
        RigError: if the pairs do not connect all cameras.
    """
    observations = inputs.observations
    measurements = joint_measurements(observations)
    pairs = _related_pairs(measurements, [observations.camera_label(camera) for camera in range(observations.num_cameras)])
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
    return Estimate.of_state(state, "converged" if stop.converged else str(stop))


@dataclass(frozen=True)
class RelatedPair:
    """Relative pose of two cameras: ``x_second = R x_first + s direction`` with an unknown scale s."""

    first: int
    second: int
    rotation: Tensor
    """(3, 3)"""
    direction: Tensor
    """(3,), a unit vector in the second camera's frame"""
    weight: float
    """number of inliers"""


def average_rotations(cameras: int, pairs: list[RelatedPair]) -> Tensor:
    """Rotation averaging: rotations (C, 3, 3) of all cameras from those of the pairs; the first one is the identity.

    Chordal averaging minimises ``sum w |R_j - R_ij R_i|_F^2``. Without the constraint that the R are rotations the solution
    is given by the eigenvectors of the three smallest eigenvalues; they are projected onto rotations. Iterative re-weighting
    by the inverse of each pair's residual angle makes it an L1 average, which is robust to wrong pairs.
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
    """Translation averaging: translations (C, 3) of all cameras, up to scale, from the directions of the pairs.

    Minimises the part of ``c_i - c_j`` that is orthogonal to the direction of the pair, over camera centres of norm 1 in
    total. The translation of the first camera is 0.
    """
    cameras = len(rotations)
    weights = torch.tensor([pair.weight for pair in pairs], dtype=torch.float64)
    baselines = torch.stack([rotations[pair.second].mT @ pair.direction for pair in pairs])
    orthogonal = torch.eye(3, dtype=torch.float64) - baselines[:, :, None] * baselines[:, None]
    ends = torch.tensor([(pair.first, pair.second) for pair in pairs])
    signs = torch.nn.functional.one_hot(ends, cameras).to(weights)
    incidence = (signs[:, 0] - signs[:, 1])[:, 1:]
    rows = torch.einsum("kab,kc->kacb", orthogonal, incidence).flatten(2)
    matrix = torch.einsum("kai,kaj,k->ij", rows, rows, weights)
    centres = torch.linalg.eigh(matrix).eigenvectors[:, 0].view(-1, 3)
    centres = centres * (weights * ((incidence @ centres) * baselines).sum(1)).sum().sign()
    centres = torch.cat([centres.new_zeros(1, 3), centres])
    return -(rotations @ centres[..., None])[..., 0]


def refine_by_sampson(
    rotation: Tensor, direction: Tensor, first: Tensor, second: Tensor, sigma: float
) -> tuple[Tensor, Tensor]:
    """Refine the relative pose of a pair: Gauss-Newton on the Sampson distances, with a Huber kernel.

    Args:
        rotation: (3, 3). direction: (3,), a unit vector; ``x_second = R x_first + s direction``.
        first: homogeneous normalised image points in the first camera, (N, 3). second: in the second camera, (N, 3).
        sigma: standard deviation of the distances; the kernel is quadratic up to about this distance.

    Returns:
        The refined rotation (3, 3) and direction (3,).
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
    """Signed Sampson distances (N,) after a step (5,): rotation vector, then direction in ``plane`` (2, 3).

    Returns them twice: to be differentiated, and as the values.
    """
    essential = se3.hat(direction + step[3:] @ plane) @ rotation @ (torch.eye(3).to(step) + se3.hat(step[:3]))
    lines_second, lines_first = first @ essential.mT, second @ essential
    gradient = lines_second[:, :2].square().sum(1) + lines_first[:, :2].square().sum(1)
    distances = (second * lines_second).sum(1) / gradient.sqrt()
    return distances, distances


def _related_pairs(measurements: Measurements, labels: list[str]) -> list[RelatedPair]:
    """Relative poses of all pairs of cameras with enough common points, by RANSAC and refinement.

    Raises:
        RigError: if the pairs do not connect all cameras.
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
        isolated = ", ".join(label for camera, label in enumerate(labels) if camera not in linked)
        raise RigError(
            "the cameras have too few common points to be placed in one rig",
            where="keypoints",
            got=f"{isolated} not connected to the other cameras",
            expected=f"for each camera another one with at least {settings.min_common_points} common points that fit one pose",
        )
    return pairs
