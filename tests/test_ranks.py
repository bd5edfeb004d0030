"""Values of a certain rank, selected or sorted."""

from __future__ import annotations

import doctest

import pytest
import torch

from torchstickcal.model import ranks
from torchstickcal.model.ranks import nanquantile, of_rank


@pytest.mark.parametrize("same", [True, False], ids=["one rank", "several"])
def test_values_of_some_ranks_are_those_of_the_sorted_rows(same: bool):
    values = torch.rand(3, 4, 50, generator=torch.Generator().manual_seed(0))
    wanted = torch.tensor([7, 49]).expand(3, 4, 2).clone()
    if not same:
        wanted[1, 2, 0] = 0
    torch.testing.assert_close(of_rank(values, wanted), values.sort().values.gather(-1, wanted), rtol=0, atol=0)


@pytest.mark.parametrize("share", [0.0, 0.1, 0.25, 0.5, 1.0])
@pytest.mark.parametrize("missing", [0.0, 0.3, 1.0])
def test_quantiles_are_those_of_torch(share: float, missing: float):
    generator = torch.Generator().manual_seed(0)
    values = torch.rand(2, 5, 41, generator=generator, dtype=torch.float64)
    values[torch.rand(values.shape, generator=generator) < missing] = torch.nan
    values[1, 1] = torch.nan
    torch.testing.assert_close(
        nanquantile(values, share), values.nanquantile(share, dim=-1), equal_nan=True, rtol=1e-14, atol=0
    )


def test_examples_run():
    assert doctest.testmod(ranks).failed == 0
