"""Bad input is refused in one place, with an error that names it."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import pytest
import torch

from torchstickcal import ObservationError, Observations, Stick, calibrate
from torchstickcal.errors import ObservationWarning
from torchstickcal.simulate import Noise, golf_session

K = [[1000.0, 0, 500], [0, 1000, 400], [0, 0, 1]]


def arguments(**changes: Any) -> dict[str, Any]:
    keypoints = np.random.default_rng(0).uniform(0, 800, (3, 5, 4, 2))
    return {"keypoints": keypoints, "intrinsics": K, "sticks": Stick(2, 3, 1.0)} | changes


def changed(value: float, at: tuple[int, ...]) -> np.ndarray:
    keypoints = arguments()["keypoints"].copy()
    keypoints[at] = value
    return keypoints


def stick_seen_by_one() -> np.ndarray:
    keypoints = arguments()["keypoints"].copy()
    keypoints[1:, :, 3] = np.nan
    return keypoints


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"keypoints": np.zeros((3, 5, 4))}, r"keypoints have the wrong shape.*\(3, 5, 4\).*\(cameras, frames, points, 2\)"),
        ({"keypoints": np.zeros((3, 0, 4, 2))}, "wrong shape"),
        ({"keypoints": np.zeros((1, 5, 4, 2))}, "at least two cameras.*1 camera"),
        ({"keypoints": changed(np.inf, (1, 2, 3, 0))}, r"infinite.*keypoints\[1, 2, 3\]"),
        ({"keypoints": changed(np.nan, (1, 2, 3, 0))}, r"only one coordinate.*keypoints\[1, 2, 3\]"),
        ({"keypoints": [["a"]]}, "not an array of numbers"),
        ({"keypoints": stick_seen_by_one()}, r"a stick is never seen by two cameras.*sticks\[0\].*1 at its end"),
        ({"intrinsics": np.eye(4)}, r"intrinsics have the wrong shape.*\(4, 4\).*\(3, 3, 3\)"),
        ({"intrinsics": np.zeros((3, 3))}, "not invertible"),
        ({"intrinsics": np.stack([K, K, np.diag([0.0, 1, 1])])}, r"intrinsics\[2\]"),
        ({"distortion": np.zeros(3)}, r"distortion has the wrong shape.*\(3,\).*4, 5, 8"),
        ({"distortion": [np.nan] * 5}, "distortion is not finite"),
        ({"distortion": np.zeros(5), "fisheye": True}, "distortion has the wrong shape"),
        ({"confidence": np.zeros((3, 5))}, "confidence has the wrong shape"),
        ({"confidence": np.full((3, 5, 4), 1.5)}, r"confidence outside \[0, 1\].*confidence\[0, 0, 0\].*60 such"),
        ({"confidence": np.full((3, 5, 4), np.nan)}, r"confidence outside \[0, 1\]"),
        ({"image_size": [0, 5]}, "image size"),
        ({"fps": -1}, "frame rate"),
        ({"point_names": ["a", "b"]}, "names do not fit.*4 different names"),
        ({"camera_names": ["a", "a", "b"]}, "names do not fit"),
        ({"sticks": Stick(2, 9, 1.0)}, "not a tracked point.*from 0 to 3"),
        ({"sticks": [Stick(0, 1, 1.0), Stick(1, 0, 1.0)]}, r"two sticks have the same ends.*sticks\[1\]"),
        ({"sticks": Stick("tip", 1, 1.0)}, r"no such point.*'tip'.*points have no names"),
        ({"sticks": Stick("tipp", 1, 1.0), "point_names": ["a", "tip", "c", "d"]}, r"'tipp'.*Did you mean 'tip'"),
        ({"sticks": [1.0]}, "not a stick"),
        ({"sticks": None}, r"not a stick \(sticks\).*an empty list"),
        ({"sticks": "tip"}, "not a stick"),
        ({"keypoints": None}, r"not an array of numbers \(keypoints\)"),
        ({"intrinsics": None, "image_size": (640, 480, 3)}, r"image size.*\(2,\) or \(3, 2\)"),
        ({"image_size": (np.inf, 480)}, "image size"),
        ({"fps": [30, 60, 60]}, "frame rate.*give timestamps"),
        ({"fps": "abc"}, r"frame rate.*'abc'"),
        ({"fps": 1e308}, "frame rate"),
        ({"readout_s": [0.01, 0.01, 0.02], "fps": 60, "image_size": (640, 480)}, "not a read-out time.*timestamps"),
        ({"readout_s": 0.02, "fps": 60, "image_size": (640, 480)}, "read-out time longer than a frame.*at most 0.0166"),
        ({"point_names": 5}, "names do not fit"),
        ({"point_names": "abcd"}, "names do not fit"),
        ({"fisheye": [True, False, False]}, r"neither yes nor no \(fisheye\)"),
        ({"keypoints": changed(1e154, (1, 2, 3, 0))}, r"outside any image \(keypoints\[1, 2, 3\]\)"),
        ({"intrinsics": np.diag([1e154, 1e154, 1.0])}, "not a camera matrix"),
        ({"distortion": [1e154] * 5}, "distortion is not finite"),
        ({"confidence": np.full((3, 5, 4), 37.0)}, "Divide the scores of a heat map by the largest"),
    ],
)
def test_bad_input_is_refused(changes: dict[str, Any], message: str):
    with pytest.raises(ObservationError, match=message):
        Observations(**arguments(**changes))


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ((0, 0, 1.0), "two different ends"),
        ((0, 1, 0.0), "not a length"),
        ((0, 1, -1.0), "not a length"),
        ((0, 1, float("nan")), "not a length"),
        ((0, 1, 1150.0), r"millimetres.*Divide by 1000: 1.15 m"),
        ((0, 1, 86.0), r"centimetres.*Divide by 100: 0.86 m"),
        ((0, 1, 1e-300), "not a length"),
        ((0, 1, 10**400), "not a length"),
        ((0, 1, "1"), r"not a length \(Stick.length_m\): got '1'"),
        ((0, 1, None), "not a length"),
        ((0, 1, True), "not a length"),
        ((0, 1, [1.0, 1.2]), "each stick its own"),
        ((0, 1, 1.0, 0), r"not a length \(Stick.sigma_m\)"),
        ((0, 1, 1.0, 1e300), r"not a length \(Stick.sigma_m\)"),
        ((0.5, 1, 1.0), r"not a point \(Stick.start\)"),
        ((0, True, 1.0), r"not a point \(Stick.end\)"),
        ((0, None, 1.0), "not a point"),
        ((1, np.int64(1), 1.0), "two different ends"),
    ],
)
def test_bad_sticks_are_refused(values: tuple[Any, ...], message: str):
    with pytest.raises(ObservationError, match=message):
        Stick(*values)


def test_an_error_says_what_where_got_expected_and_remedy():
    with pytest.raises(ObservationError) as caught:
        Stick(0, 1, 1150.0)
    error = caught.value
    assert (error.where, error.got) == ("Stick.length_m", 1150.0)
    assert "metres" in error.expected
    assert "1.15" in error.remedy


def test_input_is_kept_as_given():
    given = arguments(intrinsics=torch.tensor(K, dtype=torch.float32), distortion=[0.1, 0, 0, 0])
    observations = Observations(**given)
    assert (observations.keypoints.numpy() == given["keypoints"]).all()
    assert observations.intrinsics.shape == (3, 3)
    assert observations.intrinsics.dtype == torch.float32
    assert observations.sticks == (given["sticks"],)
    assert observations.cameras.matrix.shape == (3, 3, 3)
    assert observations.cameras.matrix.dtype == torch.float64


def test_confidence_zero_is_not_seen():
    confidence = np.ones((3, 5, 4))
    confidence[0, 0, 0] = 0
    assert int((~Observations(**arguments(confidence=confidence)).visible).sum()) == 1


def test_stick_length_can_be_replaced():
    observations = Observations(**arguments()).with_stick_length(0.9)
    assert observations.sticks == (Stick(2, 3, 0.9),)
    two = Observations(**arguments(sticks=[Stick(0, 1, 1.0), Stick(2, 3, 1.0)]))
    with pytest.raises(ObservationError, match="2 sticks"):
        two.with_stick_length(0.9)


def test_numbers_of_a_stick_are_kept_as_plain_numbers():
    stick = Stick(np.int64(19), torch.tensor(20), np.float32(1.5), np.float64(0.01))
    assert stick == Stick(19, 20, 1.5, 0.01)
    assert [type(value) for value in (stick.start, stick.end, stick.length_m, stick.sigma_m)] == [int, int, float, float]


def test_masked_values_are_not_seen():
    given = arguments()
    mask = np.zeros(given["keypoints"].shape, bool)
    mask[0, 1, 2] = True
    keypoints = np.ma.masked_array(given["keypoints"], mask)
    confidence = np.ma.masked_array(np.full((3, 5, 4), 2.0), np.arange(60).reshape(3, 5, 4) != 7)
    confidence.data[0, 1, 3] = 0.5
    assert Observations(**given | {"keypoints": keypoints}).visible.logical_not().nonzero().tolist() == [[0, 1, 2]]
    seen = Observations(keypoints, K, [], confidence=confidence).visible
    assert seen.nonzero().tolist() == [[0, 1, 3]]
    assert not Observations(np.ma.masked_all_like(keypoints), K, Stick(2, 3, 1.0)).visible.any()
    with pytest.raises(ObservationError, match=r"9 masked values"):
        Observations(**given | {"intrinsics": np.ma.masked_all((3, 3))})


@pytest.mark.parametrize("count", [4, 5, 8, 12, 14])
def test_distortion_as_opencv_returns_it(count: int):
    lens, many = np.full(count, 1e-3), np.full((3, count), 1e-3)
    for shape in ((count,), (1, count), (count, 1), (1, 1, count)):
        assert Observations(**arguments(distortion=lens.reshape(shape))).distortion.tolist() == lens.tolist()
    for shape in ((3, count), (3, 1, count), (3, count, 1)):
        assert Observations(**arguments(distortion=many.reshape(shape))).distortion.tolist() == many.tolist()
    assert Observations(**arguments(intrinsics=[K])).intrinsics.tolist() == K


def test_coefficients_that_are_zero_do_not_make_a_sensor_tilted():
    lens = np.zeros((1, 14))
    lens[0, :8] = [1.7, 0.7, 1e-4, -2e-4, 0.03, 2.0, 1.2, 0.16]
    observations = Observations(**arguments(distortion=lens))
    assert observations.distortion.shape == (14,)
    assert observations.cameras.distortion.shape == (3, 8)
    assert Observations(**arguments(distortion=np.zeros((1, 0)))).distortion is None


def test_keypoints_in_half_precision_do_not_round_the_cameras():
    observations, _ = golf_session(cameras=3, frames=10, noise=Noise(sigma_px=1.0))
    half = observations.keypoints.half()
    matrix = [[1201.37, 0, 960], [0, 1201.37, 540], [0, 0, 1]]
    short, long = (calibrate(Observations(keypoints, matrix, observations.sticks)) for keypoints in (half, half.double()))
    assert short.intrinsics.dtype == short.translations.dtype == torch.float32
    assert float(short.intrinsics[0, 0, 0]) == pytest.approx(1201.37)
    torch.testing.assert_close(short.translations.double(), long.translations, rtol=0, atol=1e-5)


def test_what_requires_gradients_is_calibrated_without_them():
    observations, _ = golf_session(cameras=3, frames=10, noise=Noise(sigma_px=1.0))
    matrix = observations.intrinsics.clone().requires_grad_()
    by_camera = [camera.clone().requires_grad_() for camera in observations.keypoints]
    given = Observations(by_camera, matrix, observations.sticks, distortion=observations.distortion)
    found = calibrate(given).translations
    assert torch.equal(found, calibrate(observations).translations)


def test_keypoints_in_the_corner_are_named():
    keypoints = changed(0.0, (0, 1, 2)).astype(np.float32)
    with pytest.warns(ObservationWarning, match=r"1 of 60 keypoints lie exactly at \(0, 0\).*Set them to NaN"):
        observations = Observations(**arguments(keypoints=keypoints))
    assert len(observations.warnings) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert observations.with_stick_length(0.9).to("cpu").warnings == observations.warnings
    unseen = np.ones((3, 5, 4))
    unseen[0, 1, 2] = 0
    assert Observations(**arguments(keypoints=keypoints, confidence=unseen)).warnings == ()
    assert Observations(**arguments(keypoints=changed(0.0, (0, 1, 2, 0)))).warnings == ()


@pytest.mark.parametrize(("points", "elsewhere", "used"), [(7, False, False), (6, False, True), (7, True, True)])
def test_copies_of_the_frame_before_are_found_and_not_used(points: int, elsewhere: bool, used: bool):
    """Where enough points are seen, here 6, and unless all cameras show copies."""
    keypoints = np.random.default_rng(0).uniform(1, 900, (3, 8, points, 2))
    keypoints[1, 2, 0] = np.nan
    keypoints[1 if not elsewhere else slice(None), 3:5] = keypoints[1 if not elsewhere else slice(None), 2:3]
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        observations = Observations(keypoints, np.diag([900.0, 900, 1]), Stick(2, 3, 1.0), camera_names=["a", "b", "c"])
    found = [[3, 4] if points == 7 and (camera == 1 or elsewhere) else [] for camera in range(3)]
    assert [camera.nonzero().flatten().tolist() for camera in observations.repeated] == found
    seen = observations.keypoints.isfinite().all(-1)
    seen[1, 3:5] &= used
    assert torch.equal(observations.visible, seen)
    said = [name for name, frames in zip("abc", found, strict=True) if frames and not elsewhere]
    assert [str(one.message)[:15] for one in warned] == [f"{name}: 2 of 8 frame" for name in said]


def test_a_calibration_names_keypoints_in_the_corner():
    observations, _ = golf_session(cameras=3, frames=10, noise=Noise(sigma_px=1.0))
    keypoints = observations.keypoints.clone()
    keypoints[0, 2, 3] = 0.0
    with pytest.warns(ObservationWarning):
        calibration = calibrate(Observations(keypoints, observations.intrinsics, observations.sticks))
    assert "(0, 0)" in calibration.warnings[0]
