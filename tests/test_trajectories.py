"""Positions and velocities of points between frames."""

from __future__ import annotations

import pytest
import torch

from torchstickcal.model.trajectories import Trajectories
from torchstickcal.simulate import SessionSpec

THREE_VIEWS = torch.tensor(3)


def swing(fps: float, frames: int = 120) -> tuple[torch.Tensor, torch.Tensor]:
    """Points (3, F, P) of a golf swing at the frames, and halfway between the frames."""
    motion = SessionSpec("swing", "golf", 3).motion
    times = torch.arange(frames) / fps + 1.0
    return tuple(torch.from_numpy(motion.points((times + delay / fps).numpy())).movedim(2, 0) for delay in (0.0, 0.5))  # pyright: ignore[reportReturnType]


def half_frame_motion(points: torch.Tensor, variance: torch.Tensor, views: torch.Tensor = THREE_VIEWS) -> torch.Tensor:
    """Motion of the points (3, F, P) in half a frame, by the trajectories."""
    frames, count = points.shape[1:]
    polynomials = Trajectories(points, variance, views).polynomials(slice(0, frames))
    delays = torch.full((1, frames * count), 0.5, dtype=torch.float64)
    return (polynomials.positions(delays) - polynomials.positions(0 * delays))[0].unflatten(1, (frames, count))


@pytest.mark.parametrize("gaps", [False, True])
def test_polynomials_of_low_degree_are_reproduced(gaps: bool):
    time = torch.arange(40, dtype=torch.float64)[:, None]
    points = torch.stack([0.1 * time, 1 - 0.01 * time**2, 2 + 1e-4 * time**3 - 1e-5 * time**4])
    variance = torch.full((40, 1), 1e-18, dtype=torch.float64)
    if gaps:
        variance[torch.tensor([3, 10, 11, 12, 25, 30])] = torch.inf
    polynomials = Trajectories(points, variance, THREE_VIEWS).polynomials(slice(0, 40))
    delays = torch.linspace(-0.9, 0.9, 40, dtype=torch.float64)[None]
    t = time[:, 0] + delays[0]
    positions = torch.stack([0.1 * t, 1 - 0.01 * t**2, 2 + 1e-4 * t**3 - 1e-5 * t**4])
    velocities = torch.stack([torch.full_like(t, 0.1), -0.02 * t, 3e-4 * t**2 - 4e-5 * t**3])
    inner = slice(3, -3)
    torch.testing.assert_close(polynomials.positions(delays)[0, :, inner], positions[:, inner], rtol=0, atol=1e-5)
    torch.testing.assert_close(polynomials.velocities(delays)[0, :, inner], velocities[:, inner], rtol=0, atol=1e-5)
    assert float(polynomials.interpolation_std_m(delays)[0, inner].max()) < 1e-3


def test_a_slice_of_frames_gives_the_same_polynomials():
    points, _ = swing(60.0)
    trajectories = Trajectories(points, torch.full(points.shape[1:], 1e-6, dtype=torch.float64), THREE_VIEWS)
    delays = torch.full((1, 120 * 21), 0.3, dtype=torch.float64)
    whole = trajectories.polynomials(slice(0, 120)).positions(delays).unflatten(2, (120, 21))
    part = trajectories.polynomials(slice(50, 70)).positions(delays[:, : 20 * 21]).unflatten(2, (20, 21))
    torch.testing.assert_close(part, whole[:, :, 50:70], rtol=0, atol=1e-12)


@pytest.mark.parametrize(("fps", "largest_mm"), [(120.0, 0.3), (60.0, 4.0), (30.0, 160.0)])
def test_a_golf_swing_is_interpolated_within_the_stated_error(fps: float, largest_mm: float):
    """The club head moves at up to 40 m/s. At 30 Hz the interpolation is inaccurate, and its standard deviation says so."""
    points, between = swing(fps)
    variance = torch.full(points.shape[1:], 1e-8, dtype=torch.float64)
    error = 1000 * (half_frame_motion(points, variance) - (between - points)).norm(dim=0)
    assert float(error.max()) < largest_mm
    polynomials = Trajectories(points, variance, THREE_VIEWS).polynomials(slice(0, 120))
    delays = torch.full((1, 120 * 21), 0.5, dtype=torch.float64)
    std_mm = 1000 * polynomials.interpolation_std_m(delays)[0].unflatten(0, (120, 21))
    assert float((error <= 4 * std_mm + 1.0).double().mean()) > 0.995


def test_noise_of_slow_points_is_smoothed():
    points, _ = swing(120.0)
    generator = torch.Generator().manual_seed(0)
    noise = 0.005 * torch.randn(points.shape, generator=generator, dtype=torch.float64)
    variance = torch.full(points.shape[1:], 0.005**2, dtype=torch.float64)
    error = half_frame_motion(points + noise, variance) - half_frame_motion(points, torch.full_like(variance, 1e-18))
    # linear interpolation would have an error of 3.5 mm: half the difference of the noise of two frames
    assert float(error.square().mean().sqrt()) < 0.001


def test_a_wrong_point_of_two_cameras_is_ignored():
    points, _ = swing(60.0)
    generator = torch.Generator().manual_seed(1)
    points = points + 0.003 * torch.randn(points.shape, generator=generator, dtype=torch.float64)
    wrong = torch.rand(points.shape[1:], generator=generator) < 0.05
    jumps = 0.5 * torch.randn(points.shape, generator=generator, dtype=torch.float64)
    variance = torch.full(points.shape[1:], 0.003**2, dtype=torch.float64)
    motion = half_frame_motion(points + jumps * wrong, variance, torch.where(wrong, 2, 3))
    error = (motion - half_frame_motion(points, variance)).norm(dim=0)
    assert float(error.median()) < 0.001
    assert float((error < 0.01).double().mean()) > 0.97
