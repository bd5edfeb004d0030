"""Batches for the layer: good sessions beside bad ones, in every type and with every option."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from hypothesis import strategies as st
from torch import Tensor

from fuzz.configurations import REFINE
from fuzz.sessions import Spoiled
from fuzz.spoils.keypoints import SPOILS
from torchstickcal import CalibrationLayer, Intrinsics

DTYPES = {name: getattr(torch, name) for name in ("float64", "float32", "bfloat16", "float16", "int64", "uint8")}


@dataclass(frozen=True)
class Batch:
    """Sessions of one shape, and how they are given to a layer."""

    sessions: tuple[Spoiled, ...] = (Spoiled(),)
    batched: bool = True
    dtype: str = "float64"
    gradient: str = "implicit"
    refine: tuple[str, ...] = ()
    lens: bool = True
    confidence: str = "none"
    own_lengths: bool = False
    image_size: bool = True
    autocast: bool = False

    def layer(self) -> CalibrationLayer:
        sticks = self.sessions[0].simulated()["sticks"]
        return CalibrationLayer(sticks, {"extends": "default", "refine": list(self.refine)}, self.gradient)

    def inputs(self, sessions: tuple[Spoiled, ...]) -> dict[str, Any]:
        """The arguments of a forward pass on some of the sessions; floats require gradients."""
        given = [session.arguments() for session in sessions]
        keypoints = torch.stack([torch.from_numpy(own["keypoints"]) for own in given])
        keypoints = keypoints.to(DTYPES[self.dtype]) if self.batched else keypoints.to(DTYPES[self.dtype])[0]
        matrix = torch.from_numpy(given[0]["intrinsics"])
        arguments: dict[str, Any] = {"keypoints": keypoints, "intrinsics": matrix}
        if self.confidence != "none":
            arguments["confidence"] = self._confidence(keypoints)
        if self.own_lengths:
            arguments["stick_lengths"] = torch.tensor([1.1], dtype=torch.float64)
        if self.image_size:
            arguments["image_size"] = (1920, 1080)
        for tensor in arguments.values():
            if isinstance(tensor, Tensor) and tensor.is_floating_point():
                tensor.requires_grad_()
        if self.lens:
            arguments["intrinsics"] = Intrinsics(matrix, torch.from_numpy(given[0]["distortion"]).requires_grad_())
        return arguments

    def _confidence(self, keypoints: Tensor) -> Tensor:
        ones = torch.ones(keypoints.shape[:-1], dtype=torch.float64)
        drawn = torch.rand(ones.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        given = {
            "random": drawn,
            "some zero": drawn.round(),
            "tiny": 1e-300 * ones,
            "zero": 0 * ones,
            "above 1": 5 * ones,
            "nan": torch.nan * ones,
            "float32": drawn.float(),
            "permuted": ones.transpose(-1, -2),
            "too short": ones[..., :1],
        }
        return given[self.confidence]


CONFIDENCES = ["none"] * 8 + ["random", "some zero", "tiny", "zero", "above 1", "nan", "float32", "permuted", "too short"]


@st.composite
def batches(draw: st.DrawFn) -> Batch:
    """One to three sessions of one shape; of two or more the first is good."""
    shape = {"cameras": draw(st.integers(2, 4)), "frames": draw(st.sampled_from([6, 10]))}
    spoils = st.lists(st.sampled_from(list(SPOILS)), min_size=1, max_size=2).map(tuple)
    count = draw(st.integers(0, 2))
    bad = [Spoiled(**shape, spoils=draw(spoils), seed=draw(st.integers(0, 10_000))) for _ in range(count)]
    sessions = (Spoiled(**shape, seed=draw(st.integers(0, 4))), *bad)
    batched = draw(st.booleans()) or len(sessions) > 1
    return Batch(
        sessions=sessions if batched or not bad else tuple(bad[:1]),
        batched=batched,
        dtype=draw(st.sampled_from(["float64"] * 6 + ["float32"] * 3 + list(DTYPES))),
        gradient=draw(st.sampled_from(["implicit", "implicit", "gauss_newton", "unrolled"])),
        refine=draw(st.lists(st.sampled_from(REFINE), unique=True, max_size=3).map(tuple)),
        lens=draw(st.booleans()),
        confidence=draw(st.sampled_from(CONFIDENCES)),
        own_lengths=draw(st.booleans()),
        image_size=draw(st.sampled_from([True, True, True, False])),
        autocast=draw(st.sampled_from([False, False, False, True])),
    )
