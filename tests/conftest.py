"""Scenes and data shared by the tests."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before torch is imported: tests run side by side

import torch

from torchstickcal.benchmark import BASELINES
from torchstickcal.io import CALIBRATION_READERS, CALIBRATION_WRITERS, KEYPOINT_READERS, SESSION_READERS, Truth
from torchstickcal.losses import LOSSES
from torchstickcal.model.measurements import Measurements
from torchstickcal.model.state import State
from torchstickcal.model.unknowns import REFINEMENTS
from torchstickcal.observations import Observations
from torchstickcal.quality.registry import FAMILIES
from torchstickcal.registry import Registry
from torchstickcal.simulate import SPORTS, Noise, golf_session

_DATA = Path(os.environ.get("TORCHSTICKCAL_DATA", Path(__file__).parents[2] / "shared" / "data"))


@pytest.fixture(scope="session")
def data() -> Path:
    """The folder of recorded sessions; tests that need it are skipped where it is absent."""
    if not _DATA.is_dir():
        pytest.skip(f"no recorded sessions at {_DATA}; set TORCHSTICKCAL_DATA to their folder")
    return _DATA


@pytest.fixture
def own_parts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[Registry, ...]]:
    """The registries; forget at the end of the test what it registered, and the modules that it wrote and imported."""
    readers = (CALIBRATION_READERS, KEYPOINT_READERS, SESSION_READERS)
    registries = (BASELINES, *readers, CALIBRATION_WRITERS, FAMILIES, LOSSES, REFINEMENTS, SPORTS)
    for registry in registries:
        monkeypatch.setattr(registry, "_things", dict(registry))
    yield registries
    for name, module in list(sys.modules.items()):
        if str(getattr(module, "__file__", None)).startswith(str(tmp_path)):
            del sys.modules[name]


@pytest.fixture
def perfect() -> tuple[Observations, Truth]:
    """A golf swing seen by four cameras without noise."""
    return golf_session(cameras=4, frames=30)


@pytest.fixture
def noisy() -> tuple[Observations, Truth]:
    """The same with noise and gaps."""
    return golf_session(cameras=4, frames=30, noise=Noise(sigma_px=1.0, missing=0.1))


@pytest.fixture
def disturbed(noisy: tuple[Observations, Truth]) -> tuple[Measurements, State]:
    """A session in the solvers' layout and a state some way from the minimum."""
    observations, truth = noisy
    assert truth.points is not None
    generator = torch.Generator().manual_seed(3)
    measurements = Measurements.of(observations)
    points = truth.points.flatten(0, 1).mT.contiguous()
    start = State.of(truth.rotations[None], truth.translations[None], points[None])
    step = 0.01 * torch.randn(len(truth.rotations) - 1, 6, generator=generator, dtype=torch.float64)
    shift = 0.01 * torch.randn(points.shape, generator=generator, dtype=torch.float64)
    return measurements, start.retracted(step[None], shift[None])
