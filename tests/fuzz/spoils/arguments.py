"""What may happen to the other arguments, and last to the type of the keypoints; in the order of this file."""

from __future__ import annotations

import functools

import numpy as np
import torch

from fuzz.spoils import Spoil
from torchstickcal import Stick

SPOILS: dict[str, Spoil] = {}


def _on_session(function: Spoil) -> Spoil:
    """Register what happens to any of the arguments."""
    SPOILS[function.__name__] = function
    return function


# What happens to the number of frames and points.


@_on_session
def only_the_ends_of_the_stick(given, rng):
    given["keypoints"] = given["keypoints"][:, :, -2:]
    given |= {"sticks": Stick(0, 1, 1.0), "point_names": None}


@_on_session
def fewer_points(given, rng):
    given["keypoints"] = given["keypoints"][:, :, -int(rng.integers(2, 6)) :]
    given |= {"sticks": Stick(0, 1, 1.0), "point_names": None}


@_on_session
def one_frame(given, rng):
    given["keypoints"] = given["keypoints"][:, : int(rng.integers(1, 3))]


# What happens to confidence.


@_on_session
def confidence(given, rng):
    shape = np.shape(given["keypoints"])[:3]
    given["confidence"] = rng.choice([0.0, 1e-300, 1e-9, 0.1, 0.5, 1.0], shape)


@_on_session
def confidence_of_zero(given, rng):
    given["confidence"] = np.zeros(np.shape(given["keypoints"])[:3])
    given["confidence"][: int(rng.integers(3))] = 1.0


@_on_session
def confidence_that_is_none(given, rng):
    shape = np.shape(given["keypoints"])[:3]
    given["confidence"] = [
        np.full(shape, 1.5),
        np.full(shape, -0.1),
        np.full(shape, np.nan),
        np.ones(shape[:2]),
        np.ones(shape[::-1]),
    ][rng.integers(5)]


# What happens to lenses and images.


@_on_session
def distortion(given, rng):
    size = rng.choice([10.0**-9, 0.01, 0.3, 5.0, 1e9, 1e300])
    given["distortion"] = rng.normal(0, size, (len(given["intrinsics"]), rng.choice([4, 5, 8, 12, 14])))


@_on_session
def distortion_as_opencv_hands_it_out(given, rng):
    cameras = len(given["intrinsics"])
    given["distortion"] = np.zeros([(1, 5), (5, 1), (cameras, 1, 5), (cameras, 5, 1), (14,), (1, 14)][rng.integers(6)]) + 0.0
    given["distortion"].reshape(-1)[0] = -0.1


@_on_session
def distortion_that_is_none(given, rng):
    given["distortion"] = [np.zeros(3), np.zeros((2, 2)), np.full(5, np.nan), [], "none", None, 0.0][rng.integers(7)]


@_on_session
def fisheye(given, rng):
    given |= {"fisheye": True, "distortion": rng.normal(0, rng.choice([0.0, 0.05, 2.0]), 4)}


@_on_session
def no_intrinsics(given, rng):
    given["intrinsics"] = None


@_on_session
def another_focal_length(given, rng):
    matrix = given["intrinsics"]
    if matrix is not None:
        matrix[..., [0, 1], [0, 1]] *= rng.choice([1e-9, 0.01, 0.5, 0.9, 2.0, 100.0, 1e9, 1e300])


@_on_session
def intrinsics_that_are_none(given, rng):
    matrix = np.array([[1200.0, 0, 960], [0, 1200, 540], [0, 0, 1]])
    given["intrinsics"] = [
        matrix,
        -matrix,
        0 * matrix,
        np.nan * matrix,
        matrix.T,
        matrix[:2],
        matrix.astype(int),
        np.add(matrix, [[0, 1e9, 0], [0, 0, 0], [0, 0, 0]]),
        np.add(matrix, [[0, 0, 1e9], [0, 0, 0], [0, 0, 0]]),
        matrix.tolist(),
        torch.tensor(matrix, requires_grad=True),
    ][rng.integers(11)]


@_on_session
def another_image_size(given, rng):
    sizes = [
        None,
        (1920, 1080),
        (1920, 1080, 3),
        (0, 0),
        (-1, 5),
        (1e300, 1e300),
        (np.nan, 1),
        (1, 1),
        1080,
        "full",
        (10**400, 1),
    ]
    given["image_size"] = sizes[rng.integers(len(sizes))]


# What happens to times.


@_on_session
def another_frame_rate(given, rng):
    rates = [None, 0, -1, np.nan, np.inf, 1e308, 1e-300, 1e-3, 1e6, "25", "fast", [25, 30, 30], np.array(25), 10**400, True]
    given["fps"] = rates[rng.integers(len(rates))]


@_on_session
def another_readout(given, rng):
    values = [0.0, 0.001, 0.02, 0.5, 1e6, 1e300, -0.01, np.nan, np.inf, "fast", [0.01, 0.01, 0.01]]
    given["readout_s"] = values[rng.integers(len(values))]


