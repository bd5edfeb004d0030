"""Clocks that differ, shutters that roll, frame rates that differ: found, or taken into account as told."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from torchstickcal import Calibration, ConfigError, ObservationError, Observations, calibrate
from torchstickcal.metrics import pose_errors
from torchstickcal.model.correlation import error_correlation
from torchstickcal.model.measurements import Measurements
from torchstickcal.model.state import State
from torchstickcal.simulate import Clocks, SessionSpec, SimulatedSession
from torchstickcal.simulate.regimes import GaussianNoise
from torchstickcal.simulate.session import Assumptions

FPS = 60.0
SPEC = SessionSpec("clocks", "hockey", 5, 4, 120, FPS, "ring", regimes=(GaussianNoise(1.0),))
HALF_FRAMES = Clocks(0.5 / FPS)
QUIET = replace(SPEC, regimes=())


def offset_errors_frames(found: Calibration, session: SimulatedSession) -> torch.Tensor:
    assert session.truth.time_offsets_s is not None
    return (found.time_offsets - session.truth.time_offsets_s) * FPS


def error_mm(found: Calibration, session: SimulatedSession) -> float:
    truth = session.truth
    return 1000 * pose_errors(found.rotations, found.translations, truth.rotations, truth.translations).mean_translation_m


def test_offsets_are_found_exactly_without_noise():
    session = replace(QUIET, clocks=HALF_FRAMES).generate()
    found = calibrate(session.observations, refine=["time_offset"])
    assert found.converged
    assert offset_errors_frames(found, session).abs().max() < 1e-3
    assert error_mm(found, session) < 0.1
    assert float(found.reprojection_median_px.max()) < 1e-3
    assert float(calibrate(session.observations).reprojection_median_px.max()) > 0.05


def test_offsets_are_found_to_their_stated_deviation():
    squared: list[float] = []
    errors = np.zeros(2)
    for seed in range(6):
        session = replace(SPEC, seed=seed, clocks=HALF_FRAMES).generate()
        found = calibrate(session.observations, refine=["time_offset"])
        assert found.refined == ("time_offset",)
        assert 0 < float(found.unknowns["time_offset"].std[1:].max()) * FPS < 0.02
        squared += (offset_errors_frames(found, session)[1:] / FPS / found.unknowns["time_offset"].std[1:]).square().tolist()
        in_step = replace(SPEC, seed=seed).generate()
        errors += np.array([error_mm(found, session), error_mm(calibrate(in_step.observations), in_step)])
    assert errors[0] < 1.4 * errors[1]
    assert 0.4 < np.mean(squared) < 2.2
    assert max(squared) < 16


def test_cameras_that_did_not_start_together():
    """Whole seconds apart, shutters that roll, and a focal length told wrong, all at once."""
    wrong = replace(
        SPEC, sport="golf", frames=200, clocks=Clocks(1.0, readout_s=0.015), assumptions=Assumptions(focal_scale=1.03)
    )
    session = wrong.generate()
    found = calibrate(session.observations, refine=["time_offset", "readout", "focal_shared"])
    assert found.converged
    assert offset_errors_frames(found, session).abs().max() < 0.05
    readout, focal = found.unknowns["readout"], found.unknowns["focal"]
    assert float(readout.value[0]) == pytest.approx(0.015, abs=5 * float(readout.std[0]))
    assert float(focal.value[0] / focal.given[0]) == pytest.approx(1 / 1.03, rel=0.01)
    assert error_mm(found, session) < 15
    assert found.times is not None
    truth = torch.from_numpy(wrong.motion.points(found.times.numpy()))
    camera = pose_errors(found.rotations, found.translations, session.truth.rotations, session.truth.translations)
    assert camera.mean_rotation_deg < 0.3
    centres = -(session.truth.rotations[0].mT @ session.truth.translations[0])
    in_first = (truth - centres) @ session.truth.rotations[0].mT
    off = (found.points - in_first).norm(dim=-1)
    assert float(off.nanmedian()) < 0.03
    beyond = (found.frame_index >= 0).sum(1)
    assert bool((beyond < 200).any())
    assert found.inliers.shape == session.observations.visible.shape
    assert not bool(found.inliers[found.frame_index < 0].any())
    assert bool(found.points_std_m[found.points.isfinite().all(-1)].isfinite().all())


def test_auto_finds_clocks_and_leaves_right_ones_alone():
    session = replace(SPEC, clocks=HALF_FRAMES).generate()
    assert calibrate(session.observations, refine="auto").refined == ("time_offset",)
    in_step = SPEC.generate().observations
    plain, auto = calibrate(in_step), calibrate(in_step, refine="auto")
    assert auto.refined == ()
    torch.testing.assert_close(plain.translations, auto.translations, rtol=0, atol=0)
    held = calibrate(session.observations, {"extends": "default", "synchronise": False}, refine="auto")
    assert "time_offset" not in held.refined


def test_clocks_that_are_apart_are_told_where_they_are_not_found():
    session = replace(SPEC, clocks=HALF_FRAMES).generate()
    found = calibrate(session.observations)
    truth = session.truth.time_offsets_s
    assert truth is not None
    assert (found.time_offsets == 0).all()
    assert (found.unknowns["time_offset"].suggested - truth).abs().max() * FPS < 0.05
    assert sum("time offset" in warning for warning in found.warnings) == int((truth.abs() * FPS > 0.02).sum())
    assert not [warning for warning in calibrate(SPEC.generate().observations).warnings if "time offset" in warning]


def test_cameras_frames_apart_are_told_where_they_are_not_searched_for():
    apart = replace(SPEC, clocks=Clocks(1.0)).generate().observations
    assert any("do not seem to be synchronised" in warning for warning in calibrate(apart).warnings)
    assert not any("synchronised" in warning for warning in calibrate(SPEC.generate().observations).warnings)


def test_a_known_read_out_time_is_taken_into_account():
    session = replace(QUIET, clocks=Clocks(readout_s=0.015)).generate()
    known = replace(session.observations, readout_s=0.015)
    found = calibrate(known)
    assert found.refined == ()
    assert (found.unknowns["readout"].value == 0.015).all()
    assert error_mm(found, session) < 0.1 < error_mm(calibrate(session.observations), session)
    assert float(found.times[0]) == pytest.approx(0.0075)  # pyright: ignore[reportOptionalSubscript]


def test_a_camera_of_another_rate_is_placed_by_its_timestamps():
    session = replace(QUIET, frames=121, clocks=HALF_FRAMES).generate()
    offsets, keypoints = session.truth.time_offsets_s, session.observations.keypoints.clone()
    assert offsets is not None
    times = torch.arange(121, dtype=torch.float64) / FPS + offsets[:, None]
    nothing = torch.full_like(keypoints[1, :60], torch.nan)
    keypoints[1] = torch.cat([keypoints[1, ::2], nothing])
    times[1] = torch.cat([times[1, ::2], torch.full((60,), torch.nan)])
    found = calibrate(replace(session.observations, keypoints=keypoints, timestamps=times, fps=None))
    assert found.converged
    assert error_mm(found, session) < 0.1
    assert found.frame_index[1, :61].tolist() == list(range(0, 121, 2))


def test_a_body_at_rest_tells_no_clock():
    still = SPEC.generate().observations
    keypoints = still.keypoints[:, :1].expand(-1, 60, -1, -1)
    noise = torch.randn(keypoints.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    found = calibrate(replace(still, keypoints=keypoints + noise), refine=["time_offset"])
    assert found.time_offsets.abs().max() * FPS < 0.5
    assert any("time_offset stays near the given value" in warning for warning in found.warnings)


def test_what_is_missing_for_clocks_is_said():
    given = SPEC.generate().observations
    with pytest.raises(ObservationError, match="clocks cannot be estimated without a frame rate"):
        calibrate(replace(given, fps=None), refine=["time_offset"])
    with pytest.raises(ObservationError, match="clocks cannot be estimated without a frame rate"):
        calibrate(replace(given, image_size=None), refine=["readout"])
    with pytest.raises(ObservationError, match="a read-out time without what it is counted in"):
        replace(given, fps=None, readout_s=0.01)
    with pytest.raises(ObservationError, match="not a read-out time"):
        replace(given, readout_s=-0.01)
    without_rate = calibrate(replace(given, fps=None))
    assert without_rate.times is None
    assert bool(without_rate.unknowns["time_offset"].suggested[1:].isnan().all())
    assert (without_rate.time_offsets == 0).all()
    with pytest.raises(ConfigError, match="unusable value"):
        calibrate(given, {"extends": "default", "max_offset_s": -1.0})


def test_the_same_session_gives_the_same_bytes():
    session = replace(SPEC, frames=60, clocks=HALF_FRAMES).generate()
    first, second = (calibrate(session.observations, refine=["time_offset"]) for _ in range(2))
    assert torch.equal(first.time_offsets, second.time_offsets)
    assert torch.equal(first.translations, second.translations)


def test_both_solvers_agree_on_the_clocks():
    session = replace(SPEC, frames=40, clocks=HALF_FRAMES).generate()
    by_newton = calibrate(session.observations, refine=["time_offset"])
    by_lbfgs = calibrate(session.observations, "lbfgs", refine=["time_offset"])
    off = (by_newton.time_offsets - by_lbfgs.time_offsets)[1:] / by_newton.unknowns["time_offset"].std[1:]
    assert off.abs().max() < 0.1


def test_single_precision_comes_back_and_saves(tmp_path):
    session = replace(SPEC, frames=60, clocks=HALF_FRAMES).generate()
    given = session.observations
    found = calibrate(replace(given, keypoints=given.keypoints.float()), refine=["time_offset", "readout"])
    assert found.time_offsets.dtype == found.unknowns["readout"].std.dtype == torch.float32
    found.save(tmp_path / "c.npz")
    again = Calibration.load(tmp_path / "c.npz")
    for name in ("time_offsets", "frame_index", "times"):
        assert torch.equal(getattr(again, name), getattr(found, name))
    for name in ("time_offset", "readout"):
        assert torch.equal(again.unknowns[name].std, found.unknowns[name].std)


@pytest.mark.parametrize("correlation", [0.0, 0.6])
def test_residuals_that_are_alike_are_noticed(correlation: float):
    """Keypoints of a scene at rest whose errors are an autoregressive process."""
    given: Observations = replace(QUIET, frames=120).generate().observations
    truth = QUIET.generate().truth
    rest = given.keypoints[:, :1].expand(-1, 400, -1, -1)
    noise = torch.randn(rest.shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    for frame in range(1, 400):
        noise[:, frame] = correlation * noise[:, frame - 1] + (1 - correlation**2) ** 0.5 * noise[:, frame]
    measurements = Measurements.of(replace(given, keypoints=rest + noise))
    assert truth.points is not None
    points = truth.points[:1].expand(400, -1, -1).flatten(0, 1).mT[None].contiguous()
    state = State.of(truth.rotations[None], truth.translations[None], points)
    sigma_px = torch.ones(1, given.num_points, dtype=torch.float64)
    found = error_correlation(measurements, state, sigma_px).values[0, :, 1]
    assert float(found.mean()) == pytest.approx(correlation, abs=0.02)
