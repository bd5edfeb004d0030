"""Files: round trips, and damaged or hostile ones."""

from __future__ import annotations

import dataclasses
import os
import pickle
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from torchstickcal import Calibration, FileFormatError, Observations, Stick, calibrate
from torchstickcal.files import atomic_path
from torchstickcal.io import (
    read_calibration,
    read_camera_toml,
    read_npz,
    read_session,
    read_sports_stick_syn,
    write_camera_toml,
    write_npz,
)


def syn_pickle(path: Path, **changes: object) -> Path:
    """A small file laid out as those of Sports-Stick-Syn."""
    rng = np.random.default_rng(0)
    cameras, frames = 3, 4
    data = {
        "num_cameras": cameras,
        "n_frames": frames,
        "stick_length": 1.2,
        "K": [[1600, 0, 600], [0, 1600, 600], [0, 0, 1]],
        "Rs_gt": np.tile(np.eye(3), (cameras, 1, 1)).tolist(),
        "ts_gt": rng.normal(size=(cameras, 3)).tolist(),
        "cameras": [{"name": f"Camera_{k + 1}"} for k in range(cameras)],
        "stick_3d_gt": rng.normal(size=(frames, 2, 3)).tolist(),
        "pose_3d_gt": rng.normal(size=(frames, 19, 3)).tolist(),
        "all_observed_points_2d": rng.uniform(1, 1200, (cameras, frames, 2, 2)).tolist(),
        "all_pose_projections_2d": rng.uniform(1, 1200, (cameras, frames, 19, 2)).tolist(),
        "all_projection_masks": np.ones((cameras, frames, 19), bool).tolist(),
        "noise_std": np.float64(0.5),
    } | changes
    path.write_bytes(pickle.dumps(data, protocol=4))
    return path


def test_sports_stick_syn(tmp_path: Path):
    ends = np.full((3, 4, 2, 2), 50.0)
    ends[1, 2, 1] = 0.0
    masks = np.ones((3, 4, 19), bool)
    masks[0, 0, 5] = False
    path = syn_pickle(tmp_path / "a.pkl", all_observed_points_2d=ends.tolist(), all_projection_masks=masks.tolist())
    observations, truth = read_sports_stick_syn(path)
    assert observations.keypoints.shape == (3, 4, 21, 2)
    assert observations.keypoints[1, 2, 20].isnan().all()
    assert observations.keypoints[0, 0, 5].isnan().all()
    assert int(observations.visible.sum()) == 3 * 4 * 21 - 2
    assert observations.sticks[0].length_m == 1.2
    assert observations.intrinsics.shape == (3, 3)
    assert truth.points is not None
    assert truth.points.shape == (4, 21, 3)
    again, _ = read_session(path)
    assert torch.equal(again.keypoints.nan_to_num(), observations.keypoints.nan_to_num())


class Hostile:
    """Makes a folder when it is unpickled."""

    def __init__(self, folder: Path):
        self.folder = folder

    def __reduce__(self):
        return os.mkdir, (str(self.folder),)


def test_a_hostile_pickle_is_refused_and_nothing_of_it_runs(tmp_path: Path):
    path, trace = tmp_path / "bad.pkl", tmp_path / "trace"
    path.write_bytes(pickle.dumps({"K": Hostile(trace)}))
    with pytest.raises(FileFormatError, match=r"damaged or holds more than plain data.*bad\.pkl.*mkdir"):
        read_session(path)
    assert not trace.exists()


def test_damaged_pickles_are_refused(tmp_path: Path):
    path = syn_pickle(tmp_path / "a.pkl")
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(FileFormatError, match="damaged"):
        read_sports_stick_syn(path)
    path.write_bytes(pickle.dumps({"K": 1}))
    with pytest.raises(FileFormatError, match=r"not of the expected format.*a\.pkl.*all_pose_projections_2d.*Sports-Stick-Syn"):
        read_sports_stick_syn(path)
    path.write_bytes(pickle.dumps([1, 2]))
    with pytest.raises(FileFormatError, match="not of the expected format"):
        read_sports_stick_syn(path)


