"""Noise that is estimated is a part of the layer: its gradients, what a confidence means, and confidences that say nothing."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
import torch
from torch import Tensor

from torchstickcal import CalibrationLayer, ConfigError, Intrinsics, LayerResult, Observations, calibrate
from torchstickcal.geometry.symmetric import inverse_diagonal
from torchstickcal.losses import CameraPointLoss, FrameLoss
from torchstickcal.model.objective import Objective
from torchstickcal.pipeline.adjust import adjust_cameras, begin
from torchstickcal.pipeline.noise import HeldNoise
from torchstickcal.pipeline.run import Run
from torchstickcal.simulate import Noise, SessionSpec, golf_session
from torchstickcal.simulate.regimes import Views
from torchstickcal.solvers.acceleration import Acceleration
from torchstickcal.solvers.elimination.normal_equations import NormalEquations


class Inputs(NamedTuple):
    keypoints: Tensor
    confidence: Tensor
    of_points: Tensor
    """(P,), a factor on the confidences of each point"""
    matrix: Tensor
    lengths: Tensor


class Case(NamedTuple):
    given: Observations
    inputs: Inputs

    def run(self, layer: CalibrationLayer, inputs: Inputs) -> LayerResult:
        lens = Intrinsics(inputs.matrix, self.given.distortion)
        return layer(inputs.keypoints, lens, inputs.lengths, inputs.confidence * inputs.of_points)


def case(seed: int, lasting_px: float = 0.0, wrong: float = 0.0) -> Case:
    """A session, with errors that last for some ten frames, and with a share of keypoints that are far off."""
    frames = 40 if lasting_px else 14
    given, _ = golf_session(cameras=4, frames=frames, noise=Noise(sigma_px=1.0, missing=0.05), seed=seed)
    generator = torch.Generator().manual_seed(3)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    keypoints, error = given.keypoints, normal(4, *given.keypoints.shape[2:])
    errors = []
    for _ in range(frames):
        error = 0.9 * error + 0.19**0.5 * normal(*error.shape)
        errors.append(error)
    keypoints = keypoints + lasting_px * torch.stack(errors, dim=1)
    is_wrong = torch.rand(keypoints.shape[:-1], generator=generator, dtype=torch.float64) < wrong
    keypoints = torch.where(is_wrong[..., None], keypoints + 150.0, keypoints)
    points = keypoints.shape[2]
    confidence = 0.3 + 0.5 * torch.rand(keypoints.shape[:-1], generator=generator, dtype=torch.float64)
    lengths = torch.tensor([stick.length_m for stick in given.sticks], dtype=torch.float64)
    matrix = given.intrinsics.double().expand(4, 3, 3)
    return Case(given, Inputs(keypoints, confidence, torch.full((points,), 0.8, dtype=torch.float64), matrix, lengths))


def readouts(result: LayerResult) -> list[Tensor]:
    """Random linear functions of the cameras and of the points."""
    generator = torch.Generator().manual_seed(1)

    def along(values: Tensor) -> Tensor:
        return (values * torch.randn(values.shape, generator=generator, dtype=torch.float64)).sum()

    return [along(result.rotations) + along(result.translations), along(result.points)]


CASES = {"clean": case(0), "outliers": case(1, wrong=0.02), "errors that last": case(0, lasting_px=3.0)}


@pytest.mark.parametrize("tried", CASES.values(), ids=CASES.keys())
@pytest.mark.parametrize("noise", ["estimated", "given"])
def test_gradients_of_the_whole_default(tried: Case, noise: str):
    if noise == "given" and tried is not CASES["clean"]:
        pytest.skip("one session is enough")
    layer = CalibrationLayer(tried.given.sticks, noise=noise)  # pyright: ignore[reportArgumentType]
    leaves = Inputs(*(value.clone().requires_grad_() for value in tried.inputs))
    result = tried.run(layer, leaves)
    assert result.status == ("converged",)
    found = [torch.autograd.grad(value, leaves, retain_graph=True) for value in readouts(result)]
    generator = torch.Generator().manual_seed(2)
    steps = Inputs(3e-4, 1e-4, 2e-4, 1e-2, 1e-5)  # pyright: ignore[reportArgumentType]
    upper = torch.tensor([[1.0, 0, 1], [0, 1, 1], [0, 0, 0]], dtype=torch.float64)
    for position, (name, value, step) in enumerate(zip(Inputs._fields, tried.inputs, steps, strict=True)):
        direction = torch.randn(value.shape, generator=generator, dtype=torch.float64) * (upper if name == "matrix" else 1)
        moved = [tried.inputs._replace(**{name: value + sign * step * direction}) for sign in (1, -1)]
        with torch.no_grad():
            ahead, behind = (tried.run(layer, other) for other in moved)
        assert torch.equal(ahead.inliers, behind.inliers), "a decision has changed: this compares nothing"
        for kind, gradient, plus, minus in zip(("cameras", "points"), found, readouts(ahead), readouts(behind), strict=True):
            expected = float(plus - minus) / (2 * step)
            inner = float((gradient[position].nan_to_num() * direction).sum())
            assert inner == pytest.approx(expected, rel=1e-4), f"{name}, {kind}"


def test_errors_that_last_do_so_here():
    tried = CASES["errors that last"]
    run = Run(CalibrationLayer(tried.given.sticks).config)
    ended = adjust_cameras(
        begin(Observations(tried.inputs.keypoints, tried.given.cameras.matrix, tried.given.sticks), run), run
    )
    assert ended.last.correlation_frames.max() > 2


def test_a_factor_on_the_confidences_of_a_point():
    tried, one, effects = CASES["clean"], torch.zeros_like(CASES["clean"].inputs.of_points), []
    one[4] = 0.1
    for noise in ("estimated", "given"):
        layer = CalibrationLayer(tried.given.sticks, noise=noise)
        factors = tried.inputs.of_points.clone().requires_grad_()
        result = tried.run(layer, tried.inputs._replace(of_points=factors))
        (by_factors,) = torch.autograd.grad(result.translations.norm(dim=-1).sum(), factors)
        with torch.no_grad():
            before, after = (tried.run(layer, tried.inputs._replace(of_points=factors + sign * one)) for sign in (-1, 1))
        expected = float((after.translations.norm(dim=-1) - before.translations.norm(dim=-1)).sum()) / 0.2
        assert float(by_factors[4]) == pytest.approx(expected, rel=0.1)
        effects.append(expected)
    assert effects[0] != pytest.approx(effects[1], rel=0.3)


@pytest.mark.parametrize("sigma_px", [1.5, [0.5 + 0.1 * point for point in range(21)]])
def test_given_noise_means_the_same_in_calibrate_and_in_the_layer(sigma_px: float | list[float]):
    given, config = CASES["clean"].given, {"extends": "default", "sigma_px": sigma_px}
    confidence = CASES["clean"].inputs.confidence
    observations = Observations(given.keypoints, given.intrinsics, given.sticks, given.distortion, confidence)
    expected = calibrate(observations, config, noise="given")
    result = CalibrationLayer(given.sticks, config, noise="given")(given.keypoints, given.cameras, confidence=confidence)
    torch.testing.assert_close(result.translations, expected.translations, rtol=0, atol=1e-6)
    also = calibrate(observations, {**config, "noise": "given"})
    assert torch.equal(also.translations, expected.translations)
    estimated = calibrate(observations, config)
    assert (estimated.translations - expected.translations).abs().max() > 1e-4
    assert torch.equal(
        calibrate(observations, {**config, "noise": "given"}, noise="estimated").translations, estimated.translations
    )
    quieter = Observations(given.keypoints, given.intrinsics, given.sticks, given.distortion, confidence * 0.25)
    louder = {"extends": "default", "sigma_px": (torch.tensor(sigma_px) / 2).tolist()}
    again = calibrate(quieter, louder, noise="given")
    torch.testing.assert_close(again.translations, expected.translations, rtol=0, atol=1e-5)


def test_noise_that_cannot_be_used_is_refused():
    given = CASES["clean"].given
    with pytest.raises(ConfigError, match="noise"):
        CalibrationLayer(given.sticks, noise="known")  # pyright: ignore[reportArgumentType]
    with pytest.raises(ConfigError, match="noise"):
        calibrate(given, noise="known")  # pyright: ignore[reportArgumentType]
    with pytest.raises(ConfigError, match="another number of points"):
        calibrate(given, {"extends": "default", "sigma_px": [1.0, 2.0]}, noise="given")
    for sigma_px in (0.0, -1.0, [1.0, 0.0], "1"):
        with pytest.raises(ConfigError, match="sigma_px"):
            CalibrationLayer(given.sticks, {"extends": "default", "sigma_px": sigma_px})


@pytest.mark.parametrize("noise", ["estimated", "given"])
@pytest.mark.parametrize("tiny", [1e-5, 1e-9, 1e-12, 1e-30])
@pytest.mark.parametrize("largest", [1.0, 1e-3])
def test_tiny_confidences_count_as_none(noise: str, tiny: float, largest: float):
    given = CASES["clean"].given
    generator = torch.Generator().manual_seed(1)
    half = torch.rand(given.keypoints.shape[:-1], generator=generator) < 0.5
    found: list[tuple[LayerResult, Tensor]] = []
    for small in (tiny, 0.0):
        confidence = torch.where(half, largest, largest * small).double().requires_grad_()
        result = CalibrationLayer(given.sticks, noise=noise)(  # pyright: ignore[reportArgumentType]
            given.keypoints, given.cameras, confidence=confidence
        )
        (gradient,) = torch.autograd.grad(result.translations.square().sum() + result.points.square().mean(), confidence)
        found.append((result, gradient))
    (with_tiny, gradient), (without, expected) = found
    assert with_tiny.status == without.status
    assert torch.equal(with_tiny.translations, without.translations)
    assert torch.equal(with_tiny.points, without.points)
    assert torch.equal(gradient, expected)
    assert not gradient[~half].any()


def constant(views: Views, rng: np.random.Generator) -> Views:
    """Each camera sees each joint, but no end of the stick, with an offset that stays."""
    cameras, _, points, axes = views.keypoints.shape
    offsets = 3.0 * rng.standard_normal((cameras, 1, points, axes))
    offsets[:, :, -2:] = 0
    return replace(views, keypoints=views.keypoints + offsets)


def test_gradients_are_of_the_right_size_where_noise_and_minimum_do_not_agree():
    """With strong errors that stay, the noise that is found at a minimum may lead to another one, again and again."""
    spec = SessionSpec("golf", "golf", seed=48, cameras=4, frames=20, regimes=(Noise(1.5), constant))
    given = spec.generate().observations
    layer = CalibrationLayer(given.sticks)
    generator = torch.Generator().manual_seed(0)
    weights = torch.randn(3, 3, generator=generator, dtype=torch.float64)
    direction = torch.randn(given.keypoints.shape, generator=generator, dtype=torch.float64)

    def readout(keypoints: Tensor) -> Tensor:
        return (layer(keypoints, given.cameras).translations[1:] * weights).sum()

    keypoints = given.keypoints.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(readout(keypoints), keypoints)
    with torch.no_grad():
        change = float(readout(keypoints + 1e-4 * direction) - readout(keypoints - 1e-4 * direction)) / 2e-4
    assert abs(float((gradient.nan_to_num() * direction).sum()) - change) < abs(change)


def test_calibrate_has_the_same_bound():
    given = CASES["clean"].given
    half = torch.arange(given.num_points) % 2 == 0

    def with_small(small: float) -> Tensor:
        confidence = torch.where(half, 0.5, 0.5 * small).expand(given.keypoints.shape[:-1]).clone()
        confidence[:2] = 0.5
        return calibrate(
            Observations(given.keypoints, given.intrinsics, given.sticks, given.distortion, confidence)
        ).translations

    assert torch.equal(with_small(1e-5), with_small(0.0))
    assert not torch.equal(with_small(1e-3), with_small(0.0))


def test_information_of_points_is_that_of_the_normal_equations():
    tried = CASES["outliers"]
    run = Run(CalibrationLayer(tried.given.sticks).config)
    ended = adjust_cameras(begin(tried.given, run), run)
    objective, state = Objective(ended.kept, ended.last.losses), ended.last.minimum
    system, m = NormalEquations(objective, state, cameras_free=False), ended.kept
    torch.testing.assert_close(
        objective.point_variance(state)[m.active], inverse_diagonal(system.point_hessian).mean(1)[m.active]
    )
    for loss in objective.losses.values():
        if isinstance(loss, FrameLoss):
            arguments = m.by_frame(state.points), m.sticks, m.lengths_m[:, None], m.by_frame(m.active)
            torch.testing.assert_close(loss.point_information(*arguments), FrameLoss.point_information(loss, *arguments))
        elif isinstance(loss, CameraPointLoss):
            loss = loss.of_columns(slice(0, m.num_columns), m.points_per_frame)
            points = state.in_cameras().where(m.visible[:, :, None], 1.0)
            arguments = points, state.rotations, m.pixels, m.confidence, m.cameras_at(state)
            torch.testing.assert_close(loss.point_information(*arguments), CameraPointLoss.point_information(loss, *arguments))


@pytest.mark.parametrize("name", ["clean", "errors that last"])
def test_levels_that_are_known_lead_to_the_same_minimum(name: str):
    tried = CASES[name]
    run = Run(CalibrationLayer(tried.given.sticks).config, to_rounding=True)
    ended = adjust_cameras(begin(tried.given, run), run)
    result, m = ended.last, ended.measurements
    held = HeldNoise(run.noise_of(result.stage), result.gates, result.inliers)
    start = result.minimum.scaled(torch.tensor([1.001], dtype=torch.float64))
    for known in (None, held.levels(m, start)):
        found, levels, converged = held.minimum_near(m, start, levels=known)
        assert converged.all()
        torch.testing.assert_close(found.state.translations, result.minimum.translations, rtol=0, atol=1e-9)
        for level, expected in zip(levels, held.levels(m, found.state), strict=True):
            assert torch.equal(level, expected)


def test_accelerated_steps_end_a_linear_iteration():
    generator = torch.Generator().manual_seed(0)
    map_, end = (torch.randn(2, 5, k, generator=generator, dtype=torch.float64) for k in (5, 1))
    map_ = 0.9 * map_ / torch.linalg.matrix_norm(map_, ord=2)[:, None, None]
    at, acceleration = torch.zeros_like(end), Acceleration()
    for _ in range(7):
        step = (map_ @ (at - end) + end - at)[..., 0]
        taken, _ = acceleration.step(step, step)
        at = at + taken[..., None]
    torch.testing.assert_close(at, end, rtol=0, atol=1e-8)
