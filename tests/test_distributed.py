"""The layer inside DistributedDataParallel: two processes, half of the sessions each, are one process with all of them."""

from __future__ import annotations

from pathlib import Path

import torch
import torch.distributed as dist
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel

from torchstickcal import CalibrationLayer
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
        assert bool(result.converged.all())
        return result.translations.square().sum((1, 2)).mean()


def keypoints() -> Tensor:
    return torch.stack([golf_session(3, 12, Noise(1.0), seed)[0].keypoints for seed in range(2)])


def half(rank: int, folder: str) -> None:
    torch.set_num_threads(1)
    dist.init_process_group("gloo", init_method=f"file://{folder}/rendezvous", rank=rank, world_size=2)
    model = DistributedDataParallel(Corrected())
    loss = model(keypoints()[rank : rank + 1])
    loss.backward()
    torch.save((loss.detach(), model.module.correction.grad), f"{folder}/{rank}.pt")
    del loss, model
    dist.barrier()
    dist.destroy_process_group()


def test_two_processes_are_one(tmp_path: Path):
    torch.multiprocessing.spawn(half, (str(tmp_path),), nprocs=2)  # pyright: ignore[reportPrivateImportUsage]
    (loss_0, gradient_0), (loss_1, gradient_1) = (torch.load(tmp_path / f"{rank}.pt") for rank in range(2))
    alone = Corrected()
    loss = alone(keypoints())
    loss.backward()
    torch.testing.assert_close((loss_0 + loss_1) / 2, loss.detach(), rtol=1e-9, atol=0)
    torch.testing.assert_close(gradient_0, gradient_1, rtol=0, atol=0)
    assert alone.correction.grad is not None
    torch.testing.assert_close(gradient_0, alone.correction.grad, rtol=1e-6, atol=1e-9)