def test_unknown_and_missing_files(tmp_path: Path):
    path = tmp_path / "a.txt"
    path.write_text("hello")
    with pytest.raises(FileFormatError, match=r"no session format is recognised .*a\.txt.*b'hello'.*npz = NumPy"):
        read_session(path)
    with pytest.raises(FileFormatError, match=r"no calibration format is recognised .*b'hello'.*pose2sim = "):
        read_calibration(path)
    with pytest.raises(FileFormatError, match="got a folder"):
        read_session(tmp_path)
    with pytest.raises(FileNotFoundError):
        read_session(tmp_path / "absent.npz")


def test_npz_round_trip(tmp_path: Path, noisy):
    observations, truth = noisy
    confidence = observations.visible.double() * 0.5
    observations = dataclasses.replace(observations, confidence=confidence)
    write_npz(tmp_path / "a.npz", observations, truth)
    back, back_truth = read_session(tmp_path / "a.npz")
    for name in ("keypoints", "intrinsics", "distortion", "confidence", "image_size"):
        torch.testing.assert_close(getattr(back, name), getattr(observations, name), rtol=0, atol=0, equal_nan=True)
    for name in ("sticks", "fps", "point_names", "camera_names", "fisheye"):
        assert getattr(back, name) == getattr(observations, name)
    assert back_truth is not None
    assert torch.equal(back_truth.points, truth.points)


def test_npz_keeps_everything(tmp_path: Path, noisy):
    """What few sessions have: sticks named by their ends, tolerances, a guessed camera matrix, timestamps, a read-out time."""
    given, _ = noisy
    observations = Observations(
        given.keypoints.float(),
        None,
        [Stick("club_grip", "club_head", 1.0, sigma_m=0.003), Stick("right_knee", "right_ankle", 0.42, sigma_m=0.02)],
        image_size=(1920, 1080),
        point_names=given.point_names,
        timestamps=np.arange(30) / 60.0,
        readout_s=0.012,
    )
    write_npz(tmp_path / "a.npz", observations)
    back, truth = read_npz(tmp_path / "a.npz")
    assert truth is None
    for field in dataclasses.fields(Observations):
        value, other = getattr(observations, field.name), getattr(back, field.name)
        if isinstance(value, torch.Tensor):
            torch.testing.assert_close(other, value, rtol=0, atol=0, equal_nan=True)
        else:
            assert other == value, field.name
    assert [stick.sigma_m for stick in back.sticks] == [0.003, 0.02]
    assert not back.intrinsics_known


def test_npz_without_tolerances_has_sticks_with_the_usual_one(tmp_path: Path, noisy):
    write_npz(tmp_path / "a.npz", *noisy)
    with np.load(tmp_path / "a.npz") as file:
        arrays = {name: file[name] for name in file.files if name != "stick_sigma_m"}
    np.savez(tmp_path / "b.npz", **arrays)
    (stick,) = read_npz(tmp_path / "b.npz")[0].sticks
    assert stick.sigma_m == Stick(0, 1, 1.0).sigma_m


def test_npz_without_its_arrays_is_refused(tmp_path: Path):
    np.savez(tmp_path / "a.npz", keypoints=np.zeros((2, 3, 4, 2)))
    with pytest.raises(FileFormatError, match=r"not of the expected format.*no 'intrinsics'"):
        read_npz(tmp_path / "a.npz")
    (tmp_path / "b.npz").write_bytes(b"PK\x03\x04 nonsense")
    with pytest.raises(FileFormatError, match="damaged"):
        read_session(tmp_path / "b.npz")


