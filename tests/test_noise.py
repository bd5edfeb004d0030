"""Estimates of the keypoint noise and of the acceleration."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from torchstickcal import calibrate
from torchstickcal.model.measurements import Measurements
from torchstickcal.model.noise import estimate_acceleration_m, estimate_sigma_px
from torchstickcal.model.state import State
from torchstickcal.simulate import Noise, SessionSpec, golf_session
from torchstickcal.simulate.regimes import DetectorNoise


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


def test_acceleration_is_separated_from_noise_and_follows_the_motion():
    generator = torch.Generator().manual_seed(0)
    observations, _ = golf_session(cameras=3, frames=300)
    measurements = Measurements.of(observations)
    shape = (3, measurements.frames, measurements.points_per_frame)
    steps = 0.01 * torch.randn(shape, generator=generator, dtype=torch.float64)
    noise = 0.003 * torch.randn(shape, generator=generator, dtype=torch.float64)
    variance = torch.full((shape[1] * shape[2],), 0.003**2, dtype=torch.float64)

    def estimated(steps: torch.Tensor) -> torch.Tensor:
        points = (steps.cumsum(1).cumsum(1) + noise).flatten(1)
        (found,) = estimate_acceleration_m(measurements, points[None], variance[None])
        return found.square()

    uniform = estimated(steps).mean(0).sqrt()
    torch.testing.assert_close(uniform, torch.full_like(uniform, 0.01), rtol=0.12, atol=0)
    torch.testing.assert_close(uniform.mean().item(), 0.01, rtol=0.02, atol=0)
    swing = estimated(steps * (torch.arange(shape[1]) >= 150)[:, None])
    assert swing[:130].mean() < 0.004**2  # drawn a little to the mean over all frames
    assert 0.009**2 < swing[170:].mean() < 0.011**2


@pytest.mark.parametrize("sport", ["kendo", "golf"])
def test_a_swing_is_not_smoothed_away_where_errors_last(sport: str):
    """A constant error in each camera makes the noise of a joint larger, and not its second differences."""
    session = SessionSpec(sport, sport, seed=15, cameras=4, frames=80, fps=30.0, regimes=(DetectorNoise(1.0, 1.0),)).generate()
    shift = 5.0 * torch.randn(4, 1, 21, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    shift[:, :, -2:] = 0.0
    found = calibrate(replace(session.observations, keypoints=session.observations.keypoints + shift))
    in_sigmas = (found.residuals_px.norm(dim=-1) / found.sigma_px)[found.inliers]
    assert in_sigmas.max() < 8.0
