"""Torch's inference mode inside, ordinary tensors outside."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any, NamedTuple

import pytest
import torch
from torch import Tensor, nn

from torchstickcal import Calibration, CalibrationLayer, Observations, calibrate
from torchstickcal.config import load_config
from torchstickcal.dual import dual, dual_numbers, tangent
from torchstickcal.inference import differentiates, ordinary
from torchstickcal.lazy import cached_property
from torchstickcal.pipeline.inference import inference_of
from torchstickcal.pipeline.together import calibrate_together
from torchstickcal.simulate import Noise, SessionSpec

OBSERVATIONS = SessionSpec("golf", "golf", 3, 3, 12, regimes=(Noise(1.0, outliers=0.03),)).generate().observations
CONFIG = load_config("default")
FISHEYE = replace(OBSERVATIONS, distortion=torch.tensor([0.02, 0.0, 0.0, 0.0]).double(), fisheye=True)
RATIONAL = replace(OBSERVATIONS, distortion=torch.tensor([-0.1, 0.02, 0, 0, 0, 0.01, 0, 0]).double())

CALIBRATED: dict[str, Callable[[], Calibration]] = {
    "plain": lambda: calibrate(OBSERVATIONS),
    "refined": lambda: calibrate(OBSERVATIONS, refine=("focal", "radial", "time_offset")),
    "auto": lambda: calibrate(OBSERVATIONS, refine="auto"),
    "fisheye": lambda: calibrate(FISHEYE),
    "rational": lambda: calibrate(RATIONAL, refine=("focal",)),
    "without intrinsics": lambda: calibrate(replace(OBSERVATIONS, intrinsics_known=False)),
    "together": lambda: calibrate_together([OBSERVATIONS, OBSERVATIONS], CONFIG)[1] or pytest.fail("not calibrated"),
}


class Pair(NamedTuple):
    first: Any
    second: Any


@dataclass(frozen=True)
class Box:
    inside: Any
    number: float = 1.0


def made(*shape: int) -> Tensor:
    with torch.inference_mode():
        return torch.ones(shape)


def tensors(value: Any) -> Iterator[Tensor]:
    """All tensors of a result, deferred ones too."""
    if isinstance(value, Tensor):
        yield value
    elif isinstance(value, dict):
        for part in value.values():
            yield from tensors(part)
    elif isinstance(value, tuple):
        for part in value:
            yield from tensors(part)
    elif is_dataclass(value):
        for field in fields(value):
            yield from tensors(getattr(value, field.name))


def found_by(calibration: Calibration) -> list[Tensor]:
    _ = calibration.quality, calibration.camera_std_m, calibration.scale_std
    deferred = [t for u in calibration.unknowns.values() for t in (u.suggested, u.suggested_std)]
    kept = [value for value in vars(calibration).values() if isinstance(value, Tensor)]
    return [*tensors(calibration), *deferred, *kept]


@pytest.mark.parametrize("calibrated", CALIBRATED.values(), ids=CALIBRATED.keys())
def test_results_are_ordinary_tensors_with_the_same_numbers(calibrated: Callable[[], Calibration], monkeypatch: Any):
    modes: list[bool] = []

    def watched(*arguments: Any) -> torch.inference_mode:
        modes.append(inference_of(*arguments).mode)
        return inference_of(*arguments)

    def set_mode(function: Callable[..., torch.inference_mode]) -> None:
        for name in ("calibrate", "together", "conclude"):
            monkeypatch.setattr(sys.modules[f"torchstickcal.pipeline.{name}"], "inference_of", function)
        monkeypatch.setattr(sys.modules["torchstickcal.quality.judge"], "inference_of", function)

    set_mode(watched)
    calibration = calibrated()
    found = found_by(calibration)
    assert not any(tensor.is_inference() for tensor in found)
    (calibration.translations.clone().requires_grad_() * calibration.points.mean()).sum().backward()
    calibration.points.mul_(1.0)
    set_mode(lambda *_: torch.inference_mode(mode=False))
    plain = calibrated()
    for tensor, expected in zip(found, found_by(plain), strict=True):
        torch.testing.assert_close(tensor, expected, rtol=0, atol=0, equal_nan=True)
    assert calibration.quality == plain.quality
    assert all(modes)
    assert modes


@pytest.mark.parametrize("observations", [FISHEYE, RATIONAL], ids=["fisheye", "rational"])
def test_a_session_that_was_calibrated_takes_part_in_gradients(observations: Observations):
    calibrate(observations)
    keypoints = observations.keypoints.clone().requires_grad_()
    result = CalibrationLayer(observations.sticks[0])(keypoints, observations.cameras)
    result.translations.square().sum().backward()
    assert keypoints.grad is not None
    assert bool((keypoints.grad != 0).any())


def test_what_others_have_made_and_large_sessions_are_calibrated_in_ordinary_mode():
    assert inference_of(OBSERVATIONS, CONFIG).mode
    assert not inference_of(OBSERVATIONS, CONFIG, (Box,)).mode
    assert not inference_of(OBSERVATIONS, replace(CONFIG, solver="lbfgs")).mode
    long = replace(OBSERVATIONS, keypoints=OBSERVATIONS.keypoints.repeat(1, 200, 1, 1))
    assert not inference_of(long, CONFIG).mode


@pytest.mark.parametrize(
    "value",
    [
        made(2),
        (1.0, made(2)),
        Pair("name", (made(1), None)),
        {"a": {"b": made(2)}},
        Box(Pair(made(3), 1)),
        Box(Box(made(2).expand(4, 2))),
    ],
    ids=["tensor", "tuple", "named", "dictionary", "dataclass", "view"],
)
def test_ordinary(value: Any):
    before, after = list(tensors(value)), list(tensors(ordinary(value)))
    assert type(ordinary(value)) is type(value)
    assert [tensor.is_inference() for tensor in before] == [True] * len(before)
    assert [tensor.is_inference() for tensor in after] == [False] * len(after)
    for old, new in zip(before, after, strict=True):
        torch.testing.assert_close(new, old)


def test_ordinary_leaves_alone_what_is_ordinary():
    value = Box(Pair(torch.zeros(2), (1, 2.0, None)))
    assert ordinary(value) is value
    module = nn.Module()
    module.register_buffer("sigma", made(2))
    assert not ordinary(module).get_buffer("sigma").is_inference()
    assert module.get_buffer("sigma").is_inference()


@pytest.mark.parametrize("mode", [False, True], ids=["ordinary", "inference"])
def test_derivatives_in_any_mode(mode: bool):
    @differentiates
    def slope(at: Tensor, box: Box) -> Tensor:
        at = at.detach().requires_grad_()
        return torch.autograd.grad((box.inside * at.square()).sum(), at)[0]

    class Keeper:
        @cached_property
        def numbers(self) -> Tensor:
            return torch.arange(3.0)

    keeper = Keeper()
    with torch.inference_mode(mode=mode):
        at, factor = torch.arange(3.0), torch.full((3,), 2.0)
        assert slope(at, Box(factor)).tolist() == [0, 4, 8]
        with dual_numbers():
            assert tangent(factor * dual(at, factor).square()).tolist() == [0, 8, 16]
        _ = keeper.numbers
    assert not keeper.numbers.is_inference()
