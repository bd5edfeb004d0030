"""Bad input is refused in one place, with an error that names it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from torchstickcal import ObservationError, Observations, Stick

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
    ],
)
def test_bad_sticks_are_refused(values: tuple[int, int, float], message: str):
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
