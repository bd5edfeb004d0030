"""Tracks as functions of time, between their frames."""

from __future__ import annotations

import pytest
import torch

from torchstickcal.model.trajectories import Trajectories
from torchstickcal.simulate import SessionSpec

HELD = torch.tensor(3)
"""Cameras that hold every point."""


def swing(fps: float, frames: int = 120) -> tuple[torch.Tensor, torch.Tensor]:
    """Points (3, F, P) of a golf swing at its frames, and halfway between them."""
    motion = SessionSpec("swing", "golf", 3).motion
    times = torch.arange(frames) / fps + 1.0
    return tuple(torch.from_numpy(motion.points((times + late / fps).numpy())).movedim(2, 0) for late in (0.0, 0.5))  # pyright: ignore[reportReturnType]


def halfway(points: torch.Tensor, variance: torch.Tensor, views: torch.Tensor = HELD) -> torch.Tensor:
    """Movement (3, F, P) in half a frame as the trajectories have it."""
    frames, count = points.shape[1:]
    pieces = Trajectories(points, variance, views).pieces(slice(0, frames))
    late = torch.full((1, frames * count), 0.5, dtype=torch.float64)
    return (pieces.positions(late) - pieces.positions(0 * late))[0].unflatten(1, (frames, count))


@pytest.mark.parametrize("gaps", [False, True])
def test_a_polynomial_is_followed_exactly(gaps: bool):
    time = torch.arange(40, dtype=torch.float64)[:, None]
    points = torch.stack([0.1 * time, 1 - 0.01 * time**2, 2 + 1e-4 * time**3 - 1e-5 * time**4])
    variance = torch.full((40, 1), 1e-18, dtype=torch.float64)
    if gaps:
        variance[torch.tensor([3, 10, 11, 12, 25, 30])] = torch.inf
    pieces = Trajectories(points, variance, HELD).pieces(slice(0, 40))
    late = torch.linspace(-0.9, 0.9, 40, dtype=torch.float64)[None]
    at = time[:, 0] + late[0]
    where = torch.stack([0.1 * at, 1 - 0.01 * at**2, 2 + 1e-4 * at**3 - 1e-5 * at**4])
    pace = torch.stack([torch.full_like(at, 0.1), -0.02 * at, 3e-4 * at**2 - 4e-5 * at**3])
    inner = slice(3, -3)
    torch.testing.assert_close(pieces.positions(late)[0, :, inner], where[:, inner], rtol=0, atol=1e-5)
    torch.testing.assert_close(pieces.velocities(late)[0, :, inner], pace[:, inner], rtol=0, atol=1e-5)
    assert float(pieces.deviations_m(late)[0, inner].max()) < 1e-3


def test_some_frames_alone_are_as_among_all():
    points, _ = swing(60.0)
    trajectories = Trajectories(points, torch.full(points.shape[1:], 1e-6, dtype=torch.float64), HELD)
    late = torch.full((1, 120 * 21), 0.3, dtype=torch.float64)
    whole = trajectories.pieces(slice(0, 120)).positions(late).unflatten(2, (120, 21))
    part = trajectories.pieces(slice(50, 70)).positions(late[:, : 20 * 21]).unflatten(2, (20, 21))
    torch.testing.assert_close(part, whole[:, :, 50:70], rtol=0, atol=1e-12)


@pytest.mark.parametrize(("fps", "largest_mm"), [(120.0, 0.3), (60.0, 4.0), (30.0, 160.0)])
def test_a_real_swing_between_its_frames(fps: float, largest_mm: float):
    """The club's head moves at up to 40 m/s; what lies between frames at 30 Hz is a guess, and counts as one."""
    points, between = swing(fps)
    variance = torch.full(points.shape[1:], 1e-8, dtype=torch.float64)
    error = 1000 * (halfway(points, variance) - (between - points)).norm(dim=0)
    assert float(error.max()) < largest_mm
    pieces = Trajectories(points, variance, HELD).pieces(slice(0, 120))
    deviation = 1000 * pieces.deviations_m(torch.full((1, 120 * 21), 0.5, dtype=torch.float64))[0].unflatten(0, (120, 21))
    assert float((error <= 4 * deviation + 1.0).double().mean()) > 0.995


def test_noise_is_smoothed_where_the_motion_is_slow():
    points, _ = swing(120.0)
    generator = torch.Generator().manual_seed(0)
    noise = 0.005 * torch.randn(points.shape, generator=generator, dtype=torch.float64)
    variance = torch.full(points.shape[1:], 0.005**2, dtype=torch.float64)
    error = halfway(points + noise, variance) - halfway(points, torch.full_like(variance, 1e-18))
    # the difference of two frames' noise, halved, would be 3.5 mm
    assert float(error.square().mean().sqrt()) < 0.001


def test_a_point_that_two_cameras_have_wrong_is_left_out():
    points, _ = swing(60.0)
    generator = torch.Generator().manual_seed(1)
    points = points + 0.003 * torch.randn(points.shape, generator=generator, dtype=torch.float64)
    wrong = torch.rand(points.shape[1:], generator=generator) < 0.05
    jumps = 0.5 * torch.randn(points.shape, generator=generator, dtype=torch.float64)
    variance = torch.full(points.shape[1:], 0.003**2, dtype=torch.float64)
    moved = halfway(points + jumps * wrong, variance, torch.where(wrong, 2, 3))
    off = (moved - halfway(points, variance)).norm(dim=0)
    assert float(off.median()) < 0.001
    assert float((off < 0.01).double().mean()) > 0.97
