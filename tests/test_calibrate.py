"""The whole calibration on scenes with known truth."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from torchstickcal import ConfigError, ObservationError, Observations, Stick, calibrate
from torchstickcal.metrics import pose_errors
from torchstickcal.simulate import Noise, golf_session


def errors(calibration, truth):
    return pose_errors(calibration.rotations, calibration.translations, truth.rotations, truth.translations)


@pytest.mark.parametrize("config", ["default", "lbfgs"])
@pytest.mark.parametrize("cameras", [2, 3, 6])
def test_truth_comes_back_without_noise(cameras: int, config: str):
    observations, truth = golf_session(cameras=cameras, frames=40)
    calibration = calibrate(observations, config)
    found = errors(calibration, truth)
    assert calibration.converged
    assert found.rotation_deg.deg2rad().max() < 1e-8
    assert found.translation_m.max() < 1e-8
    known = calibration.points.isfinite().all(-1)
    expected = truth.points @ truth.rotations[0].mT + truth.translations[0]
    assert (calibration.points - expected)[known].abs().max() < 1e-7


def test_paper_configuration_is_as_good_as_its_smoothness_allows(perfect):
    observations, truth = perfect
    assert errors(calibrate(observations, "paper"), truth).translation_m.max() < 1e-3


def test_human_only_takes_its_scale_from_a_height(perfect):
    observations, truth = perfect
    names = observations.point_names
    head, ankles = names.index("head_top"), [names.index("left_ankle"), names.index("right_ankle")]
    height = float((truth.points[:, head] - truth.points[:, ankles].mean(1)).norm(dim=-1).mean())
    calibration = calibrate(observations, {"extends": "human_only", "scale": {"length_m": height}})
    assert errors(calibration, truth).translation_m.max() < 1e-8
    assert calibration.points[:, -2:].isnan().all()
    nameless = dataclasses.replace(observations, point_names=None)
    with pytest.raises(ObservationError, match="no such point"):
        calibrate(nameless, "human_only")


def test_without_a_stick_or_a_length_nothing_sets_the_scale(perfect):
    observations, _ = perfect
    with pytest.raises(ConfigError, match="nothing sets the scale"):
        calibrate(dataclasses.replace(observations, sticks=()))


def test_a_segment_never_seen_whole_sets_no_scale(noisy):
    observations, _ = noisy
    keypoints = observations.keypoints.clone()
    keypoints[:, :, observations.point_names.index("head_top")] = torch.nan
    with pytest.raises(ObservationError, match="never seen in the same frame"):
        calibrate(dataclasses.replace(observations, keypoints=keypoints), "human_only")


@pytest.mark.parametrize("frames", [1, 2, 3])
def test_few_frames_suffice(frames: int):
    observations, truth = golf_session(cameras=4, frames=60)
    few = dataclasses.replace(observations, keypoints=observations.keypoints[:, 20 : 20 + frames])
    assert errors(calibrate(few), truth).translation_m.max() < 1e-8


def test_noise_gaps_and_outliers():
    clean, truth = golf_session(cameras=6, frames=120, noise=Noise(1.5))
    baseline = errors(calibrate(clean), truth).mean_translation_m
    dirty, truth = golf_session(cameras=6, frames=120, noise=Noise(1.5, missing=0.15, outliers=0.1))
    calibration = calibrate(dirty)
    assert calibration.converged
    assert errors(calibration, truth).mean_translation_m < 2 * baseline + 1e-3
    assert any("contradict the others" in warning for warning in calibration.warnings)


def test_two_sticks_of_different_length():
    observations, truth = golf_session(cameras=4, frames=40, noise=Noise(0.5))
    names = observations.point_names
    knee, shin = names.index("left_knee"), names.index("left_shin")
    length = float((truth.points[:, knee] - truth.points[:, shin]).norm(dim=-1).mean())
    two = dataclasses.replace(observations, sticks=(*observations.sticks, Stick(knee, shin, length)))
    calibration = calibrate(two)
    assert calibration.stick_lengths_m.shape == (40, 2)
    torch.testing.assert_close(calibration.stick_lengths_m.nanmean(0), torch.tensor([1.0, length]).double(), rtol=0, atol=1e-3)


def test_results_have_the_callers_dtype_and_accuracy(noisy):
    observations, _ = noisy
    single = dataclasses.replace(observations, keypoints=observations.keypoints.float())
    calibration = calibrate(single)
    for name in ("rotations", "translations", "points", "residuals_px", "stick_lengths_m", "sigma_px", "intrinsics"):
        assert getattr(calibration, name).dtype == torch.float32
    torch.testing.assert_close(calibration.translations.double(), calibrate(observations).translations, rtol=0, atol=2e-4)


@pytest.mark.parametrize("refine", [["focal", "radial"], ["principal_point"], ["time_offset", "readout"]])
def test_float32_precision_knows_lenses_and_clocks(noisy, refine: list[str]):
    observations = dataclasses.replace(noisy[0], image_size=(1920, 1080))
    exact, rounded = (
        calibrate(observations, {"extends": "default", "refine": refine, "precision": p}) for p in ("float64", "float32")
    )
    assert rounded.converged
    for name in refine:
        off = (rounded.unknowns[name].value - exact.unknowns[name].value).abs()
        assert bool((off <= 0.05 * exact.unknowns[name].std + 1e-6).all())


@pytest.mark.parametrize("config", ["default", "paper"])
def test_float32_precision_costs_nothing_against_the_noise(noisy, config: str):
    observations, truth = noisy
    exact, rounded = (calibrate(observations, {"extends": config, "precision": p}) for p in ("float64", "float32"))
    assert rounded.converged
    noise = errors(exact, truth).translation_m
    assert (rounded.camera_centres - exact.camera_centres).norm(dim=1).max() < 0.02 * noise.max()


def test_the_same_input_gives_the_same_bytes(noisy):
    observations, _ = noisy
    first, second = calibrate(observations), calibrate(observations)
    assert torch.equal(first.rotations, second.rotations)
    assert torch.equal(first.points.nan_to_num(), second.points.nan_to_num())


def test_the_first_camera_is_the_world(noisy):
    calibration = calibrate(noisy[0])
    assert torch.equal(calibration.rotations[0], torch.eye(3, dtype=torch.float64))
    assert (calibration.translations[0] == 0).all()


def test_residuals_are_projection_minus_keypoint(noisy):
    observations, _ = noisy
    calibration = calibrate(observations)
    points_cam = torch.einsum("cij,fpj->cfpi", calibration.rotations, calibration.points)
    projected = observations.cameras.project(points_cam + calibration.translations[:, None, None])
    expected = projected - observations.keypoints
    torch.testing.assert_close(calibration.residuals_px, expected, equal_nan=True, rtol=0, atol=1e-9)


def test_a_point_seen_once_is_nan_and_counted(noisy):
    observations, _ = noisy
    keypoints = observations.keypoints.clone()
    keypoints[1:, 5, 3] = torch.nan
    keypoints[0, 5, 3] = 100.0
    calibration = calibrate(dataclasses.replace(observations, keypoints=keypoints))
    assert calibration.points[5, 3].isnan().all()
    assert any("no second camera saw the point" in warning for warning in calibration.warnings)


def test_confidence_weighs_keypoints():
    """Half the frames have ten times the noise and say so: the error falls to near that of the good half."""
    observations, truth = golf_session(cameras=4, frames=120, noise=Noise(0.5))
    generator = torch.Generator().manual_seed(0)
    bad = torch.zeros(4, 120, 21, dtype=torch.bool)
    bad[:, ::2] = True
    noise = 5.0 * torch.randn(observations.keypoints.shape, generator=generator, dtype=torch.float64)
    keypoints = observations.keypoints + noise * bad[..., None]
    confidence = torch.where(bad, 0.01, 1.0)
    trusted = Observations(keypoints, observations.intrinsics, observations.sticks, distortion=observations.distortion)
    weighed = dataclasses.replace(trusted, confidence=confidence)
    quadratic = {"extends": "default", "stages": {"refined": {"reprojection": {"kernel": "none"}, "reject_sigmas": 100.0}}}
    blind, informed = (errors(calibrate(o, quadratic), truth).mean_translation_m for o in (trusted, weighed))
    assert informed < 0.5 * blind


def test_callback_hears_every_iteration_and_the_end(noisy):
    class Listener:
        def __init__(self):
            self.records, self.results = [], []

        def on_iteration(self, record):
            self.records.append(record)

        def on_end(self, calibration):
            self.results.append(calibration)

    listener = Listener()
    calibration = calibrate(noisy[0], callback=listener)
    assert tuple(listener.records) == calibration.iterations
    assert listener.results == [calibration]
    stages = ["unscaled", "metric", "selected", "refined", "trajectories"]
    assert [stage.name for stage in calibration.stages] == stages
    assert calibration.seconds.keys() == {"initialise", "relabel", "total", *stages}


def test_a_stage_that_does_not_converge_is_a_status(noisy):
    calibration = calibrate(
        noisy[0], {"extends": "default", "stages": {"refined": {"max_iterations": 1, "cost_tolerance": 1e-15}}}
    )
    assert not calibration.converged
    assert "refined: stopped at the limit of iterations" in calibration.status
    assert calibration.translations.isfinite().all()
