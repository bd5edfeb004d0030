"""A small keypoint detector: heat maps of an encoder and decoder, and what the network sees at each keypoint."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
import torch.distributed as dist
from torch import Tensor, nn
from torch.nn import functional
from torch.nn.parallel import DistributedDataParallel

from joint_training_parts.detections import Detections
from joint_training_parts.scenes import POINTS, SIZE, Sessions

CROPS_A_STEP = 32
_CELL_PX, _NEAR = 2, 3
"""Width of a heat map's cell in pixels of the crop; cells around the peak whose mean is the keypoint."""
_WIDTH, _AT_ONCE = 24, 160
_SPREAD_PX, _DISTANCE_WEIGHT = 1.6, 0.05
_TURN_RAD, _ZOOM = math.radians(25), 0.1


class Detector(nn.Module):
    """Heat maps (N, P, h, w), logits, and features (N, n, h, w) of crops (N, 3, H, W), 0 to 255."""

    def __init__(self) -> None:
        super().__init__()
        self.fine = _block(3, 16, stride=2)
        self.middle = _block(16, 32, stride=2)
        self.coarse = nn.Sequential(_block(32, 48, stride=2), _block(48, 48), _block(48, 48))
        self.upper = _block(48 + 32, 32)
        self.joined = _block(32 + 16, _WIDTH)
        self.heat = nn.Conv2d(_WIDTH, POINTS, 1)

    def forward(self, crops: Tensor) -> tuple[Tensor, Tensor]:
        fine = self.fine(crops.float() / 128 - 1)
        middle = self.middle(fine)
        upper = self.upper(torch.cat([middle, _doubled(self.coarse(middle))], dim=1))
        joined = self.joined(torch.cat([fine, _doubled(upper)], dim=1))
        return self.heat(joined), joined


def learn_keypoints(
    detector: Detector, sessions: Sessions, steps: int, watch: Callable[[int, Tensor], None] | None = None
) -> None:
    """Train a detector on labels. Under torchrun each process takes its share of the crops of a step.

    Args:
        detector: is changed.
        sessions: with labels.
        steps: of the optimiser.
        watch: gets the step and the loss.
    """
    rank, processes = (dist.get_rank(), dist.get_world_size()) if dist.is_initialized() else (0, 1)
    model = DistributedDataParallel(detector) if dist.is_initialized() else detector
    crops, labels = sessions.images.flatten(0, 2), sessions.in_crops(sessions.labels).flatten(0, 2)
    optimiser = torch.optim.AdamW(model.parameters(), 5e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, 5e-3, total_steps=steps)
    order = torch.Generator().manual_seed(0)
    for step in range(steps):
        chosen = torch.randint(len(crops), (CROPS_A_STEP,), generator=order)[rank::processes]
        turned, target = _turned(crops[chosen].float(), labels[chosen])
        loss = _loss(model(turned)[0], target)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
        if watch:
            watch(step, loss)


@torch.no_grad()
def detections(detector: Detector, sessions: Sessions) -> Detections:
    """What a detector finds in sessions, in pixels of the whole images."""
    parts = [_read(*detector(crops)) for crops in sessions.images.flatten(0, 2).split(_AT_ONCE)]
    crops, score, seen = (torch.cat(part).unflatten(0, sessions.images.shape[:3]) for part in zip(*parts, strict=True))
    return Detections(
        sessions.in_images(crops).double(),
        score.double(),
        seen.double(),
        sessions.labels.double(),
        sessions.true.double(),
        sessions.intrinsics,
        sessions.rotations,
        sessions.translations,
        sessions.stick_m,
    )


def _read(logits: Tensor, features: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Keypoints (N, P, 2), scores (N, P), and what is seen at each keypoint (N, P, n)."""
    heat = logits.flatten(2).softmax(-1)
    size = logits.shape[-1]
    cells = torch.stack([torch.arange(size * size) % size, torch.arange(size * size) // size], dim=-1).to(heat)
    peak = cells[heat.argmax(-1)]
    near = heat * ((cells - peak[..., None, :]).abs().amax(-1) <= _NEAR)
    cell = (near @ cells) / near.sum(-1, keepdim=True)
    spread = (heat[..., None] * (cells - cell[..., None, :]).square()).sum(-2)
    score = near.sum(-1)
    local = functional.grid_sample(features, cell[:, :, None] / (size - 1) * 2 - 1, align_corners=True)[..., 0].mT
    whole = torch.cat([features.mean((2, 3)), features.std((2, 3))], dim=-1)[:, None].expand(-1, POINTS, -1)
    numbers = torch.stack([(score + 1e-3).log(), heat.amax(-1).log(), *(spread + 0.01).log().unbind(-1)], dim=-1)
    which = torch.eye(POINTS).expand(len(heat), -1, -1)
    return _CELL_PX * cell + 0.5, score, torch.cat([numbers, local, whole, which], dim=-1)


def _loss(logits: Tensor, target: Tensor) -> Tensor:
    """Cross entropy of heat maps with spots around the labels (N, P, 2), and the distance of their means from the labels."""
    places = _CELL_PX * torch.arange(logits.shape[-1]) + 0.5
    by_x, by_y = ((target[..., axis, None] - places).square() / (-2 * _SPREAD_PX**2) for axis in (0, 1))
    spot = (by_x[:, :, None, :] + by_y[:, :, :, None]).flatten(2).softmax(-1)
    entropy = -(spot * logits.flatten(2).log_softmax(-1)).sum(-1)
    heat = logits.flatten(2).softmax(-1).unflatten(-1, logits.shape[-2:])
    mean = torch.stack([heat.sum(-2) @ places, heat.sum(-1) @ places], dim=-1)
    inside = ((target > 0) & (target < SIZE - 1)).all(-1)
    return (entropy + _DISTANCE_WEIGHT * (mean - target).norm(dim=-1)).where(inside, 0.0).mean()


def _turned(crops: Tensor, labels: Tensor) -> tuple[Tensor, Tensor]:
    """Crops turned, mirrored and zoomed at random, with their labels. The colours of left and right stay."""
    count = len(crops)
    angle = _TURN_RAD * (2 * torch.rand(count) - 1)
    mirror = torch.where(torch.rand(count) < 0.5, -1.0, 1.0)
    zoom = 1 + _ZOOM * (2 * torch.rand(count) - 1)
    rows = torch.stack([angle.cos() * mirror, -angle.sin(), angle.sin() * mirror, angle.cos()], dim=-1)
    from_turned = zoom[:, None, None] * rows.view(count, 2, 2)
    grid = functional.affine_grid(functional.pad(from_turned, (0, 1)), list(crops.shape), align_corners=True)
    centre = (SIZE - 1) / 2
    moved = (labels - centre) @ torch.linalg.inv(from_turned).mT + centre
    return functional.grid_sample(crops, grid, padding_mode="reflection", align_corners=True), moved


def _doubled(maps: Tensor) -> Tensor:
    return functional.interpolate(maps, scale_factor=2.0)


def _block(inside: int, outside: int, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(nn.Conv2d(inside, outside, 3, stride, padding=1), nn.GroupNorm(4, outside), nn.ReLU())
