"""Time offsets from the motion in the images, and sessions on common frames."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from fuzz.sessions import Spoiled, observations_of

from torchstickcal import ObservationError, Observations, Stick
from torchstickcal.model.measurements import Measurements
from torchstickcal.pipeline.synchronise import clocks_unlike_given, on_common_frames, search_offsets
from torchstickcal.pipeline.synchronise.epipolar import Tracks
from torchstickcal.simulate import Clocks, Noise, SessionSpec
from torchstickcal.simulate.regimes import DroppedFrames, FrameRates, Gaps, SelfOcclusion
from torchstickcal.simulate.session import Assumptions

HARD = (Noise(1.5, missing=0.1, outliers=0.05), SelfOcclusion())
SPEC = SessionSpec("clocks", "golf", 7, 4, 150, 30.0, "ring", regimes=HARD, clocks=Clocks(1.0))


@pytest.mark.parametrize(
    "spec",
    [
        SPEC,
        replace(SPEC, sport="hockey", cameras=3, clocks=Clocks(2.0)),
        replace(SPEC, sport="kendo", frames=300, fps=60.0, clocks=Clocks(1.0, readout_s=0.015)),
        replace(SPEC, sport="wand", cameras=3, assumptions=Assumptions(focal_scale=1.1)),
        replace(SPEC, sport="baseball", regimes=(*HARD, DroppedFrames(0.1), Gaps(0.15))),
        replace(SPEC, regimes=(*HARD, FrameRates((1.0, 1.0, 0.5)))),
    ],
    ids=["golf", "far", "rolling", "focal", "gaps", "rates"],
)
def test_offsets_are_found_to_a_fraction_of_a_frame(spec: SessionSpec):
    session = spec.generate()
    truth = session.truth.time_offsets_s * spec.fps
    found = search_offsets(Measurements.of(session.observations), spec.clocks.offset_s * spec.fps)
    assert found.offsets_frames.dtype == torch.float64
    assert found.offsets_frames[0] == 0
    assert all(found.determined), found.reasons
    assert (found.offsets_frames - truth).abs().max() < 0.5


def test_synchronised_cameras_have_no_offsets():
    session = replace(SPEC, clocks=Clocks()).generate()
    found = search_offsets(Measurements.of(session.observations), 30)
    assert found.offsets_frames.abs().max() < 0.2


@pytest.mark.parametrize(("offset_s", "noisy"), [(0.0, False), (0.0, True), (1.0, False), (1.0, True)])
def test_other_clocks_are_offered_where_most_pairs_of_cameras_fit_clearly_better(offset_s: float, noisy: bool):
    session = replace(SPEC, clocks=Clocks(offset_s)).generate()
    keypoints = session.observations.keypoints.clone()
    if noisy:  # it fits a little better at some lag
        keypoints[1] += 40 * torch.randn(keypoints[1].shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    found = clocks_unlike_given(Measurements.of(replace(session.observations, keypoints=keypoints)), 30)
    assert (found is not None) == (offset_s > 0)
    if found is not None:
        others = [0, 2, 3] if noisy else [0, 1, 2, 3]
        assert (found.alternatives[0] - SPEC.fps * session.truth.time_offsets_s)[others].abs().max() < 0.5


def test_offsets_without_motion_are_undetermined():
    session = replace(SPEC, regimes=(), clocks=Clocks()).generate()
    still = session.observations.keypoints[:, :1].expand(-1, 150, -1, -1)
    noise = torch.randn(still.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    found = search_offsets(Measurements.of(replace(session.observations, keypoints=still + noise)), 30)
    assert found.determined == (True, False, False, False)
    assert all("too little motion" in reason for reason in found.reasons[1:])
    assert (found.offsets_frames == 0).all()


def test_offsets_of_a_periodic_motion_are_undetermined():
    session = replace(SPEC, frames=25, regimes=(), clocks=Clocks()).generate()
    period = session.observations.keypoints
    there_and_back = torch.cat([period, period.flip(1)], dim=1)
    found = search_offsets(Measurements.of(replace(session.observations, keypoints=there_and_back.repeat(1, 6, 1, 1))), 60)
    assert found.determined == (True, False, False, False)
    assert (found.offsets_frames == 0).all()


def test_a_camera_without_keypoints_is_undetermined():
    session = SPEC.generate()
    keypoints = session.observations.keypoints.clone()
    keypoints[2] = torch.nan
    found = search_offsets(Measurements.of(replace(session.observations, keypoints=keypoints)), 30)
    assert found.determined == (True, True, False, True)
    assert "too few common points" in found.reasons[2]
    assert (found.offsets_frames - SPEC.fps * session.truth.time_offsets_s)[[1, 3]].abs().max() < 0.5


def test_an_offset_at_which_nothing_fits_is_undetermined():
    """All points are at one place, one camera sees nothing, and the best of all bad offsets has a negative score."""
    spoils = ("all_points_the_same", "one_camera_blind")
    session = Spoiled(
        "wand", 4, 12, "random", noise_px=3.0, offset_s=0.02, spoils=spoils, seed=4, focal_scale=1.0, readout_s=0.0
    )
    observations = observations_of(session.arguments())
    found = search_offsets(Measurements.of(observations, dtype=torch.float32), 0.1 * float(observations.fps or 30))
    assert not found.determined[1]


def test_residuals_at_all_lags_agree_with_sampson_distances():
    """The residual at a lag is about the mean squared Sampson distance, and zero at the right lag without noise."""
    session = replace(SPEC, cameras=2, frames=40, regimes=(), clocks=Clocks()).generate()
    pixels = session.observations.keypoints.movedim(-1, 1)
    pixels, weights = pixels.nan_to_num(), session.observations.visible.double()
    tracks = Tracks(pixels, weights, 10)
    fit = tracks.fit(0, 1)
    assert int(fit.residual_px2.argmin()) == 10
    assert fit.residual_px2[10] < 1e-6
    for lag in (-4, 3):
        found = tracks.distances_px(0, 1, lag)
        assert found is not None
        distances = found[0][found[0].isfinite()]
        assert len(distances) == round(float(fit.points[lag + 10]))
        # Taubin's method has a ratio of sums in place of the mean of ratios
        assert 0.5 < distances.square().mean() / fit.residual_px2[lag + 10] < 2.0


def numbered(cameras: int, frames: int) -> Observations:
    """Two points whose pixel coordinates are the camera and the frame."""
    camera, frame = torch.meshgrid(torch.arange(cameras), torch.arange(frames), indexing="ij")
    keypoints = torch.stack([camera, frame], dim=-1)[:, :, None].expand(-1, -1, 2, -1).double()
    return Observations(keypoints, torch.eye(3), Stick(0, 1, 1.0), confidence=torch.ones(cameras, frames, 2))


def test_frames_are_moved_to_the_nearest_common_frames():
    found = on_common_frames(numbered(3, 5), torch.tensor([0, 2.25, -3]))
    common = found.observations
    assert found.numbers.tolist() == [0, 1, 2, 3, 4]
    frames = common.keypoints[:, :, 0, 1]
    nan = torch.nan
    expected = torch.tensor([[0, 1, 2, 3, 4], [nan, nan, 0, 1, 2], [3, 4, nan, nan, nan]]).double()
    torch.testing.assert_close(frames, expected, equal_nan=True)
    assert torch.equal(found.lags[1], torch.tensor([0, 0, 0.25, 0.25, 0.25]).double())
    assert torch.equal(found.index[1], torch.tensor([2, 3, 4, -1, -1]))
    assert common.confidence is not None
    assert torch.equal(common.visible, common.confidence > 0)
    own = found.to_own(common.keypoints, torch.nan)
    kept = found.index >= 0
    assert torch.equal(own[kept], numbered(3, 5).keypoints[kept])
    assert bool(own[~kept].isnan().all())


def test_synchronised_sessions_are_not_changed():
    given = numbered(2, 5)
    found = on_common_frames(given)
    assert found.observations is given
    assert bool((found.lags == 0).all())


def test_different_rates_and_dropped_frames_are_aligned_by_timestamps():
    nan = torch.nan
    times = torch.tensor(
        [[0, 0.02, 0.04, 0.06, 0.08, 0.10], [0.001, 0.041, 0.081, nan, nan, nan], [0, 0.02, nan, 0.06, 0.08, 0.1]]
    )
    given = numbered(3, 6)
    gone = given.keypoints.where(times.isfinite()[..., None, None], nan)
    found = on_common_frames(replace(given, keypoints=gone, timestamps=times.double()))
    assert found.rate_hz == pytest.approx(50)
    frames = found.observations.keypoints[:, :, 0, 1]
    expected = torch.tensor([[0, 1, 2, 3, 4, 5], [0, nan, 1, nan, 2, nan], [0, 1, nan, 3, 4, 5]]).double()
    torch.testing.assert_close(frames, expected, equal_nan=True)
    torch.testing.assert_close(found.lags[1, ::2], torch.full((3,), 0.05, dtype=torch.float64), rtol=1e-5, atol=0)


def test_of_two_frames_at_one_common_frame_the_closer_one_is_kept():
    times = torch.tensor([[0, 0.02, 0.04], [0.001, 0.016, 0.04]]).double()
    found = on_common_frames(replace(numbered(2, 3), timestamps=times, fps=50.0))
    assert found.index.tolist() == [[0, 1, 2], [0, 1, 2]]
    times = torch.tensor([[0, 0.02, 0.04], [0.013, 0.022, 0.04]]).double()
    assert on_common_frames(replace(numbered(2, 3), timestamps=times, fps=50.0)).index.tolist() == [[-1, 0, 1], [-1, 0, 1]]


def test_sessions_without_a_common_frame_raise():
    with pytest.raises(ObservationError, match="no two cameras have a frame in common"):
        on_common_frames(numbered(2, 5), torch.tensor([0, 5]))


@pytest.mark.parametrize(
    ("times", "message"),
    [
        ([[0, 1, 2]], "wrong shape"),
        ([[0.0, 2.0, 1.0], [0.0, 1.0, 2.0]], "do not increase"),
        ([[0.0, 1.0, 2.0], [0.0, 1.0, float("nan")]], "a frame without a timestamp"),
    ],
)
def test_invalid_timestamps_raise(times: list[list[float]], message: str):
    with pytest.raises(ObservationError, match=message):
        replace(numbered(2, 3), timestamps=times)
