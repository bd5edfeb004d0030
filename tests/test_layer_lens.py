"""A layer that finds lenses with the rig: gradients of everything by everything, batches, warm starts, and what is refused."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import pytest
import torch
from torch import Tensor

from torchstickcal import (
    CalibrationLayer,
    ConfigError,
    GaussNewton,
    Intrinsics,
    LayerResult,
    ObservationError,
    Unrolled,
    calibrate,
)
from torchstickcal.simulate import Noise, golf_session

OBSERVATIONS, _ = golf_session(cameras=4, frames=12, noise=Noise(sigma_px=1.0, missing=0.05))
STICK = OBSERVATIONS.sticks[0]
FOCAL = torch.diag(torch.tensor([1.0, 1, 0], dtype=torch.float64))
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
    stages: dict[str, Any] = {"unscaled": known, "metric": known, "selected": known, "refined": known}
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
    matrix = (OBSERVATIONS.intrinsics * (1 + 0.03 * FOCAL)).expand(4, 3, 3)
    lengths = torch.tensor([STICK.length_m], dtype=torch.float64)
    return Inputs(OBSERVATIONS.keypoints, matrix, OBSERVATIONS.distortion, lengths, confidence)


def readouts(result: LayerResult) -> list[Tensor]:
    """A random linear function of each of the outputs."""
    generator = torch.Generator().manual_seed(1)
    values = [getattr(result, name) for name in OUTPUTS]
    return [(torch.randn(v.shape, generator=generator, dtype=torch.float64) * v).sum() for v in values]


def gradients(layer: CalibrationLayer) -> tuple[list[list[Tensor]], LayerResult]:
    """Of every readout by every input."""
    leaves = Inputs(*(v.clone().requires_grad_() for v in inputs()))
    result = leaves.run(layer)
    options = {"retain_graph": True, "allow_unused": True, "materialize_grads": True}
    found = [torch.autograd.grad(value, leaves, **options) for value in readouts(result)]
    return [[gradient.nan_to_num() for gradient in of] for of in found], result


@pytest.mark.parametrize("refine", KINDS.values(), ids=KINDS.keys())
def test_gradients_are_those_of_the_whole_calibration(refine: tuple[str, ...]):
    layer = CalibrationLayer(STICK, config(*refine))
    found, result = gradients(layer)
    assert result.status == ("converged",)
    generator = torch.Generator().manual_seed(0)
    steps = Inputs(1e-3, 1e-2, 3e-6, 1e-2, 1e-4)  # pyright: ignore[reportArgumentType]
    upper = torch.tensor([[1.0, 1, 1], [0, 1, 1], [0, 0, 0]], dtype=torch.float64)
    for position, (name, value, step) in enumerate(zip(Inputs._fields, inputs(), steps, strict=True)):
        direction = torch.randn(value.shape, generator=generator, dtype=torch.float64) * (upper if name == "matrix" else 1)
        moved = [inputs()._replace(**{name: value + sign * step * direction}) for sign in (1, -1)]
        with torch.no_grad():
            ahead, behind = (readouts(other.run(layer, initial=result)) for other in moved)
        for output, of, plus, minus in zip(OUTPUTS, found, ahead, behind, strict=True):
            expected = float(plus - minus) / (2 * step)
            assert float((of[position] * direction).sum()) == pytest.approx(expected, rel=1e-5, abs=1e-9), f"{output} by {name}"


def test_unrolled_tends_to_implicit():
    exact, _ = gradients(CalibrationLayer(STICK, config(*KINDS["all"])))

    def error(mode: GaussNewton | Unrolled) -> float:
        found, _ = gradients(CalibrationLayer(STICK, config(*KINDS["all"]), mode))
        return max(float((of[0] - by[0]).norm() / by[0].norm()) for of, by in zip(found, exact, strict=True))

    errors = [error(mode) for mode in (GaussNewton(), Unrolled(1), Unrolled(4), Unrolled(16))]
    assert errors[0] == errors[1] < 0.5
    assert errors[3] < 1e-2 * errors[2] < 1e-3 * errors[1]


def test_lenses_are_those_of_calibrate():
    settings = config(*KINDS["all"])
    wrong = Intrinsics(inputs().matrix, inputs().distortion)
    found = CalibrationLayer(STICK, settings)(OBSERVATIONS.keypoints, wrong)
    expected = calibrate(replace(OBSERVATIONS, intrinsics=wrong.matrix), settings)
    torch.testing.assert_close(found.intrinsics, expected.intrinsics, rtol=1e-6, atol=0)
    torch.testing.assert_close(found.distortion, expected.distortion, rtol=1e-3, atol=0)


def test_a_batch_gives_what_its_sessions_give_and_a_failure_keeps_its_lenses():
    layer = CalibrationLayer(STICK, config("focal", "radial"))
    blind = torch.full_like(OBSERVATIONS.keypoints, torch.nan)
    keypoints = torch.stack([OBSERVATIONS.keypoints, blind, OBSERVATIONS.keypoints + 1.0]).requires_grad_()
    matrix = inputs().matrix + torch.tensor([0.0, 20.0, -20.0], dtype=torch.float64)[:, None, None, None] * FOCAL
    matrix = matrix.requires_grad_()
    together = layer(keypoints, matrix)
    assert together.converged.tolist() == [True, False, True]
    assert together.distortion is not None
    torch.testing.assert_close(together.intrinsics[1], matrix[1], rtol=0, atol=0)
    assert (together.distortion[1] == 0).all()
    found = torch.autograd.grad(sum(sum(readouts(together[k])) for k in range(3)), (keypoints, matrix))
    assert (found[0][1] == 0).all()
    assert (found[1][1] == 0).all()
    for k in (0, 2):
        one = keypoints[k].detach().requires_grad_(), matrix[k].detach().requires_grad_()
        alone = layer(*one)
        for name in OUTPUTS:
            torch.testing.assert_close(getattr(together, name)[k], getattr(alone, name), rtol=1e-8, atol=1e-8)
        for of_batch, expected in zip(found, torch.autograd.grad(sum(readouts(alone)), one), strict=True):
            torch.testing.assert_close(of_batch[k], expected, rtol=1e-6, atol=1e-6, equal_nan=True)


def test_a_warm_start_leads_to_the_same_place_from_the_lenses_found():
    layer = CalibrationLayer(STICK, config("focal", "radial"))
    before, cold = layer(OBSERVATIONS.keypoints + 0.5, inputs().matrix), layer(OBSERVATIONS.keypoints, inputs().matrix)
    warm = layer(OBSERVATIONS.keypoints, inputs().matrix, initial=before)
    for name in OUTPUTS:
        torch.testing.assert_close(getattr(warm, name), getattr(cold, name), rtol=1e-7, atol=1e-7)
    with pytest.raises(ObservationError, match="another choice of what to refine"):
        CalibrationLayer(STICK)(OBSERVATIONS.keypoints, inputs().matrix, initial=before)


def test_a_warm_start_at_the_minimum_stays_there():
    reprojection = {"sigma_px": 1.0, "kernel": "cauchy"}
    only = {"reprojection": reprojection, "stick_length": {"sigma_m": 0.001}, "cost_tolerance": 1e-6}
    layers = [
        CalibrationLayer(STICK, {"stages": {"only": only | {"max_iterations": limit}}, "refine": ["focal", "radial"]})
        for limit in (100, 1)
    ]
    found = layers[0](OBSERVATIONS.keypoints, inputs().matrix)
    assert layers[1](OBSERVATIONS.keypoints, inputs().matrix).status == ("only: stopped at the limit of iterations",)
    assert layers[1](OBSERVATIONS.keypoints, inputs().matrix, initial=found).status == found.status == ("converged",)


def test_lenses_not_refined_are_passed_on():
    matrix = inputs().matrix.requires_grad_()
    result = CalibrationLayer(STICK)(OBSERVATIONS.keypoints, matrix)
    torch.testing.assert_close(result.intrinsics, matrix, rtol=0, atol=0)
    assert result.distortion is None
    (gradient,) = torch.autograd.grad(result.intrinsics.sum(), matrix)
    assert (gradient == 1).all()


def test_what_has_no_gradient_and_groups_that_do_not_fit_are_refused():
    with pytest.raises(ConfigError, match="cannot choose what to refine"):
        CalibrationLayer(STICK, {"extends": "default", "refine": "auto"})
    with pytest.raises(ConfigError, match="camera groups do not fit"):
        CalibrationLayer(STICK, config("focal_shared") | {"camera_groups": ["a"]})(OBSERVATIONS.keypoints, inputs().matrix)
