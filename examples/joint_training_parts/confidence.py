"""Heads that turn what is seen of a keypoint into its confidence, and the ways to train them."""

from __future__ import annotations

from collections.abc import Callable

import torch
import torch.distributed as dist
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel

from joint_training_parts.calibration import rig_loss
from joint_training_parts.detections import Detections
from torchstickcal import CalibrationLayer, LayerResult

TOGETHER = 4
"""Sessions of a step, of all processes together."""
_LEAST_CONFIDENCE = 1e-3
_FREEDOM = 3.0
_RATE = 2.5
"""By how much a step may change a logit, about: Adam changes each weight by the learning rate."""
_LABELS = 30.0
"""Weight of the labels beside the cameras. Many keypoints tell more of a head than the few cameras of a step."""
Watch = Callable[[int, Tensor, Detections, Tensor, LayerResult], None]
"""Gets the step, the loss, the sessions of the step, their confidences and the result."""


class Head(nn.Module):
    """A weighted sum of what is seen.

    Its output z is the logit of the confidence: with the given noise sigma, the variance of a keypoint is
    ``sigma**2 (1 + exp(-z))``.
    """

    mean: Tensor
    scale: Tensor

    def __init__(self, training: Detections) -> None:
        super().__init__()
        seen = training.seen.flatten(0, -2)
        self.register_buffer("mean", seen.mean(0))
        self.register_buffer("scale", seen.std(0).clamp_min(1e-3))
        self.sum = nn.Linear(seen.shape[-1], 1, dtype=seen.dtype)
        nn.init.zeros_(self.sum.weight)
        nn.init.constant_(self.sum.bias, -2.0)

    def forward(self, seen: Tensor) -> Tensor:
        """Confidences (..., P) of what is seen (..., P, n)."""
        return torch.sigmoid(self.logits(seen)).clamp_min(_LEAST_CONFIDENCE)

    def logits(self, seen: Tensor) -> Tensor:
        return self.sum((seen - self.mean) / self.scale)[..., 0]


def learn_likelihood(head: Head, found: Detections, target: Tensor, sigma_px: float, steps: int = 200) -> None:
    """Train a head so that the distances of the keypoints from a target are as likely as possible.

    They are taken to have Student's distribution with three degrees of freedom, because some keypoints are grossly wrong.
    """
    optimiser = torch.optim.Adam(head.parameters(), 0.05)
    unlikely = _unlikelihood(head, found, target, sigma_px)
    for _ in range(steps):
        loss = unlikely()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()


def _unlikelihood(head: Head, found: Detections, target: Tensor, sigma_px: float) -> Callable[[], Tensor]:
    """How unlikely the distances are with the head as it is: the mean negative logarithm of their density."""
    squared = (found.keypoints - target).square().sum(-1) / sigma_px**2
    given = squared.isfinite()
    squared, seen = squared[given], found.seen[given]

    def loss() -> Tensor:
        variance = 1 + torch.exp(-head.logits(seen))
        return ((_FREEDOM / 2 + 1) * torch.log1p(squared / (_FREEDOM * variance)) + variance.log()).mean()

    return loss


def learn_end_to_end(
    head: Head,
    found: Detections,
    layer: CalibrationLayer,
    steps: int,
    seed: int,
    watch: Watch | None,
    labels_sigma_px: float | None = None,
) -> None:
    """Train a head so that the cameras that the layer finds are where they truly are.

    Under torchrun each process takes its share of the sessions of a step.

    Args:
        head: what is trained.
        found: sessions of known rigs.
        layer: the calibration.
        steps: of the training.
        seed: of the order of the sessions.
        watch: sees each step.
        labels_sigma_px: noise of a keypoint of confidence 1, if the distances from the labels shall stay likely too.
    """
    unlikely = None if labels_sigma_px is None else _unlikelihood(head, found, found.labels, labels_sigma_px)
    rank, processes = (dist.get_rank(), dist.get_world_size()) if dist.is_initialized() else (0, 1)
    model = DistributedDataParallel(head) if dist.is_initialized() else head
    rate = _RATE / found.seen.shape[-1]
    optimiser = torch.optim.Adam(head.parameters(), rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps, rate / 10)
    order = torch.Generator().manual_seed(seed)
    for step in range(steps):
        batch = found[torch.randperm(len(found), generator=order)[:TOGETHER][rank::processes]]
        confidence = model(batch.seen)
        result = layer(batch.keypoints, batch.intrinsics, batch.stick_m, confidence)
        loss = rig_loss(result, batch.rotations, batch.translations)
        optimiser.zero_grad()
        (loss if unlikely is None else loss + _LABELS * unlikely()).backward()
        optimiser.step()
        schedule.step()
        if watch:
            watch(step, loss, batch, confidence, result)