@_on_session
def timestamps(given, rng):
    cameras, frames = np.shape(given["keypoints"])[:2]
    times = np.arange(frames) / 8.0 + np.zeros((cameras, 1))
    changes = [
        lambda: times,
        lambda: times[0],
        lambda: times + 1.7e9,
        lambda: times + 0.01 * rng.random((cameras, 1)),
        lambda: np.sort(times + 0.05 * rng.normal(size=times.shape), axis=1),
        lambda: times * (1 + np.arange(cameras)[:, None]),
        lambda: times + 100.0 * np.arange(cameras)[:, None],
        lambda: np.where(np.arange(frames) < frames // 2, times, times + 10.0 ** rng.integers(1, 10)),
        lambda: np.where(np.arange(frames) < 1, times, times + 1.7e9),
        lambda: times * 10.0 ** rng.choice([-300, -12, -6, 6, 12, 300]),
        lambda: np.where(rng.random(times.shape) < 0.3, np.nan, times),
        lambda: -times,
        lambda: 0 * times,
        lambda: np.nan * times,
        lambda: np.inf + times,
        lambda: times.T,
        lambda: times.tolist(),
        lambda: times.astype("float32") + np.float32(1.7e9),
        lambda: times.astype("datetime64[s]"),
        lambda: "now",
    ]
    given["timestamps"] = changes[rng.integers(len(changes))]()


# What happens to sticks.


@_on_session
def several_sticks(given, rng):
    last = np.shape(given["keypoints"])[2] - 1
    given["sticks"] = [Stick(last - 1, last, 1.0), Stick(0, 1, rng.choice([0.001, 0.3, 9.0])), Stick(1, last, 0.5, 0.2)][
        : int(rng.integers(2, 4))
    ]


@_on_session
def the_same_stick_twice(given, rng):
    last = np.shape(given["keypoints"])[2] - 1
    given["sticks"] = [Stick(last - 1, last, 1.0), Stick(last, last - 1, rng.choice([1.0, 2.0]))]


@_on_session
def no_stick(given, rng):
    given["sticks"] = [(), [], None, "stick", 1.0, [None]][rng.integers(6)]


@_on_session
def another_stick(given, rng):
    ends = [
        (0, 1),
        (-1, -2),
        (0, 99),
        (0, 0),
        (19.5, 20.5),
        ("hip", "toe"),
        (True, False),
        (np.int64(0), np.int32(1)),
        (None, 1),
    ]
    lengths = [1.0, 1e-300, 1e-6, 10.0, 1000.0, 0.0, -1.0, np.nan, np.inf, "1", None, np.float32(1.0), 10**400]
    sigmas = [0.001, 1e-300, 1e-12, 1.0, 1e6, 1e300, 0.0, -1.0, np.nan]
    start, end = ends[rng.integers(len(ends)) if rng.random() < 0.3 else 0]
    length, sigma = lengths[rng.integers(len(lengths))], sigmas[rng.integers(len(sigmas))]
    given["sticks"] = functools.partial(Stick, start, end, length, sigma)


# What happens to names.


@_on_session
def odd_camera_names(given, rng):
    odd = [
        "",
        " ",
        "\x7f",
        "\x00",
        "\ud800",
        "a\nb",
        '"',
        "\\",
        "カメラ",
        "🎥",
        "metadata",
        "a" * 10_000,
        5,
        None,
        b"x",
        "../x",
    ]
    given["camera_names"] = [odd[number] for number in rng.permutation(len(odd))[: len(given["keypoints"])]]


@_on_session
def odd_point_names(given, rng):
    points = np.shape(given["keypoints"])[2]
    choices = [None, 5, "names", ["a"] * points, [""] * points, [f"\x7f\ud800{n}" for n in range(points)], ["x"], range(points)]
    given["point_names"] = choices[rng.integers(len(choices))]


# What happens to the shape and the type of keypoints; the last of all.


@_on_session
def another_shape(given, rng):
    keypoints = given["keypoints"]
    given["keypoints"] = [keypoints[0], keypoints[:1], keypoints[:0], keypoints[:, :0], keypoints[..., :1], keypoints[None]][
        rng.integers(6)
    ]


@_on_session
def another_dtype(given, rng):
    dtype = rng.choice(
        ["float32", "float16", ">f8", ">f4", "int64", "int16", "uint8", "longdouble", "complex128", "object", "U9"]
    )
    with np.errstate(all="ignore"):
        given["keypoints"] = np.nan_to_num(given["keypoints"], nan=0.0 if dtype[0] in "iu" else np.nan).astype(dtype)


@_on_session
def another_container(given, rng):
    keypoints = given["keypoints"]
    given["keypoints"] = [
        lambda: keypoints.tolist(),
        lambda: [torch.tensor(np.asarray(own, float)) for own in keypoints],
        lambda: torch.tensor(np.asarray(keypoints, float), requires_grad=True),
        lambda: torch.tensor(np.asarray(keypoints, float), dtype=torch.bfloat16),
        lambda: torch.tensor(np.asarray(keypoints, float)).to_sparse(),
        lambda: torch.tensor(np.asarray(keypoints, float), device="meta"),
        lambda: np.ma.masked_array(keypoints, mask=rng.random(keypoints.shape) < 0.2),
        lambda: np.ma.masked_array(keypoints, mask=True),
        lambda: keypoints[:, ::-1],
        lambda: np.asfortranarray(keypoints),
        lambda: np.broadcast_to(keypoints[:1], keypoints.shape),
        lambda: [own[: 2 + number] for number, own in enumerate(keypoints)],
        lambda: {"keypoints": keypoints},
        lambda: None,
        lambda: "keypoints",
    ][rng.integers(15)]()
