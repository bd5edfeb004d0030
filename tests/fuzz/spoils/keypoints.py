"""What may happen to keypoints that stay an array of floats of the same shape."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from fuzz.spoils import Arguments, Spoil

SPOILS: dict[str, Spoil] = {}


def _on_keypoints(function: Callable[[Any, np.random.Generator], object]) -> Callable[[Any, np.random.Generator], object]:
    """Register what happens to the array of keypoints (C, F, P, 2), which is given to change in place."""

    def spoil(arguments: Arguments, rng: np.random.Generator) -> None:
        function(arguments["keypoints"], rng)

    SPOILS[function.__name__] = spoil
    return function


@_on_keypoints
def many_missing(keypoints, rng):
    keypoints[rng.random(keypoints.shape[:3]) < rng.uniform(0.3, 0.95)] = np.nan


@_on_keypoints
def all_missing(keypoints, rng):
    keypoints[:] = np.nan


@_on_keypoints
def one_camera_blind(keypoints, rng):
    keypoints[rng.integers(len(keypoints))] = np.nan


@_on_keypoints
def cameras_see_different_frames(keypoints, rng):
    half = keypoints.shape[1] // 2
    keypoints[0, :half] = np.nan
    keypoints[1:, half:] = np.nan


@_on_keypoints
def cameras_see_different_points(keypoints, rng):
    half = keypoints.shape[2] // 2
    keypoints[0, :, :half] = np.nan
    keypoints[1:, :, half:] = np.nan


@_on_keypoints
def only_one_frame_seen(keypoints, rng):
    keypoints[:, 1:] = np.nan


@_on_keypoints
def frames_missing(keypoints, rng):
    keypoints[:, rng.random(keypoints.shape[1]) < 0.5] = np.nan


@_on_keypoints
def only_the_stick_seen(keypoints, rng):
    keypoints[:, :, :-2] = np.nan


@_on_keypoints
def the_stick_never_seen(keypoints, rng):
    keypoints[:, :, -2:] = np.nan


@_on_keypoints
def few_keypoints(keypoints, rng):
    hidden = rng.random(keypoints.shape[1:3]).ravel().argsort()[rng.integers(3, 30) :]
    keypoints.reshape(len(keypoints), -1, 2)[:, hidden] = np.nan


@_on_keypoints
def one_coordinate_missing(keypoints, rng):
    keypoints[0, 0, 0, 0] = np.nan


@_on_keypoints
def one_infinite(keypoints, rng):
    keypoints[0, 0, 0] = np.inf


@_on_keypoints
def all_the_same(keypoints, rng):
    keypoints[:] = 500.0


@_on_keypoints
def all_zero(keypoints, rng):
    keypoints[:] = 0.0


@_on_keypoints
def missing_written_as_zero(keypoints, rng):
    keypoints[rng.random(keypoints.shape[:3]) < rng.uniform(0.05, 0.5)] = 0.0


@_on_keypoints
def missing_written_as_minus_one(keypoints, rng):
    keypoints[rng.random(keypoints.shape[:3]) < 0.2] = -1.0


@_on_keypoints
def some_huge(keypoints, rng):
    keypoints[rng.random(keypoints.shape[:3]) < rng.choice([0.01, 0.3])] = 10.0 ** rng.choice([5, 9, 18, 154, 300])


@_on_keypoints
def all_huge(keypoints, rng):
    keypoints *= 10.0 ** rng.choice([3, 9, 150])


@_on_keypoints
def all_tiny(keypoints, rng):
    keypoints *= 10.0 ** -rng.choice([3.0, 9.0, 150.0])


@_on_keypoints
def far_from_the_image(keypoints, rng):
    keypoints += rng.choice([-1e4, 1e5])


@_on_keypoints
def at_the_principal_point(keypoints, rng):
    keypoints[rng.integers(len(keypoints))] = (960.0, 540.0)


@_on_keypoints
def identical_cameras(keypoints, rng):
    keypoints[1] = keypoints[0]


@_on_keypoints
def all_cameras_identical(keypoints, rng):
    keypoints[:] = keypoints[0]


@_on_keypoints
def almost_identical_cameras(keypoints, rng):
    keypoints[1] = keypoints[0] + rng.normal(0, 10.0 ** rng.integers(-9, 1), keypoints[0].shape)


@_on_keypoints
def mirrored_camera(keypoints, rng):
    keypoints[0, ..., 0] = 1919.0 - keypoints[0, ..., 0]


@_on_keypoints
def swapped_coordinates(keypoints, rng):
    keypoints[-1] = keypoints[-1, ..., ::-1].copy()


@_on_keypoints
def nothing_moves(keypoints, rng):
    keypoints[:] = keypoints[:, :1].copy()


@_on_keypoints
def frames_of_a_camera_shuffled(keypoints, rng):
    keypoints[0] = keypoints[0, rng.permutation(keypoints.shape[1])]


@_on_keypoints
def points_of_a_camera_shuffled(keypoints, rng):
    keypoints[0] = keypoints[0][:, rng.permutation(keypoints.shape[2])]


@_on_keypoints
def on_a_line_in_one_image(keypoints, rng):
    keypoints[0, ..., 1] = 540.0


@_on_keypoints
def on_a_line_in_all_images(keypoints, rng):
    keypoints[..., 1] = 0.3 * keypoints[..., 0] + 100.0


@_on_keypoints
def a_point_twice(keypoints, rng):
    keypoints[:, :, 1] = keypoints[:, :, 0]


@_on_keypoints
def both_ends_of_the_stick_the_same(keypoints, rng):
    keypoints[:, :, -1] = keypoints[:, :, -2]


@_on_keypoints
def all_points_the_same(keypoints, rng):
    keypoints[:] = keypoints[:, :, :1].copy()


@_on_keypoints
def outliers(keypoints, rng):
    wrong = rng.random(keypoints.shape[:3]) < rng.choice([0.1, 0.4, 0.8])
    keypoints[wrong] = rng.uniform(0, 1000, (int(wrong.sum()), 2))


@_on_keypoints
def noise_of_one_camera(keypoints, rng):
    keypoints[0] += rng.normal(0, rng.choice([5, 50, 500]), keypoints[0].shape)


@_on_keypoints
def nothing_but_noise(keypoints, rng):
    keypoints[:] = rng.uniform(0, 1000, keypoints.shape)


@_on_keypoints
def rounded(keypoints, rng):
    keypoints[:] = keypoints.round(-int(rng.integers(0, 3)))
