"""A body height in the place of a stick."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from torchstickcal import Observations, calibrate, load_config
from torchstickcal.cli import main
from torchstickcal.errors import ConfigError, ObservationError
from torchstickcal.io import write_npz
from torchstickcal.pipeline.height import segments_of
from torchstickcal.simulate import Noise, golf_session
from torchstickcal.skeletons import SKELETONS, conventional

HEIGHT_M = 1.76
"""of the simulated athlete"""
AVERAGE = {
    "head_top": (0, 0, 1.0), "nose": (0, 0.06, 0.915), "ear": (0.04, 0, 0.93), "eye": (0.02, 0.05, 0.936),
    "shoulder": (0.11, 0, 0.818), "hip": (0.05, 0, 0.53), "knee": (0.05, 0, 0.285), "ankle": (0.05, 0, 0.039),
    "heel": (0.05, -0.03, 0.02), "pelvis": (0, 0, 0.53),
}  # fmt: skip
"""Places of the joints of an average adult who stands upright, in body heights."""


def place_of(name: str) -> tuple[float, float, float] | None:
    """Where a joint of the average adult is; None for one that is not known."""
    side, _, joint = conventional(name).rpartition("_")
    joint, sign = (conventional(name), 0) if conventional(name) in AVERAGE else (joint, {"left": -1, "right": 1}.get(side, 0))
    if joint not in AVERAGE:
        return None
    x, y, z = AVERAGE[joint]
    return sign * x, y, z


def heights_of(names: Sequence[str], bent: bool = False) -> np.ndarray:
    """The body heights that the segments say of an average adult; if bent, forward at the hips and down in the knees."""
    places = {number: np.array(place) for number, name in enumerate(names) if (place := place_of(name))}
    found = []
    for start, end, share, rigid in segments_of(names):
        if not (bent and not rigid):
            length = np.linalg.norm(np.mean([places[k] for k in start], 0) - np.mean([places[k] for k in end], 0))
            found.append(length / share)
    return np.array(found)


@pytest.mark.parametrize("skeleton", [name for name in SKELETONS if name != "halpe-26"])
def test_every_skeleton_says_the_height_of_an_average_adult(skeleton: str):
    assert heights_of(SKELETONS[skeleton]) == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize(
    "names",
    [
        ["nose", "LAnkle", "RAnkle"],
        ["head_top", "left_heel", "right_heel"],
        ["ear_left", "ear_right", "ankle_l", "ankle_r"],
        ["pelvis", "lknee", "rknee", "lankle", "rankle"],
        ["left_hip", "left_knee", "left_heel"],
    ],
)
def test_few_points_are_enough(names: list[str]):
    assert heights_of(names) == pytest.approx(1.0, abs=0.03)


@pytest.mark.parametrize("names", [None, [], ["nose"], ["left_ankle", "right_ankle"], ["a", "b"], ["left_wrist", "left_elbow"]])
def test_points_of_which_it_says_nothing_are_refused(names: list[str] | None):
    with pytest.raises(ObservationError, match="says nothing of these points"):
        segments_of(names)


@pytest.fixture(scope="module")
def swing():
    observations, truth = golf_session(cameras=3, frames=40, noise=Noise(0.5), seed=2)
    return replace(observations, sticks=()), truth


def scale_of(observations: Observations, truth, config) -> float:
    """Size of the calibrated rig over its true size."""
    calibration = calibrate(observations, config)
    sizes = [
        float((-(r.mT @ t[..., None])[1:, :, 0].double() + (r[:1].mT @ t[:1, ..., None])[..., 0].double()).norm(dim=1).sum())
        for r, t in ((calibration.rotations, calibration.translations), (truth.rotations, truth.translations))
    ]
    return sizes[0] / sizes[1]


@pytest.mark.parametrize(
    ("config", "without"),
    [
        ({"extends": "default"}, []),
        ({"extends": "default"}, ["head_top"]),
        ({"extends": "paper"}, []),
        ({"extends": "human_only", "scale": False}, ["left_ankle"]),
        ({"extends": "default"}, ["left_shoulder", "right_shoulder", "left_knee", "right_knee"]),
    ],
)
def test_it_sets_the_scale(swing, config: dict, without: list[str]):
    observations, truth = swing
    names = [f"unknown_{name}" if name in without else name for name in observations.point_names]
    named = replace(observations, point_names=tuple(names))
    whole = "left_shoulder" not in without
    # the simulated athlete has average proportions; the head of a golfer is not above the ankles
    assert scale_of(named, truth, config | {"height_m": HEIGHT_M}) == pytest.approx(1.0, abs=0.01 if whole else 0.3)


def test_what_it_states_is_honest(swing):
    observations, truth = swing
    calibration = calibrate(observations, {"extends": "default", "height_m": HEIGHT_M})
    assert 0.02 < float(calibration.scale_std) < 0.04
    assert {finding.code for finding in calibration.quality.findings} >= {"scale_imprecise"}
    twice = scale_of(observations, truth, {"extends": "default", "height_m": 0.9 * HEIGHT_M})
    assert twice / scale_of(observations, truth, {"extends": "default", "height_m": HEIGHT_M}) == pytest.approx(0.9, rel=1e-3)


def test_a_stick_is_better_and_the_height_is_then_not_used(swing):
    observations, truth = golf_session(cameras=3, frames=40, noise=Noise(0.5), seed=2)
    with_height = calibrate(observations, {"extends": "default", "height_m": 2.0})
    assert torch.equal(with_height.translations, calibrate(observations).translations)
    assert "height_unused" in {finding.code for finding in with_height.quality.findings}
    joints = {"extends": "default", "points": "joints", "height_m": HEIGHT_M}
    assert scale_of(observations, truth, joints) == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize("height_m", [178, 0.1, 17.8])
def test_other_units_are_refused(height_m: float):
    with pytest.raises(ConfigError, match=r"not the height of a person.*in metres"):
        load_config({"extends": "default", "height_m": height_m})


@pytest.mark.parametrize("head", ["head_top", "nose", "right_ear"])
@pytest.mark.parametrize("feet", ["ankle", "heel"])
def test_human_only_works_with_any_head_and_feet(swing, head: str, feet: str):
    """The points are the same; only what they are called, and so what their distance is taken for, differs."""
    observations, truth = swing
    new = {"head_top": head, "left_ankle": f"left_{feet}", "right_ankle": f"right_{feet}"}
    named = replace(observations, point_names=tuple(new.get(name, name) for name in observations.point_names))
    expected = (AVERAGE[head.removeprefix("right_")][2] - AVERAGE[feet][2]) / 0.961
    found = scale_of(named, truth, "human_only") / scale_of(observations, truth, "human_only")
    assert found == pytest.approx(expected, rel=1e-3)


def test_on_the_command_line(swing, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    observations, truth = swing
    write_npz(tmp_path / "swing.npz", observations, truth)
    write_npz(tmp_path / "stick.npz", *golf_session(cameras=3, frames=40, noise=Noise(0.5), seed=2))
    command = ["calibrate", str(tmp_path / "swing.npz"), "--out", str(tmp_path / "out")]
    assert main(command) == 2
    assert "--height" in capsys.readouterr().err
    for more in ([], ["--config", "human_only"]):
        assert main([*command, "--height", "1.76", *more]) == 0
        assert main(["evaluate", str(tmp_path / "out"), str(tmp_path / "swing.npz")]) == 0
    assert main([*command, "--height", "176"]) == 2
    assert "in metres" in capsys.readouterr().err
    assert main(["calibrate", str(tmp_path / "stick.npz"), "--out", str(tmp_path / "out"), "--height", "1.76"]) == 0
    assert "the body height of 1.76 m is not used" in capsys.readouterr().err
