"""Simulated sessions: cameras, clocks, errors of keypoints, files and presets."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from torchstickcal import CalibrationError, FileFormatError, calibrate
from torchstickcal.io import read_session, write_npz
from torchstickcal.metrics import pose_errors
from torchstickcal.simulate import (
    PRESETS,
    SPORTS,
    Assumptions,
    Clocks,
    Cube,
    Lens,
    SessionSpec,
    preset,
    read_simulated,
    session_specs,
    write_simulated,
)
from torchstickcal.simulate.regimes import (
    DetectorNoise,
    DroppedFrames,
    Flips,
    FrameRates,
    Gaps,
    GaussianNoise,
    Missing,
    Outliers,
    SelfOcclusion,
    SwappedEnds,
    occluded,
)
from torchstickcal.simulate.rigs import LAYOUTS, SCENE_CENTRE, camera_rig
from torchstickcal.simulate.skeleton import JOINT_INDEX

LENS = Lens(distortion=(-0.1, 0.02, 0.0005, -0.0005, 0.0))
PLAIN = SessionSpec("plain", "golf", cameras=6, frames=200, lens=LENS, layout="ring", radius_m=4.5)


def keypoints(spec: SessionSpec) -> np.ndarray:
    return spec.generate().observations.keypoints.numpy()


@pytest.fixture(scope="module")
def clean() -> np.ndarray:
    return keypoints(PLAIN)


@pytest.mark.parametrize("sport", SPORTS)
def test_calibration_is_exact_without_noise(sport: str):
    session = SessionSpec("exact", sport, cameras=4, frames=60, fps=20, lens=LENS, path="circle").generate()
    found = calibrate(session.observations)
    errors = pose_errors(found.rotations, found.translations, session.truth.rotations, session.truth.translations)
    assert errors.rotation_deg.deg2rad().max() < 1e-6
    assert errors.translation_m.max() < 1e-6


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("count", [2, 5, 16])
def test_cameras_look_at_the_scene_from_distinct_positions(layout: str, count: int):
    rig = camera_rig(layout, count, np.random.default_rng(0), LENS)
    np.testing.assert_allclose(rig.rotations @ rig.rotations.swapaxes(1, 2), np.tile(np.eye(3), (count, 1, 1)), atol=1e-12)
    centre = rig.project(np.tile(SCENE_CENTRE, (count, 1, 1)))[:, 0]
    np.testing.assert_allclose(centre, np.tile([960.0, 540.0], (count, 1)), atol=1e-9)
    apart = np.linalg.norm(rig.centres[:, None] - rig.centres, axis=-1) + 9 * np.eye(count)
    assert apart.min() > 0.2
    assert rig.centres[:, 2].min() > 0.3
    if layout in {"hemisphere", "random", "ring"}:
        np.testing.assert_allclose(np.linalg.norm(rig.centres - SCENE_CENTRE, axis=1), 4.0, atol=1e-12)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_the_athlete_is_in_the_image_and_all_keypoints_are(layout: str):
    for sport in SPORTS:
        spec = SessionSpec(
            "x", sport, frames=60, fps=15, layout=layout, path="circle", regimes=(GaussianNoise(2.0), Outliers(0.1))
        )
        pixels = keypoints(spec)
        seen = np.isfinite(pixels).all(-1)
        assert seen.mean() > 0.97
        assert (pixels[seen] >= 0).all()
        assert (pixels[seen] <= [1919, 1079]).all()


def test_lenses_vary_when_asked():
    rig = camera_rig("ring", 8, np.random.default_rng(1), replace(LENS, focal_px=1000.0, variation=0.02))
    assert rig.distortion is not None
    assert 5 < rig.intrinsics[:, 0, 0].std() < 50
    assert len(np.unique(rig.distortion[:, 0])) == 8


def test_gaussian_noise_has_the_standard_deviation(clean: np.ndarray):
    session = replace(PLAIN, regimes=(GaussianNoise(0.5),)).generate()
    errors = session.observations.keypoints.numpy() - clean
    assert np.nanstd(errors) == pytest.approx(0.5, rel=0.02)
    assert np.nanmean(errors) == pytest.approx(0.0, abs=0.01)
    assert (session.sigma_px == 0.5).all()
    assert session.inliers.all()


def test_detector_noise_has_heavy_tails_and_a_related_confidence(clean: np.ndarray):
    session = replace(PLAIN, regimes=(DetectorNoise(2.5, 1.5),)).generate()
    errors = session.observations.keypoints.numpy() - clean
    assert np.sqrt(np.nanmean(errors[:, :, :19] ** 2)) == pytest.approx(2.5, rel=0.03)
    assert np.sqrt(np.nanmean(errors[:, :, 19:] ** 2)) == pytest.approx(1.5, rel=0.05)
    whitened = errors / session.sigma_px[..., None]
    assert np.nanstd(whitened) == pytest.approx(1.0, rel=0.02)
    assert np.nanmean((errors / np.nanstd(errors)) ** 4) > 4.5
    assert np.nanmean(whitened**4) == pytest.approx(3.0, rel=0.1)
    assert session.observations.confidence is not None
    size, confidence = np.linalg.norm(errors, axis=-1).ravel(), session.observations.confidence.numpy().ravel()
    known = np.isfinite(size)
    assert np.corrcoef(size[known].argsort().argsort(), confidence[known].argsort().argsort())[0, 1] < -0.25
    by_joint = np.sqrt(np.nanmean(errors[:, :, :19] ** 2, axis=(0, 1, 3)))
    assert by_joint.max() / by_joint.min() > 1.5


def test_shares_of_missing_keypoints():
    assert np.isnan(keypoints(replace(PLAIN, regimes=(Missing(0.15),)))[..., 0]).mean() == pytest.approx(0.15, abs=0.01)
    gone = np.isnan(keypoints(replace(PLAIN, regimes=(Gaps(0.15, mean_frames=5),)))[..., 0])
    assert gone.mean() == pytest.approx(0.15, abs=0.02)
    ends = gone[:, :-1] & ~gone[:, 1:]
    assert gone[:, :-1].sum() / ends.sum() == pytest.approx(5.0, rel=0.15)
    dropped = np.isnan(keypoints(replace(PLAIN, regimes=(DroppedFrames(0.2),)))[..., 0])
    assert (dropped.any(-1) == dropped.all(-1)).all()
    assert dropped.mean() == pytest.approx(0.2, abs=0.04)
    slow = np.isnan(keypoints(replace(PLAIN, regimes=(FrameRates((1.0, 0.5, 0.4)),)))[..., 0]).all(-1)
    np.testing.assert_allclose(slow.mean(1), [0, 0.5, 0.6, 0, 0.5, 0.6], atol=0.01)
    assert set(np.diff(np.flatnonzero(~slow[1]))) == {2}
    assert set(np.diff(np.flatnonzero(~slow[2]))) == {2, 3}


def test_outliers_are_large_and_marked(clean: np.ndarray):
    session = replace(PLAIN, regimes=(Outliers(0.12, reach_px=80.0),)).generate()
    moved = session.observations.keypoints.numpy() - clean
    assert (~session.inliers).mean() == pytest.approx(0.12, abs=0.01)
    assert (np.abs(moved[session.inliers & np.isfinite(moved[..., 0])]) == 0).all()
    gross = moved[~session.inliers & np.isfinite(moved[..., 0])]
    assert 75 < np.abs(gross).max() <= 80
    assert gross.std() == pytest.approx(80 / np.sqrt(3), rel=0.05)


def test_flips_swap_sides_and_swapped_ends_swap_ends(clean: np.ndarray):
    for regime, first, second, still in (
        (Flips(0.3), JOINT_INDEX["left_knee"], JOINT_INDEX["right_knee"], JOINT_INDEX["neck"]),
        (SwappedEnds(0.3), 19, 20, JOINT_INDEX["left_knee"]),
    ):
        session = replace(PLAIN, regimes=(regime,)).generate()
        pixels, turned = session.observations.keypoints.numpy(), ~session.inliers[:, :, first]
        assert turned.mean() == pytest.approx(0.3, abs=0.05)
        np.testing.assert_array_equal(pixels[turned, first], clean[turned, second])
        np.testing.assert_array_equal(pixels[~turned, first], clean[~turned, first])
        np.testing.assert_array_equal(pixels[:, :, still], clean[:, :, still])
        assert session.inliers[:, :, still].all()


def test_a_point_behind_a_limb_is_hidden():
    points = np.tile([-50.0, 0.0, 50.0], (3, 21, 1)) + np.arange(21)[:, None] * [0, 1.0, 0]
    points[:, JOINT_INDEX["spine"]], points[:, JOINT_INDEX["neck"]] = [0, 0, 1.0], [0, 0, 1.4]
    hand = JOINT_INDEX["left_hand"]
    points[:, hand] = [[-0.5, 0, 1.2], [-0.5, 0.4, 1.2], [0.5, 0, 1.2]]
    hidden = occluded(np.array([4.0, 0, 1.2]), points)
    assert hidden[:, hand].tolist() == [True, False, False]
    assert not hidden[:, [JOINT_INDEX["spine"], JOINT_INDEX["neck"]]].any()


def test_a_body_hides_some_of_itself(clean: np.ndarray):
    hidden = np.isnan(keypoints(replace(PLAIN, regimes=(SelfOcclusion(),)))[..., 0])
    assert 0.03 < hidden.mean() < 0.25
    assert not hidden[..., JOINT_INDEX["head_top"]].mean() > 0.1


def test_a_time_offset_is_the_motion_at_another_time():
    spec = replace(PLAIN, clocks=Clocks(offset_s=2.0))
    session = spec.generate()
    assert session.truth.time_offsets_s is not None
    offsets = session.truth.time_offsets_s.numpy()
    assert offsets[0] == 0
    assert 0.5 < np.abs(offsets).max() <= 2.0
    rig = camera_rig(spec.layout, 6, np.random.default_rng(spec.seed).spawn(5)[0], spec.lens, spec.radius_m)
    times = np.arange(spec.frames) / spec.fps + offsets[:, None]
    expected = rig.project(np.stack([spec.motion.points(camera) for camera in times]))
    np.testing.assert_allclose(session.observations.keypoints.numpy(), expected, rtol=0, atol=1e-9)


def test_a_rolling_shutter_exposes_each_point_in_the_row_where_it_appears():
    spec = replace(PLAIN, frames=110, clocks=Clocks(offset_s=0.1, readout_s=0.02))
    session = spec.generate()
    pixels, truth = session.observations.keypoints.numpy(), session.truth
    assert truth.time_offsets_s is not None
    rig = camera_rig(spec.layout, 6, np.random.default_rng(spec.seed).spawn(5)[0], spec.lens, spec.radius_m)
    for point in (JOINT_INDEX["left_hand"], 20):
        rows = np.nan_to_num(pixels[:, :, point, 1])
        times = np.arange(110) / spec.fps + truth.time_offsets_s.numpy()[:, None] + 0.02 * rows / 1080
        again = rig.project(np.stack([spec.motion.points(camera)[:, point] for camera in times]))
        known = np.isfinite(pixels[:, :, point, 0])
        assert known.mean() > 0.95
        np.testing.assert_allclose(pixels[known, point], again[known], rtol=0, atol=1e-6)
    frozen = keypoints(replace(spec, clocks=Clocks(offset_s=0.1)))
    assert np.nanmax(np.abs(pixels - frozen)) > 20


def test_given_intrinsics_may_be_wrong_and_the_truth_is_right():
    wrong = Assumptions(focal_scale=1.03, focal_spread=0.01, centre_px=4.0, lens_known=False, stick_scale=1.02)
    session = replace(PLAIN, assumptions=wrong).generate()
    truth = session.truth
    assert truth.intrinsics is not None
    assert truth.distortion is not None
    ratio = session.observations.intrinsics[:, 0, 0] / truth.intrinsics[:, 0, 0]
    assert ratio.mean().item() == pytest.approx(1.03, abs=0.015)
    assert ratio.std() > 0.003
    assert (session.observations.intrinsics[:, :2, 2] != truth.intrinsics[:, :2, 2]).all()
    assert session.observations.distortion is None
    assert session.observations.sticks[0].length_m == pytest.approx(1.02)
    assert torch.equal(session.observations.keypoints.nan_to_num(), PLAIN.generate().observations.keypoints.nan_to_num())


def test_a_camera_sees_the_faces_of_the_cube_that_face_it():
    spec = replace(PLAIN, lens=Lens(), cube=Cube(), cameras=8)
    session = spec.generate()
    cube, truth = session.cube, session.truth
    assert cube is not None
    assert cube.corners_m.shape == (24, 3)
    centres = -(truth.rotations.mT @ truth.translations[..., None])[..., 0].numpy()
    middle = cube.corners_m.reshape(6, 4, 3).mean(1)
    facing = ((centres[:, None] - middle) * (middle - SCENE_CENTRE)).sum(-1) > 0
    seen = np.isfinite(cube.keypoints[..., 0]).reshape(8, 6, 4)
    assert (seen.any(-1) == seen.all(-1)).all()
    assert not (seen.any(-1) & ~facing).any()
    assert seen.any(-1).sum(1).min() >= 1
    in_cameras = np.einsum("cij,kj->cki", truth.rotations.numpy(), cube.corners_m) + truth.translations.numpy()[:, None]
    pixels = np.einsum("cij,ckj->cki", session.observations.intrinsics.numpy(), in_cameras / in_cameras[..., 2:])[..., :2]
    shown = np.isfinite(cube.keypoints)
    np.testing.assert_allclose(cube.keypoints[shown], pixels[shown], atol=1e-9)
    noisy = replace(spec, regimes=(GaussianNoise(0.5),)).generate().cube
    assert noisy is not None
    assert np.nanstd(noisy.keypoints - cube.keypoints) == pytest.approx(0.5, rel=0.2)
    standing = replace(spec, cube=Cube(faces=5)).generate().cube
    assert standing is not None
    assert standing.corners_m.shape == (20, 3)


def test_files_hold_everything(tmp_path):
    specs = preset("sports-stick-syn")[0], preset("hard")[7], replace(PLAIN, frames=20, clocks=Clocks(0.1, 0.01))
    for spec in specs:
        session = spec.generate()
        path = tmp_path / "session.npz"
        write_simulated(path, session)
        back = read_simulated(path)
        assert (back.name, back.height_m, back.fps) == (session.name, session.height_m, session.fps)
        np.testing.assert_array_equal(back.inliers, session.inliers)
        np.testing.assert_array_equal(back.sigma_px, session.sigma_px)
        assert (back.cube is None) == (session.cube is None)
        if back.cube is not None and session.cube is not None:
            np.testing.assert_array_equal(back.cube.corners_m, session.cube.corners_m)
            np.testing.assert_array_equal(back.cube.keypoints, session.cube.keypoints)
        for name, value in vars(session.truth).items():
            read = getattr(back.truth, name)
            assert (read is None) if value is None else torch.equal(read, value)
        observations, truth = read_session(path)
        assert torch.equal(observations.keypoints.nan_to_num(), session.observations.keypoints.nan_to_num())
        assert observations.sticks == session.observations.sticks
        assert truth is not None
        assert truth.readout_s is not None


def test_a_session_that_was_not_simulated_is_refused(tmp_path, noisy):
    write_npz(tmp_path / "recorded.npz", *noisy)
    with pytest.raises(FileFormatError, match=r"not a simulated session.*inliers"):
        read_simulated(tmp_path / "recorded.npz")


def test_the_seed_determines_the_session():
    spec = replace(preset("hard")[1], frames=20, clocks=Clocks(0.1))
    first, second, other = spec.generate(), spec.generate(), replace(spec, seed=1).generate()
    for name in ("keypoints", "confidence", "intrinsics"):
        a, b = (getattr(session.observations, name).numpy().tobytes() for session in (first, second))
        assert a == b
    assert first.truth.points is not None
    assert second.truth.points is not None
    assert other.truth.points is not None
    assert torch.equal(first.truth.points, second.truth.points)
    assert not torch.equal(first.truth.points, other.truth.points)
    assert not torch.equal(first.truth.translations, other.truth.translations)


def test_presets_are_as_documented():
    assert {name: len(preset(name)) for name in PRESETS} == {
        "sports-stick-syn": 160,
        "sports-stick-syn-random": 160,
        "hard": 60,
        "breakdown": 35,
        "regimes": 27,
    }
    every = [spec for name in PRESETS for spec in preset(name)]
    assert len({spec.name for spec in every}) == len(every)
    paper = preset("sports-stick-syn")
    assert {(spec.frames, spec.lens.focal_px, spec.lens.image_size, spec.radius_m) for spec in paper} == {
        (50, 1600.0, (1200, 1200), 4.0)
    }
    assert {spec.cameras for spec in paper} == set(range(3, 11))
    hard = preset("hard")
    assert {spec.sport for spec in hard} == {"golf", "baseball", "hockey", "kendo", "wand"}
    assert {spec.layout for spec in hard} == set(LAYOUTS)
    assert {spec.cameras for spec in hard} == {2, 3, 4, 5, 6, 8}
    assert (min(spec.frames for spec in hard), max(spec.frames for spec in hard)) == (60, 300)
    assert {(spec.cameras, spec.frames) for spec in preset("regimes")} == {(6, 300)}


def test_a_hard_session_has_the_documented_errors():
    session = preset("hard")[59].generate()
    seen = session.observations.visible.numpy()
    flipped = ~session.inliers[:, :, JOINT_INDEX["left_knee"]] & ~session.inliers[:, :, JOINT_INDEX["right_knee"]]
    assert 0.1 < flipped.mean() < 0.16
    assert (~session.inliers[:, :, JOINT_INDEX["neck"]]).mean() == pytest.approx(0.15, abs=0.03)
    assert 0.15 < 1 - seen.mean() < 0.4


def test_specifications_by_name():
    assert [spec.name for spec in session_specs("hard", count=2)] == [spec.name for spec in preset("hard")[:2]]
    assert [spec.seed for spec in session_specs("kendo", count=3, seed=5)] == [5, 6, 7]
    assert session_specs("hard", seed=9)[0].seed == preset("hard")[0].seed + 9
    with pytest.raises(CalibrationError, match=r"'curling'.*sports-stick-syn.*hard.*golf.*wand"):
        session_specs("curling")
    with pytest.raises(CalibrationError, match=r"no sessions to simulate \(count\): got 0"):
        session_specs("hard", count=0)
    with pytest.raises(CalibrationError, match=r"negative seed.*got -1; expected 0 or more"):
        session_specs("golf", seed=-1)
    with pytest.raises(CalibrationError, match=r"unknown preset.*'easy'.*hard"):
        preset("easy")
    with pytest.raises(CalibrationError, match=r"unknown layout.*'dome'.*hemisphere"):
        replace(PLAIN, layout="dome").generate()
    with pytest.raises(CalibrationError, match=r"unsupported number of cameras.*got 17; expected 2 to 16"):
        replace(PLAIN, cameras=17).generate()
