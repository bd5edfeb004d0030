"""Estimates of the keypoint noise and of the acceleration."""

from __future__ import annotations

import pytest
import torch

from torchstickcal import calibrate
from torchstickcal.model.measurements import Measurements
from torchstickcal.model.noise import estimate_acceleration_m, estimate_sigma_px
from torchstickcal.model.state import State
from torchstickcal.simulate import Noise, golf_session


@pytest.mark.parametrize("cameras", [2, 3, 6])
@pytest.mark.parametrize("outliers", [0.0, 0.1])
def test_sigma_is_that_of_the_inliers(cameras: int, outliers: float):
    observations, _ = golf_session(cameras=cameras, frames=150, noise=Noise(1.5, missing=0.1, outliers=outliers))
    sigma = calibrate(observations).sigma_px
    assert sigma.mean().item() == pytest.approx(1.5, rel=0.12 if outliers else 0.05)


def test_points_get_different_sigmas_only_if_their_noise_differs():
    observations, truth = golf_session(cameras=5, frames=150)
    generator = torch.Generator().manual_seed(1)
    sigma = torch.ones(21, dtype=torch.float64)
    noise = torch.randn(observations.keypoints.shape, generator=generator, dtype=torch.float64)

    def estimated(sigma: torch.Tensor) -> torch.Tensor:
        pixels = (observations.keypoints + sigma[:, None] * noise).movedim(-1, 1).flatten(2)[None]
        measurements = Measurements.of(observations)
        measurements = Measurements(pixels, measurements.confidence, *list(vars(measurements).values())[2:])
        points = truth.points.flatten(0, 1).mT.contiguous()
        state = State.of(truth.rotations[None], truth.translations[None], points[None])
        return estimate_sigma_px(measurements, measurements.squared_residuals(state))[0]

    equal = estimated(sigma)
    assert equal.max() / equal.min() < 1.02
    sigma[10:] = 4.0
    different = estimated(sigma)
    torch.testing.assert_close(different / different[0], sigma, rtol=0.1, atol=0)


def test_acceleration_is_separated_from_noise():
    generator = torch.Generator().manual_seed(0)
    observations, _ = golf_session(cameras=3, frames=300)
    measurements = Measurements.of(observations)
    shape = (3, measurements.frames, measurements.points_per_frame)
    steps = 0.01 * torch.randn(shape, generator=generator, dtype=torch.float64)
    noise = 0.003 * torch.randn(shape, generator=generator, dtype=torch.float64)
    points = (steps.cumsum(1).cumsum(1) + noise).flatten(1)
    variance = torch.full((points.shape[1],), 0.003**2, dtype=torch.float64)
    (found,) = estimate_acceleration_m(measurements, points[None], variance[None])
    torch.testing.assert_close(found, torch.full_like(found, 0.01), rtol=0.1, atol=0)
