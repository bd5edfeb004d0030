"""Everything runs on a CUDA device, with the numbers of the CPU."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from torchstickcal import Calibration, CalibrationLayer, LayerResult, Observations, calibrate, check, triangulate
from torchstickcal.simulate import Noise, golf_session

DEVICE = "cuda"

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")


@pytest.fixture(scope="module")
def swing() -> Observations:
    """A golf swing with what recordings have: noise, gaps, and a few gross errors."""
    return golf_session(cameras=4, frames=40, noise=Noise(sigma_px=1.0, missing=0.1, outliers=0.05), seed=3)[0]


@pytest.mark.parametrize("config", ["default", "paper", "lbfgs"])
def test_a_calibration_has_the_numbers_of_the_cpu(swing: Observations, config: str):
    expected, found = calibrate(swing, config), calibrate(swing.to(DEVICE), config)
    assert found.status == expected.status
    _same_calibration(found, expected)


@pytest.mark.parametrize("refine", [["focal", "radial"], ["time_offset", "readout"], "auto"])
def test_lenses_and_clocks_are_found_as_on_the_cpu(swing: Observations, refine: list[str] | str):
    expected, found = (calibrate(o, refine=refine) for o in (swing, swing.to(DEVICE)))  # type: ignore[arg-type]
    assert found.refined == expected.refined
    _same_calibration(found, expected)
    for name, parameter in expected.unknowns.items():
        _close(found.unknowns[name].value, parameter.value, 1e-5)
        _close(found.unknowns[name].suggested, parameter.suggested, 1e-5)


def test_the_verdict_is_that_of_the_cpu(swing: Observations):
    expected, found = calibrate(swing).quality, calibrate(swing.to(DEVICE)).quality
    assert found.verdict == expected.verdict
    assert [finding.code for finding in found.findings] == [finding.code for finding in expected.findings]
    assert found.acceptance is not None
    assert expected.acceptance is not None
    assert found.acceptance.metre_m == pytest.approx(expected.acceptance.metre_m, rel=1e-4)


def test_a_saved_rig_serves_on_the_device(swing: Observations):
    rig = calibrate(swing)
    expected, found = triangulate(swing, rig), triangulate(swing.to(DEVICE), rig)
    assert found.points.device.type == DEVICE
    _close(found.points, expected.points, 1e-6)
    assert check(rig, swing.to(DEVICE)).verdict == check(rig, swing).verdict


def test_the_same_input_gives_the_same_bytes(swing: Observations):
    first, second = (calibrate(swing.to(DEVICE)) for _ in range(2))
    assert torch.equal(first.translations, second.translations)
    assert torch.equal(first.points.nan_to_num(), second.points.nan_to_num())


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_a_batch_and_its_gradients_are_those_of_the_cpu(dtype: torch.dtype):
    sessions = [golf_session(cameras=4, frames=20, noise=Noise(sigma_px=1.0), seed=seed)[0] for seed in range(3)]
    keypoints = torch.stack([session.keypoints for session in sessions]).to(dtype)
    keypoints[2, 1:] = torch.nan  # only one camera sees anything
    confidence = torch.linspace(0.5, 1.0, keypoints.shape[3], dtype=dtype).expand(keypoints.shape[:-1]).contiguous()
    layer, lens = CalibrationLayer(sessions[0].sticks, judge=True), sessions[0].cameras

    def of(device: str) -> tuple[LayerResult, tuple[Tensor, ...]]:
        given = [value.to(device, copy=True).requires_grad_() for value in (keypoints, confidence)]
        result = layer(given[0], lens.to(device), confidence=given[1])
        loss = result.translations.square().sum() + result.points.square().sum()
        return result, torch.autograd.grad(loss, given)

    (expected, slopes), (found, slopes_found) = of("cpu"), of(DEVICE)
    assert found.converged.tolist() == expected.converged.tolist() == [True, True, False]
    for name, tensor in found.tensors().items():
        assert tensor.device.type == DEVICE, name
    _close(found.translations, expected.translations, 1e-6)
    assert found.verdict is not None
    assert expected.verdict is not None
    assert found.verdict.tolist() == expected.verdict.tolist()
    for one, other in zip(slopes_found, slopes, strict=True):
        _close(one, other, 1e-4 * float(other.nan_to_num().abs().max()))
    warm, warm_found = (layer(keypoints.to(start.points.device), lens, initial=start) for start in (expected, found))
    _close(warm_found.translations, warm.translations, 1e-6)


def _same_calibration(found: Calibration, expected: Calibration) -> None:
    for name in ("rotations", "translations", "points", "covariance", "sigma_px", "residuals_px"):
        tensor = getattr(found, name)
        assert tensor.device.type == DEVICE, name
        reference = getattr(expected, name)
        _close(tensor, reference, 1e-5 * max(1.0, float(reference.nan_to_num().abs().max())))
    assert torch.equal(found.inliers.cpu(), expected.inliers)


def _close(found: Tensor, expected: Tensor, atol: float) -> None:
    torch.testing.assert_close(found.cpu(), expected, rtol=0, atol=atol, equal_nan=True, check_dtype=False)
