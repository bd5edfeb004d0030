"""A small keypoint detector: heatmaps of an encoder and decoder, turned into coordinates and a confidence."""

from __future__ import annotations

import torch
from kornia.geometry.subpix import spatial_softmax2d
from torch import Tensor, nn


class Detector(nn.Module):
    """Keypoints in the images of fixed cameras: one network for all, and a correction for each camera and point.

    Args:
        cameras: C.
        points: P.
        width: channels of the first layer.
    """

    def __init__(self, cameras: int, points: int, width: int = 24) -> None:
        super().__init__()
        self.fine = _block(3, width, stride=1)
        self.middle = _block(width, width + 8, stride=2)
        self.coarse = nn.Sequential(
            _block(width + 8, 2 * width, stride=2), _block(2 * width, 2 * width), _block(2 * width, 2 * width)
        )
        self.joined = _block(3 * width + 8, width + 8)
        self.head = nn.Conv2d(width + 8, points, 3, padding=1)
        self.corrections = nn.Parameter(torch.zeros(cameras, 1, points, 2))
        self.doubt = nn.Parameter(torch.tensor(-3.0))

    def keep_trunk(self) -> None:
        """Stop training the layers that all cameras share."""
        for layers in (self.fine, self.middle, self.coarse, self.joined, self.head):
            layers.requires_grad_(False)

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Keypoints (S, C, F, P, 2), pixels, and confidence (S, C, F, P) of images (S, C, F, 3, H, W).

        The confidence decreases with the spread of the heatmap. The network learns how fast.
        """
        middle = self.middle(self.fine(images.flatten(0, 2)))
        wide = nn.functional.interpolate(self.coarse(middle), scale_factor=2.0)
        share = spatial_softmax2d(self.head(self.joined(torch.cat([middle, wide], dim=1)))).unflatten(0, images.shape[:3])
        rows, columns = (torch.arange(size).to(share) for size in share.shape[-2:])
        by_column, by_row = share.sum(-2), share.sum(-1)
        x, y = (by_column * columns).sum(-1), (by_row * rows).sum(-1)
        spread = (by_column * (columns - x[..., None]).square()).sum(-1) + (by_row * (rows - y[..., None]).square()).sum(-1)
        keypoints = torch.stack([x, y], dim=-1) * (images.shape[-1] / share.shape[-1]) + 0.5
        return keypoints + self.corrections, torch.exp(-nn.functional.softplus(self.doubt) * spread).clamp_min(1e-3)


def _block(inside: int, outside: int, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(nn.Conv2d(inside, outside, 3, stride, padding=1), nn.GroupNorm(4, outside), nn.ReLU())
