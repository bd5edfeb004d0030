"""Images of capsules: line segments with a radius, drawn one over the other, for many images at once."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Capsules:
    """K capsules in each of N images, in the order in which they are drawn. Lengths are in pixels of the whole image."""

    start: Tensor
    """(N, K, 2)"""
    end: Tensor
    """(N, K, 2)"""
    radius: Tensor
    """(N, K)"""
    colour: Tensor
    """(N, K, 3), 0 to 1"""

    def ordered(self, depth: Tensor) -> Capsules:
        """The same capsules, those of the largest depth (N, K) first."""
        order = depth.argsort(dim=1, descending=True)

        def sorted_(values: Tensor) -> Tensor:
            return values.gather(1, order[..., None].expand_as(values)) if values.ndim == 3 else values.gather(1, order)

        return Capsules(*map(sorted_, (self.start, self.end, self.radius, self.colour)))


def draw(capsules: Capsules, over: Tensor, origin: Tensor, scale: Tensor) -> Tensor:
    """Draw capsules over pictures.

    Args:
        capsules: of each picture.
        over: the pictures, (N, 3, H, W).
        origin: the middle of each picture's first pixel, in pixels of the whole image, (N, 2).
        scale: width of a picture's pixel, in pixels of the whole image, (N,).
    """
    x = origin[:, :1] + scale[:, None] * torch.arange(over.shape[-1])
    y = origin[:, 1:] + scale[:, None] * torch.arange(over.shape[-2])
    picture = over.clone()
    for k in range(capsules.radius.shape[1]):
        start, along = capsules.start[:, k], capsules.end[:, k] - capsules.start[:, k]
        from_x, from_y = x - start[:, :1], y - start[:, 1:]
        unit = along / along.square().sum(-1, keepdim=True).clamp_min(1e-6)
        share = ((from_x * unit[:, :1])[:, None, :] + (from_y * unit[:, 1:])[:, :, None]).clamp_(0, 1)
        aside_x = from_x[:, None, :] - share * along[:, 0, None, None]
        aside_y = from_y[:, :, None] - share * along[:, 1, None, None]
        inside = capsules.radius[:, k, None, None] - aside_x.square_().add_(aside_y.square_()).sqrt_()
        cover = (inside / scale[:, None, None]).add_(0.5).clamp_(0, 1)[:, None]
        picture += cover * (capsules.colour[:, k, :, None, None] - picture)
    return picture
