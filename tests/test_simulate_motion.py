"""Simulated athletes: bones, sticks, smoothness, speeds, feet."""

from __future__ import annotations

import numpy as np
import pytest

from torchstickcal import CalibrationError
from torchstickcal.simulate import SPORTS, Motion, action
from torchstickcal.simulate.athlete import interpolate
from torchstickcal.simulate.paths import PATHS, Path, Walk
from torchstickcal.simulate.skeleton import JOINT_INDEX, JOINTS, PARENTS, Skeleton, bend, rotation

PEAK_SPEEDS_M_S = {"golf": (30, 50), "baseball": (25, 35), "hockey": (20, 35), "kendo": (10, 25), "wand": (2, 8)}
STICKS_M = {"baseball": 0.86, "golf": 1.00, "hockey": 1.60, "kendo": 1.20, "wand": 0.50}


@pytest.fixture(params=SPORTS)
def sport(request: pytest.FixtureRequest) -> str:
    return request.param


def walking(sport: str, **changes) -> Motion:
    return Motion(SPORTS[sport], **({"path": Path("figure8"), "seed": 3} | changes))


def test_lengths_of_the_sticks():
    assert {sport: SPORTS[sport].stick_m for sport in STICKS_M} == STICKS_M


def test_bones_and_stick_keep_their_lengths_at_any_time(sport: str):
    motion = walking(sport, skeleton=Skeleton(1.9))
    points = motion.points(np.linspace(-9, 21, 4001))
    for joint, parent in PARENTS.items():
        lengths = np.linalg.norm(points[:, JOINT_INDEX[joint]] - points[:, JOINT_INDEX[parent]], axis=1)
        np.testing.assert_allclose(lengths, motion.skeleton.bone_m(joint), rtol=0, atol=1e-12)
    lengths = np.linalg.norm(points[:, 20] - points[:, 19], axis=1)
    np.testing.assert_allclose(lengths, motion.action.stick_m, rtol=0, atol=1e-12)


def test_the_stick_is_rigid_in_the_hands_that_hold_it(sport: str):
    motion = walking(sport)
    points = motion.points(np.linspace(0, 12, 1001))
    along = (points[:, 20] - points[:, 19]) / motion.action.stick_m
    for side, grip_m in motion.action.grips_m.items():
        hand = points[:, JOINT_INDEX[f"{side}_hand"]]
        np.testing.assert_allclose(hand, points[:, 19] + grip_m * along, rtol=0, atol=1e-12)


def test_accelerations_are_continuous(sport: str):
    """Where the second derivative jumped, its change from one sample to the next would not shrink with their distance."""
    motion = walking(sport, path=Path("square"), seed=1)

    def largest_change(step_s: float) -> np.ndarray:
        points = motion.points(np.arange(0, 1.1 * motion.period_s, step_s))
        return np.abs(np.diff(points, 3, axis=0)).max((0, 2)) / step_s**2

    assert (largest_change(1 / 8000) < 0.6 * largest_change(1 / 4000) + 1e-3).all()


@pytest.mark.parametrize("sport", PEAK_SPEEDS_M_S)
def test_peak_speeds_are_those_of_the_sport_and_scale_with_tempo(sport: str):
    def peaks(motion: Motion) -> np.ndarray:
        step = 1 / 400 / motion.tempo
        tip = motion.points(np.arange(4 * round(motion.period_s / step)) * step)[:, 20]
        speed = np.linalg.norm(np.gradient(tip, step, axis=0), axis=1)
        return speed.reshape(4, -1).max(1)

    low, high = PEAK_SPEEDS_M_S[sport]
    real = peaks(walking(sport))
    assert low < real.min()
    assert real.max() < high
    np.testing.assert_allclose(peaks(walking(sport, tempo=0.25)), real / 4, rtol=1e-9)


def test_feet_do_not_slide_while_a_golfer_swings():
    motion = walking("golf", path=Path("circle"))
    swing = np.linspace(0.3, 1.6, 100)
    for cycle in (0, 1):
        foot = motion.points(cycle * motion.period_s + swing)[:, JOINT_INDEX["left_ankle"]]
        assert np.ptp(foot, axis=0).max() < 1e-12


