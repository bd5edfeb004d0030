"""A layer that finds clocks with the rig: what it finds, and how far its gradients are those of the whole."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from torchstickcal import CalibrationLayer, LayerResult, ObservationError, calibrate
from torchstickcal.metrics import pose_errors
from torchstickcal.model.measurements import Measurements
from torchstickcal.pipeline.synchronise import Exposures, common_clock
from torchstickcal.simulate import Clocks, SessionSpec, SimulatedSession
from torchstickcal.simulate.regimes import GaussianNoise

FPS = 60.0
SPEC = SessionSpec("clocks", "hockey", 5, 4, 40, FPS, "ring", regimes=(GaussianNoise(1.0),), clocks=Clocks(0.5 / FPS))
ROLLING = replace(SPEC, clocks=Clocks(0.5 / FPS, readout_s=0.01))
OUTPUTS = ("time_offsets", "readout", "translations", "points")


EVERY_KEYPOINT: dict[str, Any] = {name: {"reject_sigmas": False} for name in ("metric", "selected", "refined", "trajectories")}


def config(*refine: str) -> dict[str, Any]:
    return {"extends": "default", "refine": list(refine)}


def layer_of(session: SimulatedSession, *refine: str) -> CalibrationLayer:
    """With known noise and all keypoints, so that only the motion counts as a constant."""
    known = {
        "reprojection": {"sigma_px": 1.0, "correlation_frames": 1.0},
        "stick_length": {"kernel": "none"},
        "reject_sigmas": False,
    }
    stages: dict[str, Any] = {"unscaled": known, "metric": known, "selected": known, "refined": known}
    stages["trajectories"] = known | {"smoothness": {"sigma_m": 0.1}}
    return CalibrationLayer(session.observations.sticks, config(*refine) | {"stages": stages})


def run(
    layer: CalibrationLayer, session: SimulatedSession, keypoints: Tensor | None = None, initial: LayerResult | None = None
) -> LayerResult:
    given = session.observations
    keypoints = given.keypoints if keypoints is None else keypoints
    return layer(keypoints, given.cameras, initial=initial, image_size=given.image_size)


def values(result: LayerResult) -> list[Tensor]:
    """A random linear function of each of the outputs that carry gradients."""
    generator = torch.Generator().manual_seed(1)
    weights = [torch.randn(getattr(result, name).shape, generator=generator, dtype=torch.float64) for name in OUTPUTS]
    return [(weight * getattr(result, name)).sum() for weight, name in zip(weights, OUTPUTS, strict=True)]


def offsets_frames(session: SimulatedSession) -> Tensor:
    assert session.truth.time_offsets_s is not None
    return session.truth.time_offsets_s * FPS


def test_clocks_are_found_exactly_without_noise():
    session = replace(ROLLING, regimes=()).generate()
    found = run(CalibrationLayer(session.observations.sticks, config("time_offset", "readout")), session)
    assert found.status == ("converged",)
    truth, offsets = session.truth, offsets_frames(session)
    torch.testing.assert_close(found.time_offsets, offsets, rtol=0, atol=1e-3)
    torch.testing.assert_close(found.readout, torch.full_like(offsets, 0.01 * FPS), rtol=0, atol=1e-3)
    errors = pose_errors(found.rotations, found.translations, truth.rotations, truth.translations)
    assert errors.mean_translation_m < 1e-4
    blind = CalibrationLayer(session.observations.sticks)(session.observations.keypoints, session.observations.cameras)
    assert (blind.time_offsets == 0).all()
    assert (blind.readout == 0).all()


def test_cameras_and_clocks_are_those_of_calibrate():
    session = replace(SPEC, frames=120).generate()
    settings = config("time_offset") | {"stages": EVERY_KEYPOINT}
    found = run(CalibrationLayer(session.observations.sticks, settings), session)
    expected = calibrate(session.observations, settings)
    off = (found.time_offsets / FPS - expected.time_offsets)[1:] / expected.unknowns["time_offset"].std[1:]
    assert off.abs().max() < 0.1
    assert ((found.translations - expected.translations)[1:].norm(dim=-1) / expected.camera_std_m[1:]).max() < 0.1


def test_a_batch_gives_what_its_sessions_give():
    sessions = [replace(ROLLING, seed=seed).generate() for seed in (5, 6)]
    given = sessions[0].observations
    layer = CalibrationLayer(given.sticks, config("time_offset", "readout", "focal_shared"))
    keypoints = torch.stack([session.observations.keypoints for session in sessions]).requires_grad_()
    matrix = torch.stack([session.observations.intrinsics.expand(4, 3, 3) for session in sessions])
    together = layer(keypoints, matrix, image_size=given.image_size)
    assert together.status == ("converged", "converged")
    (gradient,) = torch.autograd.grad(together.time_offsets.sum() + together.readout.sum(), keypoints)
    for k in range(2):
        one = keypoints[k].detach().requires_grad_()
        alone = layer(one, matrix[k], image_size=(1920, 1080))
        for name in (*OUTPUTS, "intrinsics", "rotations"):
            torch.testing.assert_close(getattr(together, name)[k], getattr(alone, name), rtol=1e-8, atol=1e-8)
        (expected,) = torch.autograd.grad(alone.time_offsets.sum() + alone.readout.sum(), one)
        torch.testing.assert_close(gradient[k], expected, rtol=1e-6, atol=1e-8, equal_nan=True)


def test_a_warm_start_leads_to_the_same_place_from_the_clocks_found():
    session = SPEC.generate()
    layer = CalibrationLayer(session.observations.sticks, config("time_offset") | {"stages": EVERY_KEYPOINT})
    before, cold = run(layer, session, session.observations.keypoints + 0.5), run(layer, session)
    failed = replace(before, converged=torch.zeros_like(before.converged))
    tenth_of_deviation = (
        float(calibrate(session.observations, config("time_offset")).unknowns["time_offset"].std.max()) * FPS / 10
    )
    for initial in (before, failed):
        warm = run(layer, session, initial=initial)
        torch.testing.assert_close(warm.time_offsets, cold.time_offsets, rtol=0, atol=tenth_of_deviation)
        torch.testing.assert_close(warm.translations, cold.translations, rtol=0, atol=1e-4)


@pytest.mark.parametrize("refine", [("time_offset",), ("time_offset", "readout", "focal_shared")])
def test_gradients_are_those_of_the_solve_with_the_motion_as_it_is(monkeypatch: pytest.MonkeyPatch, refine: tuple[str, ...]):
    session = ROLLING.generate()
    layer, moved = layer_of(session, *refine), Exposures.at_common_times
    last: list[Callable[[Measurements], Measurements]] = []

    def recorded(self: Exposures, seen: Measurements, *at: Any) -> Measurements:
        found = moved(self, seen, *at)
        shift, weight = found.pixels - seen.pixels, (found.confidence / seen.confidence).nan_to_num()
        last.append(lambda m: replace(m, pixels=m.pixels + shift, confidence=m.confidence * weight, motion=found.motion))
        return found

    monkeypatch.setattr(Exposures, "at_common_times", recorded)
    keypoints = session.observations.keypoints.clone().requires_grad_()
    result = run(layer, session, keypoints)
    monkeypatch.setattr(Exposures, "at_common_times", lambda _, seen, *at: last[-1](seen))
    generator = torch.Generator().manual_seed(0)
    direction = torch.randn(keypoints.shape, generator=generator, dtype=torch.float64)
    step = 1e-3
    with torch.no_grad():
        ahead, behind = (values(run(layer, session, keypoints + sign * step * direction, result)) for sign in (1, -1))
    for name, value, plus, minus in zip(OUTPUTS, values(result), ahead, behind, strict=True):
        if value.requires_grad:
            (gradient,) = torch.autograd.grad(value, keypoints, retain_graph=True)
            expected = float(plus - minus) / (2 * step)
            assert float((gradient.nan_to_num() * direction).sum()) == pytest.approx(expected, rel=1e-5), name


def test_gradients_are_near_those_of_the_whole_layer(monkeypatch: pytest.MonkeyPatch):
    """That the motion depends on the keypoints too is left out: here up to a third for the offsets, little for the cameras."""
    monkeypatch.setattr(common_clock, "_MOVED_SIGMAS", 0.0)
    session = SPEC.generate()
    layer = layer_of(session, "time_offset")
    keypoints = session.observations.keypoints.clone().requires_grad_()
    result = run(layer, session, keypoints)
    generator = torch.Generator().manual_seed(0)
    for name in ("time_offsets", "translations"):
        value = values(result)[OUTPUTS.index(name)]
        (gradient,) = torch.autograd.grad(value, keypoints, retain_graph=True)
        gradient = gradient.nan_to_num()
        drift = torch.randn(keypoints.shape[0], 1, *keypoints.shape[2:], generator=generator, dtype=torch.float64)
        for kind, direction in (("descent", gradient / gradient.abs().max()), ("drift", drift)):
            with torch.no_grad():
                ahead, behind = (
                    values(run(layer, session, keypoints + sign * 1e-3 * direction, result))[OUTPUTS.index(name)]
                    for sign in (1, -1)
                )
            found, expected = float((gradient * direction).sum()), float(ahead - behind) / 2e-3
            assert found == pytest.approx(expected, rel=0.4 if name == "time_offsets" else 0.1), f"{name}, {kind}"


def test_a_step_down_a_loss_on_the_offsets_lowers_it():
    session = SPEC.generate()
    layer, truth = CalibrationLayer(session.observations.sticks, config("time_offset")), offsets_frames(session)
    keypoints = session.observations.keypoints.clone().requires_grad_()
    result = run(layer, session, keypoints)
    loss = (result.time_offsets - truth).square().sum()
    loss.backward()
    assert keypoints.grad is not None
    gradient = keypoints.grad.nan_to_num()
    with torch.no_grad():
        after = run(layer, session, keypoints - loss / gradient.square().sum() * gradient, initial=result)
    assert (after.time_offsets - truth).square().sum() < 0.5 * loss


def test_a_read_out_time_needs_the_image_size():
    given = SPEC.generate().observations
    layer = CalibrationLayer(given.sticks, config("readout"))
    with pytest.raises(ObservationError, match="a read-out time cannot be estimated without the image size"):
        layer(given.keypoints, given.cameras)
    with pytest.raises(ObservationError, match="image_size"):
        layer(given.keypoints, given.cameras, image_size=(1920, 1080, 3))
