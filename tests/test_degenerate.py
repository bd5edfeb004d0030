"""Sessions that determine little or nothing: an honest status or a warning, never an exception or a claim."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
import pytest
import torch
from torch import Tensor

from torchstickcal import CalibrationLayer, Observations, RigError, Stick, calibrate
from torchstickcal.config import Refine
from torchstickcal.geometry.singular import covariance_of, definite, propagated, solve_information
from torchstickcal.model.measurements import Measurements
from torchstickcal.pipeline.initialise.graph import _resected
from torchstickcal.pipeline.scale import Ruler, outvoted_factors, scale_factors
from torchstickcal.pipeline.synchronise import clocks_unlike_given, search_offsets
from torchstickcal.simulate import Noise, golf_session
from torchstickcal.solvers.uncertainty import centre_covariances


def session(cameras: int = 4, frames: int = 24, sigma_px: float = 0.5) -> Observations:
    return golf_session(cameras=cameras, frames=frames, noise=Noise(sigma_px))[0]


def with_keypoints(observations: Observations, keypoints: Tensor) -> Observations:
    return replace(observations, keypoints=keypoints)


def test_singular_systems_are_solved_as_far_as_they_are_determined():
    generator = torch.Generator().manual_seed(0)
    half = torch.randn(6, 6, generator=generator, dtype=torch.float64)
    regular, rhs = half @ half.mT + torch.eye(6), torch.randn(6, generator=generator, dtype=torch.float64)
    torch.testing.assert_close(solve_information(regular, rhs), torch.linalg.solve(regular, rhs))
    torch.testing.assert_close(covariance_of(regular), torch.linalg.inv(regular))

    direction = torch.nn.functional.normalize(torch.randn(6, generator=generator, dtype=torch.float64), dim=0)
    project = torch.eye(6) - torch.outer(direction, direction)
    singular = project @ regular @ project
    solution = solve_information(singular, singular @ rhs)
    torch.testing.assert_close(singular @ solution, singular @ rhs)
    covariance = covariance_of(singular)
    assert direction @ covariance @ direction > 1e10
    torch.testing.assert_close(singular @ covariance @ singular, singular, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("size", [6, 12, 18])
@pytest.mark.parametrize("seed", range(3))
def test_no_variance_is_negative_where_some_are_far_larger_than_others(seed: int, size: int):
    """As of a session that is grossly wrong: rounding of the large variances is larger than the small ones."""
    generator = torch.Generator().manual_seed(seed)
    turned = torch.linalg.qr(torch.randn(size, size, generator=generator, dtype=torch.float64)).Q
    root = turned * torch.logspace(-9, 8, size, dtype=torch.float64)
    rounded = root @ root.mT
    assert int(torch.linalg.cholesky_ex(rounded).info) > 0
    mended = definite(rounded)
    assert int(torch.linalg.cholesky_ex(mended).info) == 0
    torch.testing.assert_close(mended, rounded, rtol=0, atol=1e-11 * float(rounded.abs().max()))
    directions = turned.mT[:, None]
    assert (directions @ rounded @ directions.mT).min() < 0 < propagated(directions, rounded).min()
    centres = torch.randn(size // 6 + 1, 3, generator=generator, dtype=torch.float64)
    assert (centre_covariances(centres, rounded).diagonal(dim1=1, dim2=2) >= 0).all()
    sound = rounded + torch.eye(size) * rounded.abs().max()
    assert definite(sound) is sound


@pytest.mark.parametrize("bad", [0.0, torch.nan, torch.inf])
def test_a_system_without_information_is_solved_by_zero(bad: float):
    information = torch.full((3, 3), bad, dtype=torch.float64)
    assert solve_information(information, torch.ones(3).double()).tolist() == [0, 0, 0]
    assert covariance_of(information).diagonal().min() >= 1e12


@pytest.mark.parametrize("refine", [None, "auto", ["focal", "time_offset"]])
def test_a_camera_of_another_scene_is_named_and_nothing_is_known_of_it(refine: list[Refine] | Literal["auto"] | None):
    observations = session()
    keypoints = observations.keypoints.clone()
    keypoints[2] = 1000 * torch.rand(keypoints[2].shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    calibration = calibrate(replace(observations, keypoints=keypoints, fps=60.0), refine=refine)
    assert not calibration.converged
    assert "too few keypoints agree" in calibration.status
    assert any(
        warning.startswith("cam03: ") and "nothing is known of where it is" in warning for warning in calibration.warnings
    )
    assert calibration.camera_std_m[2] > 1e3
    assert calibration.camera_std_m[[1, 3]].max() < 0.1


@pytest.mark.parametrize("seed", range(4))
def test_two_cameras_at_one_place_claim_nothing_that_is_not_so(seed: int):
    """Noise is all that distinguishes the cameras: hardly a keypoint is left, or it is said that they are at one place."""
    observations = session(cameras=2)
    noise = torch.randn(observations.keypoints.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    try:
        calibration = calibrate(with_keypoints(observations, observations.keypoints[:1] + 0.5 * noise))
    except RigError:
        return
    assert not calibration.converged or any("same place" in warning for warning in calibration.warnings)


@pytest.mark.parametrize("offset_px", [0.0, 0.3])
def test_the_same_video_twice_is_named(offset_px: float):
    observations = session(frames=40)
    keypoints = observations.keypoints.clone()
    keypoints[3] = keypoints[1] + offset_px
    found = [w for w in calibrate(with_keypoints(observations, keypoints)).warnings if "same place" in w]
    assert len(found) == 1
    assert found[0].startswith("cam02 and cam04")
    assert not any("same place" in w for w in calibrate(observations).warnings)


@pytest.mark.parametrize("sigma_px", [0.0, 0.5])
@pytest.mark.parametrize("wrong", [0.001, 0.18, 0.5])
def test_sticks_that_contradict_each_other_are_named(sigma_px: float, wrong: float):
    observations = session(sigma_px=sigma_px)
    sticks = (observations.sticks[0], Stick(0, 1, wrong))
    warnings = calibrate(replace(observations, sticks=sticks)).warnings
    assert any("long by the keypoints" in warning for warning in warnings)


def test_sticks_that_agree_are_not_named():
    observations, truth = golf_session(cameras=4, frames=24, noise=Noise(1.0))
    elbow, wrist = observations.point_index("left_elbow"), observations.point_index("left_wrist")
    forearm_m = float((truth.points[0, wrist] - truth.points[0, elbow]).norm())
    found = calibrate(replace(observations, sticks=(observations.sticks[0], Stick(elbow, wrist, forearm_m)))).warnings
    assert not any("long by the keypoints" in warning for warning in found)


def test_a_pause_costs_nothing_and_changes_nothing():
    observations = session(cameras=3, frames=30)
    times = torch.arange(30, dtype=torch.float64).expand(3, 30) / 60
    found = []
    for pause_s in (1.0, 100.0, 1.7e9):
        later = times.clone()
        later[:, 14:] += pause_s
        found.append(calibrate(replace(observations, timestamps=later, fps=60.0)))
    assert found[0].points.shape[0] < 60
    for other in found[1:]:
        assert torch.equal(found[0].translations, other.translations)
        assert torch.equal(found[0].frame_index, other.frame_index)
    assert found[0].times is not None
    assert found[2].times is not None
    later = (found[0].times > 0.5) * torch.tensor(1.7e9 - 1.0, dtype=torch.float64)
    torch.testing.assert_close(found[2].times - found[0].times, later, rtol=0, atol=1e-5)


def test_motionless_keypoints_have_no_time_offset():
    keypoints = session().keypoints[:, :1].expand(-1, 40, -1, -1).clone()
    measurements = Measurements.of(with_keypoints(session(), keypoints))
    assert search_offsets(measurements, 1e308).determined == (True, False, False, False)
    assert clocks_unlike_given(measurements, 10) is None


def test_a_ruler_that_is_never_reconstructed_sets_no_scale():
    observations = session(cameras=3, frames=4)
    gone = observations.keypoints.clone()
    gone[:, :, observations.sticks[0].ends[0]] = torch.nan
    measurements = Measurements.of(observations)
    unseen = measurements.keeping(gone.isfinite().all(-1).flatten(1)[None])
    ends = observations.sticks[0].ends
    ruler = Ruler(ends[:1], ends[1:], torch.ones(1).double(), rigid=True)
    points = torch.randn(1, 3, measurements.num_columns, dtype=torch.float64).requires_grad_()
    factors, reconstructed = scale_factors(unseen, points, [ruler])
    assert not bool(reconstructed)
    assert factors.tolist() == [1.0]
    factors.sum().backward()
    assert points.grad is not None
    assert not points.grad.any()


def test_most_lengths_outvote_a_few_that_are_right_by_chance():
    case, truth = golf_session(cameras=3, frames=20)
    measurements = Measurements.of(replace(case, sticks=[*case.sticks]))
    assert truth.points is not None
    (start, end), known = case.sticks[0].ends, case.sticks[0].length_m
    ruler = Ruler((start,), (end,), torch.tensor([known], dtype=torch.float64), rigid=True)

    def factor(lengths_m: Tensor) -> float:
        points = truth.points.clone()
        direction = torch.nn.functional.normalize(points[:, end] - points[:, start], dim=-1)
        points[:, end] = points[:, start] + lengths_m[:, None] * direction
        return float(outvoted_factors(measurements, points.flatten(0, 1).mT[None].contiguous(), [ruler]))

    alone, scatter = torch.linspace(0.3, 3.0, 20, dtype=torch.float64), torch.linspace(-0.01, 0.01, 20, dtype=torch.float64)
    most = torch.full((20,), 0.6 * known, dtype=torch.float64) + scatter * known
    few_right = torch.arange(20) < 4
    assert factor(torch.where(few_right, known, most)) == pytest.approx(1 / 0.6, rel=0.01)
    assert factor(torch.where(~few_right, known, most)) == 1  # the known length has the majority
    assert factor(torch.where(torch.arange(20) < 9, known, most)) == 1  # not clearly outvoted
    assert factor(alone * known) == 1  # no two agree


@pytest.mark.parametrize("extent", [0.0, 1e-9, 1e300])
def test_points_in_one_place_place_no_camera(extent: float):
    generator = np.random.default_rng(0)
    points, rays = 1 + extent * generator.normal(size=(3, 20)), generator.normal(size=(2, 20))
    pose = _resected(points, rays, 0.01)
    assert pose is None or all(np.isfinite(part).all() for part in pose)


@pytest.mark.parametrize("config", ["lbfgs", "paper"])
def test_every_solver_ends_with_a_status(config: str):
    observations = session(cameras=3, frames=6)
    keypoints = observations.keypoints.clone()
    keypoints[0] = keypoints[0, :1]
    calibration = calibrate(with_keypoints(observations, keypoints), config)
    assert bool(calibration.translations.isfinite().all())


@pytest.mark.parametrize("bad_px", [1e6, 1e18, 1e154])
@pytest.mark.parametrize("refine", [[], ["focal", "time_offset"]])
def test_one_bad_session_leaves_the_others_of_a_batch_alone(bad_px: float, refine: list[str]):
    observations = session(frames=16)
    good, bad = observations.keypoints, observations.keypoints.clone()
    bad[:, 3, 5] = bad_px
    bad[torch.rand(bad.shape[:3], generator=torch.Generator().manual_seed(0)) < 0.2] = bad_px
    layer = CalibrationLayer(observations.sticks, {"extends": "default", "refine": refine})

    def gradients(keypoints: Tensor) -> tuple[Tensor, Tensor]:
        keypoints = keypoints.clone().requires_grad_()
        result = layer(keypoints, observations.cameras)
        (result.translations.square().sum() + result.points.nan_to_num().square().sum()).backward()
        assert keypoints.grad is not None
        return result.translations.detach(), keypoints.grad

    together, alone = gradients(torch.stack([good, bad])), gradients(good[None])
    assert bool(together[1].isfinite().all())
    torch.testing.assert_close(together[0][:1], alone[0], rtol=0, atol=1e-9)
    torch.testing.assert_close(together[1][:1], alone[1], rtol=1e-6, atol=1e-9)
