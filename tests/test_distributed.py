"""The layer inside DistributedDataParallel, also where all sessions of a process fail."""

from __future__ import annotations

from typing import Any

import pytest
import torch
import torch.distributed as dist
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel

from torchstickcal import CalibrationLayer
from torchstickcal.metrics import PoseErrorMetric
from torchstickcal.simulate import Noise, golf_session


class Corrected(nn.Module):
    """Keypoints with a learnt correction for each camera and point, calibrated; the spread of the rig is the loss."""

    def __init__(self) -> None:
        super().__init__()
        observations, _ = golf_session(3, 12)
        self.correction = nn.Parameter(torch.linspace(-0.5, 0.5, 3 * 21 * 2, dtype=torch.float64).view(3, 1, 21, 2))
        self._layer, self._lens = CalibrationLayer(observations.sticks), observations.cameras

    def forward(self, keypoints: Tensor) -> Tensor:
        result = self._layer(keypoints + self.correction, self._lens)
        return result.translations.square().sum((1, 2)).mean()


def keypoints() -> Tensor:
    return torch.stack([golf_session(3, 12, Noise(1.0), seed)[0].keypoints for seed in range(2)])


def sessions_with_failures() -> Tensor:
    """Three sessions that cannot be calibrated after one that can."""
    return torch.cat([keypoints()[:1], torch.full_like(keypoints()[:1], torch.nan).expand(3, -1, -1, -1, -1)])


def errors_of(count: int) -> tuple[Tensor, ...]:
    """Poses of some sessions, and the true ones."""
    _, truth = golf_session(3, 1)
    wrong = torch.stack([truth.translations * (1.0 + 0.1 * (session + count)) for session in range(count)])
    return truth.rotations.expand(count, -1, -1, -1), wrong, truth.rotations, truth.translations


def half(rank: int, folder: str) -> None:
    """One of two processes, each with half of the sessions."""
    torch.set_num_threads(1)
    dist.init_process_group("gloo", init_method=f"file://{folder}/rendezvous", rank=rank, world_size=2)
    found = []
    for sessions in (keypoints(), sessions_with_failures()):
        model = DistributedDataParallel(Corrected())
        loss = model(sessions.chunk(2)[rank])
        loss.backward()
        found.append((loss.detach(), model.module.correction.grad))
        del loss, model
    metric = PoseErrorMetric()
    metric.update(*errors_of(rank + 1))
    torch.save([*found, metric.compute()], f"{folder}/{rank}.pt")
    dist.barrier()
    dist.destroy_process_group()


@pytest.fixture(scope="module")
def halves(tmp_path_factory: pytest.TempPathFactory) -> list[list[Any]]:
    folder = tmp_path_factory.mktemp("halves")
    torch.multiprocessing.spawn(half, (str(folder),), nprocs=2)  # pyright: ignore[reportPrivateImportUsage]
    return [torch.load(folder / f"{rank}.pt") for rank in range(2)]


def test_a_metric_is_over_the_sessions_of_all_processes(halves: list[list[Any]]):
    alone = PoseErrorMetric()
    for count in (1, 2):
        alone.update(*errors_of(count))
    for found in halves:
        assert found[2] == alone.compute()


@pytest.mark.parametrize("case", [0, 1], ids=["all sessions converge", "all sessions of one process fail"])
def test_two_processes_are_one(halves: list[list[Any]], case: int):
    (loss_0, gradient_0), (loss_1, gradient_1) = (half[case] for half in halves)
    alone = Corrected()
    loss = alone([keypoints, sessions_with_failures][case]())
    loss.backward()
    torch.testing.assert_close((loss_0 + loss_1) / 2, loss.detach(), rtol=1e-9, atol=0)
    torch.testing.assert_close(gradient_0, gradient_1, rtol=0, atol=0)
    assert alone.correction.grad is not None
    assert float(gradient_0.abs().max()) > 0
    torch.testing.assert_close(gradient_0, alone.correction.grad, rtol=1e-6, atol=1e-9)
