"""A layer that finds lenses with the rig: gradients of everything by everything, batches, warm starts, and what is refused."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import pytest
import torch
from torch import Tensor

from torchstickcal import CalibrationLayer, Config, ConfigError, Intrinsics, ObservationError, Unrolled, calibrate, load_config
from torchstickcal.layer import LayerResult
from torchstickcal.simulate import Noise, golf_session

OBSERVATIONS, _ = golf_session(cameras=4, frames=12, noise=Noise(sigma_px=1.0, missing=0.05))
STICK = OBSERVATIONS.sticks[0]
OUTPUTS = ("rotations", "translations", "points", "intrinsics", "distortion")
KINDS = {
    "focal": ("focal",),
    "shared focal": ("focal_shared",),
    "principal point": ("principal_point",),
    "radial": ("radial",),
    "all": ("focal", "principal_point", "radial"),
}


def config(*refine: str) -> dict[str, Any]:
    """The default with known noise and all keypoints, so that the whole is a differentiable function of its input."""
    known = {"reprojection": {"sigma_px": 1.0}, "reject_sigmas": False}
    stages: dict[str, Any] = {"unscaled": known, "metric": known, "refined": known}
    stages["trajectories"] = known | {"smoothness": {"sigma_m": 0.1}}
    return {"extends": "default", "stages": stages, "refine": list(refine), "camera_groups": list("aabb")}


class Inputs(NamedTuple):
    keypoints: Tensor
    matrix: Tensor
    distortion: Tensor
    lengths: Tensor
    confidence: Tensor

    def run(self, layer: CalibrationLayer, initial: LayerResult | None = None) -> LayerResult:
        return layer(self.keypoints, Intrinsics(self.matrix, self.distortion), self.lengths, self.confidence, initial)


def inputs() -> Inputs:
    """A session with focal lengths 3 % off."""
    generator = torch.Generator().manual_seed(2)
    confidence = 0.5 + 0.5 * torch.rand(OBSERVATIONS.keypoints.shape[:-1], generator=generator, dtype=torch.float64)
    assert OBSERVATIONS.distortion is not None
    wrong = torch.tensor([[1.03, 1, 1], [1, 1.03, 1], [1, 1, 1]], dtype=torch.float64)
    matrix = (OBSERVATIONS.intrinsics * wrong).expand(4, 3, 3)
    lengths = torch.tensor([STICK.length_m], dtype=torch.float64)
    return Inputs(OBSERVATIONS.keypoints, matrix, OBSERVATIONS.distortion, lengths, confidence)


def readouts(result: LayerResult) -> list[Tensor]:
    """A random linear function of each of the outputs."""
    generator = torch.Generator().manual_seed(1)
    values = [getattr(result, name) for name in OUTPUTS]
    return [(torch.randn(v.shape, generator=generator, dtype=torch.float64) * v).sum() for v in values]
