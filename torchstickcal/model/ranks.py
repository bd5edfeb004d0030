"""Values of a certain rank among many. Where all rows want the same rank, it is selected: sorting takes ten times as long."""

from __future__ import annotations

import torch
from torch import Tensor


def of_rank(values: Tensor, ranks: Tensor) -> Tensor:
    """The values of each row that have so many smaller ones.

    Args:
        values: (..., N), no NaN.
        ranks: (..., K), 0 to N - 1.

    Returns:
        (..., K).

    Example:
        >>> import torch
        >>> of_rank(torch.tensor([[5.0, 3.0, 4.0], [7.0, 9.0, 8.0]]), torch.tensor([[0], [2]]))
        tensor([[3.],
                [9.]])
    """
    same = ranks.flatten(0, -2)[0]
    if bool((ranks == same).all()):
        return torch.stack([values.kthvalue(rank + 1, dim=-1).values for rank in same.tolist()], dim=-1)
    return values.sort(dim=-1).values.gather(-1, ranks)


def nanquantile(values: Tensor, share: float) -> Tensor:
    """The quantile of each row (..., N), without its NaN, (...), as :func:`torch.nanquantile`; NaN where there is nothing else.

    Example:
        >>> import torch
        >>> nanquantile(torch.tensor([[3.0, 1.0, torch.nan, 2.0]]), 0.25)
        tensor([1.5000])
    """
    known = ~values.isnan()
    count = known.sum(-1)
    rank = share * (count - 1).clamp_min(0).to(values)
    sides = torch.stack([rank.floor(), rank.ceil()], dim=-1)
    below, above = of_rank(values.where(known, torch.inf), sides.long()).unbind(-1)
    return torch.lerp(below, above, rank - sides[..., 0]).where(count > 0, torch.nan)