def test_walking_feet_do_not_slide():
    """Planted feet do not move, end beside the standing body, and hardly ever leave the floor both at once."""
    walk = Walk(Path("circle"), laps=0.5, start_s=1.0, end_s=2.5, period_s=3.0)
    times = np.linspace(0, 6, 1201)
    feet = [walk.foot(times, np.tile([x, 0.0, 0.0], (len(times), 1)), leads=x > 0) for x in (-0.2, 0.2)]
    lifted = [foot[:, 2] > 1e-3 for foot in feet]
    assert (lifted[0] & lifted[1]).mean() < 0.15
    for foot, up in zip(feet, lifted, strict=True):
        assert 0.04 < foot[:, 2].max() <= 0.1
        planted = ~up[1:] & ~up[:-1]
        assert np.abs(np.diff(foot, axis=0)[planted]).max() < 0.01
    position, body = walk.body(np.array([2.9]))
    standing = walk.foot(np.array([2.9]), np.array([[0.2, 0.0, 0.0]]), leads=True)
    np.testing.assert_allclose(standing, position + 0.2 * body[..., 0], atol=1e-12)


def test_repetitions_vary_and_the_seed_determines_how(sport: str):
    times = np.linspace(0, action(sport).period_s, 50, endpoint=False)
    still = Path("stay")
    first, again = walking(sport, path=still).points(times), walking(sport, path=still).points(times + action(sport).period_s)
    assert 1e-3 < np.abs(first - again).mean() < 0.1
    assert walking(sport, path=still).points(times).tobytes() == first.tobytes()
    assert (walking(sport, path=still, seed=4).points(times) != first).any()
    exact = walking(sport, path=still, variation=0)
    np.testing.assert_allclose(exact.points(times), exact.points(times + action(sport).period_s), atol=1e-9)


@pytest.mark.parametrize("shape", PATHS[1:])
def test_paths_are_closed_and_headings_follow_them(shape: str):
    path = Path(shape, 0.5)
    laps = np.linspace(0, 1, 2001)
    places, headings = path.at(laps)
    np.testing.assert_allclose(places[0], places[-1], atol=1e-12)
    slopes = np.gradient(places, axis=0)[1:-1]
    cosines = (slopes * headings[1:-1]).sum(1) / np.linalg.norm(slopes, axis=1)
    assert cosines.min() > 1 - 1e-4
    assert 0.3 < np.abs(places).max() < 0.65


def test_interpolation_meets_its_knots_and_does_not_overshoot():
    knots, values = np.array([0.0, 1.0, 1.5, 3.0, 4.0]), np.array([[0.0], [0.0], [2.0], [2.5], [1.0]])
    np.testing.assert_allclose(interpolate(knots, values, knots), values, atol=1e-12)
    times = np.linspace(0, 4, 4001)
    curve = interpolate(knots, values, times)[:, 0]
    assert np.abs(curve[times <= 1]).max() == 0
    assert curve.min() > -1e-12
    assert curve.max() < 2.5 + 1e-12


def test_a_standing_skeleton_and_a_turned_one():
    body = Skeleton(1.80)
    straight = np.tile(np.eye(3), (2, len(JOINTS), 1, 1))
    straight[1, JOINT_INDEX["pelvis"]] = rotation(2, np.array(90.0))
    points = body.forward(np.tile(body.offsets_m[0], (2, 1)), straight)
    assert points[0, JOINT_INDEX["head_top"], 2] == pytest.approx(1.80)
    assert points[0, JOINT_INDEX["left_ankle"], 2] == pytest.approx(body.ankle_height_m)
    np.testing.assert_allclose(points[1], points[0] @ rotation(2, np.array(90.0)).T, atol=1e-12)


def test_bending_a_limb():
    root, goal = np.zeros((1, 3)), np.array([[0.0, 0.0, -0.8]])
    knee = bend(root, goal, 0.5, 0.5, np.array([[0.0, 2.0, 5.0]]))
    np.testing.assert_allclose(knee, [[0.0, 0.3, -0.4]], atol=1e-12)
    with pytest.raises(CalibrationError, match=r"out of reach.*got 1.200 to 1.200 m; expected 0.000 to 1.000 m"):
        bend(root, 1.5 * goal, 0.5, 0.5, goal)


def test_unknown_names_and_sizes_are_refused():
    with pytest.raises(CalibrationError, match=r"unknown sport.*'curling'.*baseball, golf, hockey, kendo"):
        action("curling")
    with pytest.raises(CalibrationError, match=r"unknown path.*circle, square, triangle, figure8"):
        Path("spiral")
    with pytest.raises(CalibrationError, match=r"not the height of a person.*176"):
        Skeleton(176)
