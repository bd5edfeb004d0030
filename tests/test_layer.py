"""The calibration as a layer: exact gradients, batches, failures, and the places where a layer has to live."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from torchstickcal import (
    CalibrationLayer,
    GaussNewton,
    Implicit,
    Intrinsics,
    LayerResult,
    ObservationError,
    Unrolled,
    calibrate,
)
from torchstickcal.layer.layer import _side_by_side
from torchstickcal.simulate import Noise, golf_session
from torchstickcal.solvers.linearised import Linearised, Tangent

OBSERVATIONS, TRUTH = golf_session(cameras=4, frames=12, noise=Noise(sigma_px=2.0, missing=0.05))
OTHER, _ = golf_session(cameras=4, frames=12, noise=Noise(sigma_px=1.0), seed=1)
STICK = OBSERVATIONS.sticks[0]


def config(kernel: str = "none", smooth: bool = False, held: bool = False, rescale: bool = False) -> dict[str, Any]:
    """Two stages and known noise, so that the whole is a differentiable function of its input."""
    reprojection: dict[str, Any] = {"sigma_px": 2.0, "kernel": kernel}
    if kernel != "none":
        reprojection["kernel_scale"] = 3.0
    metric: dict[str, Any] = {"reprojection": reprojection, "stick_length": {"sigma_m": 0.02}, "rescale": rescale}
    if smooth:
        metric["smoothness"] = {"sigma_m": 0.3}
    stages = {"unscaled": {"reprojection": reprojection, "rescale": True, "cost_tolerance": 1e-3}, "metric": metric}
    if held:
        stages["trajectories"] = {"cameras": "held", "reprojection": reprojection, "smoothness": {"sigma_m": 0.1}}
    return {"stages": stages}


class Inputs(NamedTuple):
    keypoints: Tensor
    matrix: Tensor
    distortion: Tensor
    lengths: Tensor
    confidence: Tensor

    def run(self, layer: CalibrationLayer, initial: LayerResult | None = None) -> LayerResult:
        lens = Intrinsics(self.matrix.expand(4, 3, 3), self.distortion)
        return layer(self.keypoints, lens, self.lengths, self.confidence, initial)


def inputs() -> Inputs:
    generator = torch.Generator().manual_seed(2)
    confidence = 0.5 + 0.5 * torch.rand(OBSERVATIONS.keypoints.shape[:-1], generator=generator, dtype=torch.float64)
    assert OBSERVATIONS.distortion is not None
    lengths = torch.tensor([1.0], dtype=torch.float64)
    return Inputs(OBSERVATIONS.keypoints, OBSERVATIONS.intrinsics, OBSERVATIONS.distortion, lengths, confidence)


def readout(result: LayerResult, seed: int = 1) -> Tensor:
    """A random linear function of everything that carries gradients."""
    generator = torch.Generator().manual_seed(seed)
    values = (result.rotations, result.translations, result.points)
    weights = [torch.randn(v.shape, generator=generator, dtype=torch.float64).to(v) for v in values]
    return sum(((w * v).sum() for w, v in zip(weights, values, strict=True)), start=values[0].new_zeros(()))


def gradients(layer: CalibrationLayer) -> tuple[list[Tensor], LayerResult]:
    leaves = Inputs(*(v.clone().requires_grad_() for v in inputs()))
    result = leaves.run(layer)
    return [g.nan_to_num() for g in torch.autograd.grad(readout(result), leaves)], result


CASES = {
    "least squares": config(),
    "cauchy": config("cauchy"),
    "smooth": config(smooth=True),
    "cauchy, smooth": config("cauchy", smooth=True),
    "held cameras": config("cauchy", held=True),
    "brought to scale": config("cauchy", rescale=True),
}


@pytest.mark.parametrize("case", CASES.values(), ids=CASES.keys())
def test_implicit_gradients_are_those_of_the_whole_calibration(case: dict[str, Any]):
    layer = CalibrationLayer(STICK, case)
    found, result = gradients(layer)
    assert result.status == ("converged",)
    generator = torch.Generator().manual_seed(0)
    steps = Inputs(1e-3, 1e-2, 1e-5, 1e-5, 1e-4)  # pyright: ignore[reportArgumentType]
    upper = torch.tensor([[1.0, 1, 1], [0, 1, 1], [0, 0, 0]], dtype=torch.float64)
    for position, (name, value, step) in enumerate(zip(Inputs._fields, inputs(), steps, strict=True)):
        direction = torch.randn(value.shape, generator=generator, dtype=torch.float64) * (upper if name == "matrix" else 1)
        moved = [inputs()._replace(**{name: value + sign * step * direction}) for sign in (1, -1)]
        with torch.no_grad():
            ahead, behind = (readout(other.run(layer, initial=result)) for other in moved)
        expected = float(ahead - behind) / (2 * step)
        assert float((found[position] * direction).sum()) == pytest.approx(expected, rel=1e-5), name


def test_unrolled_tends_to_implicit_and_gauss_newton_is_near():
    exact, _ = gradients(CalibrationLayer(STICK, config("cauchy"), Implicit()))

    def error(mode: GaussNewton | Unrolled) -> float:
        found, _ = gradients(CalibrationLayer(STICK, config("cauchy"), mode))
        return max(float((a - b).norm() / b.norm()) for a, b in zip(found, exact, strict=True))

    errors = [error(mode) for mode in (GaussNewton(), Unrolled(1), Unrolled(4), Unrolled(16))]
    assert errors[0] == errors[1] < 0.5
    assert errors[3] < 1e-2 * errors[2] < 1e-3 * errors[1]


@pytest.mark.parametrize("name", ["default", "paper"])
def test_values_are_those_of_calibrate(name: str):
    expected = calibrate(OBSERVATIONS, name)
    result = CalibrationLayer(STICK, name)(OBSERVATIONS.keypoints, OBSERVATIONS.cameras)
    sigma = float((expected.translations - TRUTH.translations).abs().max())
    assert float((result.translations - expected.translations).abs().max()) < 1e-3 * sigma
    assert torch.equal(result.inliers, expected.inliers)
    assert torch.equal(result.known, expected.points.isfinite().all(-1))


@pytest.mark.parametrize("name", ["default", "paper"])
def test_a_batch_gives_what_its_sessions_give(name: str):
    layer = CalibrationLayer(STICK, name)
    keypoints = torch.stack([OBSERVATIONS.keypoints, OTHER.keypoints, OBSERVATIONS.keypoints + 1.0]).requires_grad_()
    together = layer(keypoints, OBSERVATIONS.cameras)
    (gradient,) = torch.autograd.grad(sum(readout(together[k]) for k in range(3)), keypoints)
    for k in range(3):
        one = keypoints[k].detach().requires_grad_()
        alone = layer(one, OBSERVATIONS.cameras)
        for field in ("rotations", "translations", "points"):
            torch.testing.assert_close(getattr(together, field)[k], getattr(alone, field), rtol=1e-9, atol=1e-9)
        (expected,) = torch.autograd.grad(readout(alone), one)
        torch.testing.assert_close(gradient[k], expected, rtol=1e-6, atol=1e-9, equal_nan=True)


@pytest.mark.parametrize("count", [0, 1, 4, 5, 6, 10, 17, 64])
@pytest.mark.parametrize("keypoints", [100, 6300, 40_000, 200_000])
def test_sessions_are_divided_evenly(count: int, keypoints: int):
    groups = _side_by_side(list(range(count)), keypoints, torch.device("cpu"))
    assert [session for group in groups for session in group] == list(range(count))
    sizes = [len(group) for group in groups]
    assert not sizes or 1 <= max(sizes) <= min(sizes) + 1
    assert len(groups) < 2 or len(groups) % 2 == 0 or len(groups) == count  # two threads get equally many
    assert all(size == 1 or size * keypoints <= 64_000 for size in sizes)
    assert _side_by_side(list(range(count)), keypoints, torch.device("cuda")) == [list(range(count))] * (count > 0)


def test_a_minimum_that_no_gradient_passes_through_takes_no_time():
    solved: list[bool] = []

    class Counting:
        def solve(self, minimum: Linearised, gradient: Tangent) -> Tangent:
            solved.append(minimum.cameras_free)
            return Implicit().solve(minimum, gradient)

    def gradient(share_of_points: float | None) -> Tensor:
        keypoints = OBSERVATIONS.keypoints.clone().requires_grad_()
        result = CalibrationLayer(STICK, gradient=Counting())(keypoints, OBSERVATIONS.cameras)
        value = result.translations.sum()
        value = value if share_of_points is None else value + share_of_points * result.points.nansum()
        solved.clear()
        return torch.autograd.grad(value, keypoints)[0]

    by_cameras = gradient(None)
    assert solved
    assert all(solved)
    by_all = gradient(1e-12)
    assert not all(solved)
    torch.testing.assert_close(by_cameras, by_all, rtol=1e-6, atol=1e-10, equal_nan=True)


def test_a_session_that_fails_has_a_status_no_gradient_and_no_influence():
    layer = CalibrationLayer(STICK)
    blind = torch.full_like(OBSERVATIONS.keypoints, torch.nan)
    apart = OBSERVATIONS.keypoints.clone()
    apart[0, ::2] = torch.nan
    apart[1:, 1::2] = torch.nan
    keypoints = torch.stack([blind, OBSERVATIONS.keypoints, apart]).requires_grad_()
    result = layer(keypoints, OBSERVATIONS.cameras)
    assert result.converged.tolist() == [False, True, False]
    assert "never seen" in result.status[0]
    assert "see too little in common" in result.status[2]
    (gradient,) = torch.autograd.grad(readout(result), keypoints)
    assert (gradient[[0, 2]] == 0).all()
    assert gradient[1].nan_to_num().abs().max() > 0
    alone = layer(OBSERVATIONS.keypoints, OBSERVATIONS.cameras)
    torch.testing.assert_close(result.translations[1], alone.translations, rtol=0, atol=1e-9)


def test_a_warm_start_leads_to_the_same_place_even_where_a_point_appears():
    layer = CalibrationLayer(STICK, config("cauchy"))
    hidden = OBSERVATIONS.keypoints.clone()
    hidden[:, 3, 5] = torch.nan
    before = layer(hidden + 0.5, OBSERVATIONS.cameras)
    assert not before.known[3, 5]
    cold, warm = (
        layer(OBSERVATIONS.keypoints, OBSERVATIONS.cameras),
        layer(OBSERVATIONS.keypoints, OBSERVATIONS.cameras, initial=before),
    )
    torch.testing.assert_close(warm.points, cold.points, rtol=0, atol=1e-8)


def test_float32_autocast_no_grad_and_checkpointing():
    layer, lens = CalibrationLayer(STICK), OBSERVATIONS.cameras
    exact = layer(OBSERVATIONS.keypoints, lens)
    keypoints = OBSERVATIONS.keypoints.float().requires_grad_()
    with torch.autocast("cpu", torch.bfloat16):
        result = layer(keypoints, lens)
    assert result.points.dtype == result.rotations.dtype == torch.float32
    torch.testing.assert_close(result.translations.double(), exact.translations, rtol=0, atol=1e-4)
    (plain,) = torch.autograd.grad(readout(result), keypoints)
    assert plain.dtype == torch.float32
    (again,) = torch.autograd.grad(checkpoint(lambda k: readout(layer(k, lens)), keypoints, use_reentrant=False), keypoints)
    torch.testing.assert_close(again, plain, rtol=1e-4, atol=1e-6, equal_nan=True)
    with torch.no_grad():
        assert not layer(keypoints, lens).points.requires_grad


def test_shapes_that_do_not_fit_are_refused():
    layer = CalibrationLayer(STICK)
    with pytest.raises(ObservationError, match="keypoints have the wrong shape"):
        layer(OBSERVATIONS.keypoints[0], OBSERVATIONS.cameras)
    with pytest.raises(ObservationError, match="stick_lengths"):
        layer(OBSERVATIONS.keypoints, OBSERVATIONS.cameras, torch.ones(3))
    with pytest.raises(ObservationError, match="intrinsics"):
        layer(OBSERVATIONS.keypoints, torch.eye(3).expand(5, 3, 3))


def test_arrays_of_every_kind_are_calibrated_alike():
    layer, keypoints, cameras = CalibrationLayer(STICK), OBSERVATIONS.keypoints, OBSERVATIONS.cameras
    expected = layer(keypoints, cameras)
    matrix, distortion = cameras.matrix.numpy(), cameras.distortion.numpy()
    for given in (keypoints.numpy()[:, ::-1][:, ::-1], keypoints.tolist(), list(keypoints), np.ma.masked_invalid(keypoints)):
        result = layer(given, Intrinsics(matrix, distortion[:, None]), [1.0], np.ones(keypoints.shape[:3]))
        assert result.status == ("converged",)
        assert torch.equal(result.translations, expected.translations)


@pytest.mark.parametrize(
    ("dtype", "expected"),
    [
        (torch.int64, torch.float64),
        (torch.int16, torch.float64),
        (torch.float16, torch.float32),
        (torch.bfloat16, torch.float32),
    ],
)
def test_results_are_in_float32_at_least(dtype: torch.dtype, expected: torch.dtype):
    keypoints = OBSERVATIONS.keypoints.nan_to_num(500.0).to(dtype)
    result, same = (CalibrationLayer(STICK)(given, OBSERVATIONS.cameras) for given in (keypoints, keypoints.double()))
    assert result.rotations.dtype == result.intrinsics.dtype == expected
    torch.testing.assert_close(result.rotations.double(), same.rotations, rtol=0, atol=1e-6)
    torch.testing.assert_close(result.intrinsics.double(), OBSERVATIONS.cameras.matrix, rtol=1e-6, atol=0)


def test_arguments_that_do_not_fit_are_errors_and_no_status():
    keypoints, cameras = OBSERVATIONS.keypoints, OBSERVATIONS.cameras
    layer, confidence = CalibrationLayer(STICK), torch.ones(keypoints.shape[:3])
    for wrong in (confidence.transpose(1, 2), confidence.transpose(0, 1), confidence[:, :-1], confidence[:, :1], "x"):
        with pytest.raises(ObservationError, match="confidence"):
            layer(keypoints, cameras, confidence=wrong)
    for wrong in (keypoints[0], keypoints[:1], keypoints[:, :0], keypoints[..., :1], None):
        with pytest.raises(ObservationError, match="keypoints"):
            layer(wrong, cameras)
    with pytest.raises(ObservationError, match="a stick's end is not a tracked point"):
        layer(keypoints[:, :, :5], cameras)
    with pytest.raises(ObservationError, match="distortion has the wrong shape"):
        layer(keypoints, Intrinsics(cameras.matrix, cameras.distortion[:, :3]))
    with pytest.raises(ObservationError, match=r"image_size.*\(3,\)"):
        layer(keypoints, cameras, image_size=(1, 2, 3))
    with pytest.raises(ObservationError, match="two sticks have the same ends"):
        CalibrationLayer([STICK, STICK])


def test_no_sessions_give_no_results():
    keypoints = OBSERVATIONS.keypoints[None, ...][:0].requires_grad_()
    result = CalibrationLayer(STICK, {"extends": "default", "refine": ["focal"]})(keypoints, OBSERVATIONS.cameras)
    cameras, frames, points, _ = keypoints.shape[1:]
    assert result.status == ()
    shapes = {"rotations": (0, cameras, 3, 3), "points": (0, frames, points, 3), "inliers": (0, *keypoints.shape[1:4])}
    assert {name: tuple(getattr(result, name).shape) for name in shapes} == shapes
    result.points.sum().backward()
    assert keypoints.grad.shape == keypoints.shape


@pytest.mark.parametrize("bad", [torch.nan, torch.inf, 1e8, 1e154, 1e300])
def test_a_batch_that_fails_has_gradients_of_zero(bad: float):
    given = inputs()
    keypoints = torch.stack([OBSERVATIONS.keypoints, torch.full_like(OBSERVATIONS.keypoints, bad)])
    for sessions in ([1], [1, 1], [0, 1]):
        leaves = [v.clone().requires_grad_() for v in (keypoints[sessions], given.matrix, given.lengths)]
        result = CalibrationLayer(STICK)(*leaves)
        assert result.converged.tolist() == [session == 0 for session in sessions]
        (result.rotations.sum() + result.translations.sum() + result.points.sum()).backward()
        assert all(leaf.grad.isfinite().all() for leaf in leaves)
        assert not leaves[0].grad[1 if 0 in sessions else slice(None)].any()


def test_lens_models_of_different_length_in_one_batch():
    lens = torch.zeros(2, 4, 14, dtype=torch.float64)
    lens[0, :, 12:] = 0.01
    lens.requires_grad_()
    keypoints = OTHER.keypoints.expand(2, -1, -1, -1, -1)
    result = CalibrationLayer(STICK)(keypoints, Intrinsics(OTHER.intrinsics.expand(2, 4, 3, 3), lens))
    assert result.status == ("converged", "converged")
    result.points.sum().backward()
    assert (lens.grad.abs().sum(1) > 0).all()


@pytest.mark.parametrize("gradient", ["implicit", "gauss_newton", "unrolled"])
def test_a_session_that_has_not_converged_has_no_gradient(gradient: str):
    observations, _ = golf_session(cameras=3, frames=6, noise=Noise(1.0))
    keypoints = observations.keypoints.requires_grad_()
    config = {"extends": "default", "stages": {"unscaled": {"max_iterations": 1}}}
    result = CalibrationLayer(observations.sticks, config, gradient)(keypoints, observations.cameras)
    assert not result.converged
    result.translations.square().sum().backward()
    assert keypoints.grad is not None
    assert bool((keypoints.grad == 0).all())