def test_calibration_round_trip(tmp_path: Path, noisy):
    calibration = calibrate(noisy[0])
    calibration.save(tmp_path / "c.npz")
    back = Calibration.load(tmp_path / "c.npz")
    for field in dataclasses.fields(Calibration):
        value, other = getattr(calibration, field.name), getattr(back, field.name)
        if isinstance(value, torch.Tensor):
            torch.testing.assert_close(other, value, rtol=0, atol=0, equal_nan=True)
        elif field.name == "unknowns":
            assert other.keys() == value.keys()
            for name in value:
                torch.testing.assert_close(other[name].suggested, value[name].suggested, rtol=0, atol=0)
                assert (other[name].unit, other[name].components) == (value[name].unit, value[name].components)
        else:
            assert other == value, field.name
    assert back.status == calibration.status
    np.savez(tmp_path / "d.npz", meta=np.array("{}"))
    with pytest.raises(FileFormatError, match="not a saved calibration"):
        Calibration.load(tmp_path / "d.npz")


def test_camera_toml_round_trip(tmp_path: Path, noisy):
    calibration = calibrate(noisy[0])
    write_camera_toml(tmp_path / "calibration.toml", calibration)
    rig = read_camera_toml(tmp_path / "calibration.toml")
    assert rig.names == calibration.camera_names
    torch.testing.assert_close(rig.rotations, calibration.rotations, rtol=0, atol=1e-14)
    assert torch.equal(rig.translations, calibration.translations)
    assert torch.equal(rig.intrinsics, calibration.intrinsics)
    assert torch.equal(torch.stack(rig.distortion), calibration.distortion)
    assert torch.equal(rig.image_size, calibration.image_size.double())


def test_camera_toml_reprojects_through_opencv(tmp_path: Path, noisy):
    """As Pose2Sim and aniposelib use the file: rvec, world to camera, metres, distorted pixels."""
    observations, _ = noisy
    calibration = calibrate(observations)
    write_camera_toml(tmp_path / "calibration.toml", calibration)
    rig = read_camera_toml(tmp_path / "calibration.toml")
    points = calibration.points[3].numpy()
    for camera in range(4):
        rvec, _ = cv2.Rodrigues(rig.rotations[camera].numpy())
        pixels, _ = cv2.projectPoints(
            points, rvec, rig.translations[camera].numpy(), rig.intrinsics[camera].numpy(), rig.distortion[camera].numpy()
        )
        residual = pixels[:, 0] - observations.keypoints[camera, 3].numpy()
        expected = calibration.residuals_px[camera, 3].numpy()
        known = np.isfinite(expected)
        np.testing.assert_allclose(residual[known], expected[known], atol=1e-9)


def test_camera_toml_keeps_its_order_with_many_cameras(tmp_path: Path, noisy):
    calibration = calibrate(noisy[0])
    repeated = {
        name: getattr(calibration, name).repeat(3, *[1] * (getattr(calibration, name).ndim - 1))
        for name in ("rotations", "translations", "intrinsics", "distortion", "image_size", "residuals_px", "inliers")
    }
    many = dataclasses.replace(calibration, **repeated, camera_names=tuple(f"c{k}" for k in range(12)))
    write_camera_toml(tmp_path / "calibration.toml", many)
    keys = [line for line in (tmp_path / "calibration.toml").read_text().splitlines() if line.startswith("[cam")]
    assert keys == sorted(keys)
    assert len(keys) == 12


def test_files_that_hold_no_cameras_are_refused(tmp_path: Path):
    path = tmp_path / "calibration.toml"
    for text in ("[metadata]\nerror = 1.0\n", "[cam_0]\nname = 'a'\n", "= 3", "cam = 3"):
        path.write_text(text)
        with pytest.raises(FileFormatError, match="not of the expected format"):
            read_camera_toml(path)


def test_a_failing_write_leaves_the_old_file_and_nothing_else(tmp_path: Path):
    path = tmp_path / "file.txt"
    path.write_text("old")

    def write_and_fail() -> None:
        with atomic_path(path) as temporary:
            temporary.write_text("half")
            raise RuntimeError("full disk")

    with pytest.raises(RuntimeError):
        write_and_fail()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]
