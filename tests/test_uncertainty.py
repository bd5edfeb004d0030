"""Covariances agree with dense linear algebra, with finite differences, and with the errors of simulated sessions."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from torchstickcal import Calibration, ObservationError, Observations, calibrate
from torchstickcal.config import InitialiseSettings
from torchstickcal.geometry import se3
from torchstickcal.io import Truth
from torchstickcal.losses import Loss, ReprojectionLoss, StickLengthLoss
from torchstickcal.model.measurements import Measurements
from torchstickcal.model.objective import Objective
from torchstickcal.model.state import State
from torchstickcal.pipeline.initialise import triangulated
from torchstickcal.simulate import Noise, golf_session
from torchstickcal.solvers.elimination.normal_equations import NormalEquations
from torchstickcal.solvers.newton import polish
from torchstickcal.solvers.uncertainty import (
    camera_covariance,
    centre_covariances,
    likelihood,
    point_covariances,
    relative_scale_std,
)


def deviation(calibration: Calibration, truth: Truth) -> torch.Tensor:
    """Tangents (6 (C - 1),) from the estimated poses to the true poses."""
    relative = truth.rotations @ truth.rotations[0].mT
    translations = truth.translations - relative @ truth.translations[0]
    back = calibration.rotations.mT
    twist = back @ relative - relative.mT @ calibration.rotations
    rotation = torch.stack([twist[:, 2, 1], twist[:, 0, 2], twist[:, 1, 0]], dim=1) / 2
    shift = (back @ (translations - calibration.translations)[..., None])[..., 0]
    return torch.cat([shift, rotation], dim=1)[1:].flatten()


def test_camera_covariance_is_the_camera_block_of_the_full_inverse(disturbed: tuple[Measurements, State]):
    """The solver gives the inverse of the full Hessian column by column."""
    measurements, state = disturbed
    sigma = torch.full((1, measurements.points_per_frame), 2.0, dtype=torch.float64)
    losses: dict[str, Loss] = {"stick_length": StickLengthLoss(0.01), "reprojection": ReprojectionLoss()}
    found = camera_covariance(likelihood(measurements, losses, sigma), state)[0]
    objective = Objective(measurements, {"reprojection": ReprojectionLoss(2.0), "stick_length": StickLengthLoss(0.01)})
    system = NormalEquations(objective, state, cameras_free=True)
    unit = torch.eye(18, dtype=torch.float64).view(18, 1, 3, 6)
    no_points = torch.zeros_like(state.points)
    no_unknowns = no_points.new_zeros(1, 0)
    columns = [system.solve(column, no_unknowns, no_points)[0].flatten() for column in unit]
    torch.testing.assert_close(found, torch.stack(columns), rtol=1e-8, atol=1e-14)


def test_covariances_of_centres_and_scale_follow_from_the_tangents():
    """The first-order propagation agrees with a small retraction."""
    generator = torch.Generator().manual_seed(0)
    truth = golf_session(cameras=3, frames=2)[1]
    rotations, translations = truth.rotations, truth.translations
    centres = se3.camera_centres(rotations, translations)
    tangents = 1e-6 * torch.randn(2, 6, generator=generator, dtype=torch.float64)
    moved = se3.camera_centres(*se3.retract(rotations[1:], translations[1:], tangents))
    covariance = tangents.flatten()[:, None] * tangents.flatten()
    shift = (moved - centres[1:])[..., None]
    torch.testing.assert_close(centre_covariances(centres, covariance)[1:], shift @ shift.mT, rtol=1e-4, atol=1e-18)
    arms = centres[1:] - centres[0]
    expected = float((arms * shift[..., 0]).sum() / arms.square().sum())
    assert float(relative_scale_std(centres, covariance)) == pytest.approx(abs(expected), rel=1e-4)


def test_covariance_of_a_point_includes_keypoints_and_cameras():
    """For known cameras it is the inverse of J^T J. Uncertain cameras add their propagated covariance."""
    observations, truth = golf_session(cameras=4, frames=2)
    assert truth.points is not None
    point = truth.points[0, :1]
    poses, lens = (truth.rotations, truth.translations), observations.cameras
    visible, sigma = torch.ones(4, 1, dtype=torch.bool), torch.tensor([2.0], dtype=torch.float64)
    still = torch.zeros(18, 18, dtype=torch.float64)

    def pixels(point: torch.Tensor, tangents: torch.Tensor) -> torch.Tensor:
        turned = se3.retract(truth.rotations[1:], truth.translations[1:], tangents.view(3, 6))
        rotations, translations = (torch.cat([v[:1], w]) for v, w in zip(poses, turned, strict=True))
        return lens.project((rotations @ point[0] + translations)[:, None])

    by_point = torch.autograd.functional.jacobian(lambda p: pixels(p, still[0]), point)
    jacobian = by_point.flatten(0, 2).flatten(1)
    expected = torch.linalg.inv(jacobian.mT @ jacobian / 4)
    (found,) = point_covariances(point, visible, sigma, poses, lens, still)
    torch.testing.assert_close(found, expected)

    mixed = torch.randn(18, 18, generator=torch.Generator().manual_seed(3), dtype=torch.float64) * 1e-3
    covariance = mixed @ mixed.mT
    steps = 1e-6 * torch.eye(18, dtype=torch.float64)
    by_tangents = torch.stack([(pixels(point, s) - pixels(point, -s)).flatten() / 2e-6 for s in steps], dim=1)
    carried = expected @ jacobian.mT @ by_tangents / 4
    (found,) = point_covariances(point, visible, sigma, poses, lens, covariance)
    torch.testing.assert_close(found, expected + carried @ covariance @ carried.mT, rtol=1e-5, atol=0)
    visible[1:] = False
    assert point_covariances(point, visible, sigma, poses, lens, still).isnan().all()


def test_covariance_agrees_with_simulated_errors():
    """The squared error divided by the covariance is 1 on average, for the cameras and for new points that they triangulate."""
    runs, normalised, ratios = 25, [], []
    for seed in range(runs):
        observations, truth = golf_session(cameras=4, frames=25, noise=Noise(sigma_px=1.0), seed=seed)
        exact = replace(observations, sticks=tuple(replace(stick, sigma_m=1e-5) for stick in observations.sticks))
        calibration = calibrate(exact)
        error = deviation(calibration, truth)
        normalised.append(float(error @ torch.linalg.solve(calibration.covariance, error)) / len(error))
        ratios.append(squared_error_over_predicted(calibration, observations, truth, seed))
    spread = (2 / (18 * runs)) ** 0.5
    assert abs(sum(normalised) / runs - 1) < 4 * spread + 0.05
    assert abs(sum(ratios) / runs - 1) < 0.15


def squared_error_over_predicted(calibration: Calibration, observations: Observations, truth: Truth, seed: int) -> float:
    """Mean squared error of new points, triangulated with the calibrated cameras, divided by the predicted variance."""
    generator = torch.Generator().manual_seed(seed)
    centre = truth.points.mean((0, 1))
    fresh = centre + 0.4 * torch.randn(200, 3, generator=generator, dtype=torch.float64)
    seen = observations.cameras.project((truth.rotations @ fresh.mT + truth.translations[..., None]).movedim(1, -1))
    noise = torch.randn(seen.shape, generator=generator, dtype=torch.float64)
    found = calibrate_points(calibration, seen + noise)
    error = found - (fresh @ truth.rotations[0].mT + truth.translations[0])
    return float((error / calibration.predict_std(found, sigma_px=1.0)).square().mean())


def calibrate_points(calibration: Calibration, keypoints: torch.Tensor) -> torch.Tensor:
    """Points (N, 3) that minimise the reprojection errors of keypoints (C, N, 2), with the cameras held fixed."""
    observations = Observations(
        keypoints[:, :, None],
        calibration.intrinsics,
        [],
        distortion=calibration.distortion,
    )
    measurements = Measurements.of(observations)
    poses = calibration.rotations[None], calibration.translations[None]
    points = triangulated(measurements, *poses, InitialiseSettings())
    objective = Objective(measurements, {"reprojection": ReprojectionLoss()})
    return polish(objective, State.of(*poses, points), cameras_free=False).points[0].mT


def test_precision_of_points_given_in_any_form(noisy: tuple[Observations, Truth]):
    calibration = calibrate(noisy[0])
    expected = calibration.predict_std(torch.tensor([[0.0, 0, 6], [0, 1, 7]], dtype=torch.float64))
    assert (expected > 0).all()
    for points in ([[0, 0, 6], [0, 1, 7]], torch.tensor([[0, 0, 6], [0, 1, 7]]), torch.tensor([[0, 0, 6.0], [0, 1, 7]]).half()):
        found = calibration.predict_std(points)
        assert found.dtype in (torch.float64, torch.float32)
        torch.testing.assert_close(found.double(), expected, rtol=1e-5, atol=0)
    for wrong in ([1.0, 2.0], "x", None):
        with pytest.raises(ObservationError, match="points"):
            calibration.predict_std(wrong)
    for noise in (0, "x", [1.0], 10**400):
        with pytest.raises(ObservationError, match="sigma_px"):
            calibration.predict_std([0, 0, 6], noise)
