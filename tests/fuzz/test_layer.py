"""A layer gives every session a status, harms no session for another's sake, and never gives a gradient that is not finite."""

from __future__ import annotations

import contextlib
from typing import Any

import torch
from hypothesis import given
from torch import Tensor

from fuzz.layers import Batch, batches
from fuzz.promise import budget, case, check_rotations, check_shares
from torchstickcal import Intrinsics
from torchstickcal.layer.result import LayerResult

FLOATS = ("rotations", "translations", "intrinsics", "time_offsets", "readout", "unknowns", "points", "sigma_px")
TOLERANCE = {torch.float64: 1e-6, torch.float32: 1e-3, torch.float16: 0.1, torch.bfloat16: 0.5}
"""Largest difference, in metres or as a part, that another order of summation may make."""


@budget(small=15, large=500)
@given(batch=batches())
def test_layer(batch: Batch):
    layer, arguments = batch.layer(), batch.inputs(batch.sessions)
    with case("layer") as ended:
        with torch.autocast("cpu", dtype=torch.bfloat16) if batch.autocast else contextlib.nullcontext():
            result = layer(**arguments)
        ended("converged" if bool(result.converged.all()) else "not converged")
        check_result(result, batch)
        check_gradients(result, arguments)
        if batch.batched and not batch.sessions[0].spoils:
            check_unharmed(result, layer(**batch.inputs(batch.sessions[:1])))


def test_most_batches_reach_the_solver():
    check_shares("layer", "converged", "not converged", at_least=0.5)


def check_result(result: LayerResult, batch: Batch) -> None:
    """A status for each session, and finite numbers throughout."""
    assert isinstance(result.status, tuple)
    assert len(result.status) == len(batch.sessions)
    assert all(isinstance(status, str) and status for status in result.status)
    assert [status == "converged" for status in result.status] == result.converged.flatten().tolist()
    for name in FLOATS:
        tensor: Tensor = getattr(result, name)
        assert tensor.is_floating_point(), name
        assert bool(tensor.isfinite().all()), f"{name} is not finite"
    check_rotations(result.rotations)
    inliers = result.inliers if batch.batched else result.inliers[None]
    for converged, own in zip(result.converged.flatten().tolist(), inliers, strict=True):
        assert not converged or bool(own.flatten(1).any(1).all()), "converged, and a camera has no inlier"


def check_gradients(result: LayerResult, arguments: dict[str, Any]) -> None:
    """Every input that requires a gradient gets a finite one."""
    outputs = [tensor for name in FLOATS if (tensor := getattr(result, name)).requires_grad]
    loss = 1e-3 * sum((tensor.double().sum() for tensor in outputs), torch.zeros(()))  # its gradients fit into float16
    if not loss.requires_grad:
        return
    loss.backward()
    for name, value in arguments.items():
        tensors = (value.matrix, value.distortion) if isinstance(value, Intrinsics) else (value,)
        for tensor in tensors:
            if isinstance(tensor, Tensor) and tensor.grad is not None:
                assert bool(tensor.grad.isfinite().all()), f"the gradient of {name} is not finite"


def check_unharmed(together: LayerResult, alone: LayerResult) -> None:
    """The first session of a batch comes out as it does alone."""
    assert together.status[0] == alone.status[0]
    if not bool(alone.converged[0]):
        return
    for name in ("rotations", "translations", "points"):
        mine, others = getattr(together, name)[0].detach(), getattr(alone, name)[0].detach()
        tolerance = TOLERANCE[mine.dtype]
        assert torch.allclose(mine, others, atol=tolerance, rtol=tolerance), f"{name} differ from those of the session alone"
