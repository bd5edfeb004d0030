"""Analysis of swings: angles, stick kinematics, phases, repeated swings, and their standard deviations."""

from __future__ import annotations

import csv
import importlib.util
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from torchstickcal import Calibration, CalibrationError, Observations, Stick, calibrate, triangulate
from torchstickcal.analysis import ANGLES, EVENTS, SPORTS, Analysis, analyse, multiple_correlation
from torchstickcal.analysis.angles import missing_points, with_derived
from torchstickcal.analysis.interpolation import at
from torchstickcal.analysis.phases import events_of, swing_peaks
from torchstickcal.analysis.pictures import curves_picture
from torchstickcal.analysis.smoothing import from_sphere, on_sphere, smoother
from torchstickcal.analysis.stick import StickMotion
from torchstickcal.analysis.stick_smoothing import StickSmoother
from torchstickcal.analysis.tables import table, write_tables
from torchstickcal.analysis.tracks import Tracks, tracks_of
from torchstickcal.cli import main
from torchstickcal.io import Rig, write_npz
from torchstickcal.simulate import Motion, action
from torchstickcal.simulate.rigs import Lens, camera_rig
from torchstickcal.simulate.skeleton import JOINTS

FPS = 100.0
NAMES = (*JOINTS, "left_hip", "right_hip", "butt", "tip")
UP = np.array([0.0, 0.0, 1.0])


def positions(sport: str, times: np.ndarray, seed: int = 3) -> np.ndarray:
    """Joints, hips and stick (T, 23, 3), z up."""
    motion = Motion(action(sport), seed=seed)
    points = motion.points(times)
    return np.concatenate([points[:, :19], motion.hips(times), points[:, 19:]], axis=1)


def recorded(sport: str, seconds: float, sigma_px: float = 1.5, fps: float = FPS) -> tuple[Calibration, np.ndarray, np.ndarray]:
    """A calibration of a swing, its true points in the first camera's frame, and the vertical there."""
    rng = np.random.default_rng(4)
    rig = camera_rig("ring", 4, rng, Lens(), 4.5)
    points = positions(sport, np.arange(round(seconds * fps)) / fps)
    keypoints = rig.project(np.repeat(points[None], 4, axis=0))
    observations = Observations(
        keypoints + sigma_px * rng.standard_normal(keypoints.shape),
        rig.intrinsics,
        Stick("butt", "tip", action(sport).stick_m),
        image_size=rig.image_size,
        fps=fps,
        point_names=NAMES,
    )
    return calibrate(observations), points @ rig.rotations[0].T + rig.translations[0], rig.rotations[0] @ UP


def seen_by(calibration: Calibration, points: np.ndarray) -> Observations:
    """Keypoints of points in the frame of a calibration, with errors of a pixel."""
    moved = torch.from_numpy(points).flatten(0, 1) @ calibration.rotations.mT + calibration.translations[:, None]
    exact = calibration._cameras().project(moved).unflatten(1, points.shape[:2])
    return Observations(
        exact + torch.from_numpy(np.random.default_rng(9).standard_normal(exact.shape)),
        calibration.intrinsics,
        Stick("butt", "tip", action("golf").stick_m),
        camera_names=calibration.camera_names,
        fps=FPS,
        point_names=NAMES,
    )


@pytest.fixture(scope="module")
def golf() -> tuple[Calibration, np.ndarray, np.ndarray]:
    return recorded("golf", 2.4)


@pytest.fixture(scope="module")
def golf_analysis(golf) -> Analysis:
    return analyse(golf[0], "golf")


def true_motion(sport: str, seconds: float, hz: float = 1000.0) -> tuple[np.ndarray, StickMotion]:
    times, tiny = np.arange(0, seconds, 1 / hz), 1e-4
    stick, before, after = (positions(sport, times + shift)[:, -2:] for shift in (0.0, -tiny, tiny))
    velocity = (after - before) / (2 * tiny)
    along = stick[:, 1] - stick[:, 0]
    length = np.linalg.norm(along, axis=-1)
    rate = np.linalg.norm(velocity[:, 1] - velocity[:, 0], axis=-1) / length
    return times, StickMotion(stick[None, :, 0], stick[None, :, 1], velocity[None, :, 0], velocity[None, :, 1], rate[None])


STANDING = {
    "left_hip": (-0.1, 0, 1), "right_hip": (0.1, 0, 1), "left_knee": (-0.1, 0, 0.5), "right_knee": (0.1, 0, 0.5),
    "left_ankle": (-0.1, 0, 0), "right_ankle": (0.1, 0, 0), "left_shoulder": (-0.2, 0, 1.5), "right_shoulder": (0.2, 0, 1.5),
    "left_elbow": (-0.2, 0, 1.2), "right_elbow": (0.2, 0, 1.2), "left_wrist": (-0.2, 0, 0.9), "right_wrist": (0.2, 0, 0.9),
}  # fmt: skip
"""Upright, arms hanging; x to the right, y forward"""


class TestAngles:
    @staticmethod
    def posed(**points: tuple[float, float, float]) -> dict[str, np.ndarray]:
        names = tuple(points)
        return with_derived(names, np.array([[points[name] for name in names]], dtype=float), UP)

    def test_standing_upright_is_zero(self):
        points = self.posed(**STANDING)
        for name, angle in ANGLES.items():
            if not name.endswith(("_shoulder_plane", "_turn")):  # no direction of a hanging arm, no origin of a turn
                np.testing.assert_allclose(angle.of(points), 0, atol=1e-9, err_msg=name)

    @pytest.mark.parametrize(
        ("name", "moved", "degrees"),
        [
            ("left_elbow_flexion", {"left_wrist": (-0.2, 0.3, 1.2)}, 90),
            ("right_elbow_flexion", {"right_wrist": (0.2, 0.15, 1.2 + 0.15 * 3**0.5)}, 150),
            ("right_knee_flexion", {"right_ankle": (0.1, -0.5, 0.5)}, 90),
            ("left_hip_flexion", {"left_knee": (-0.1, 0.5, 1)}, 90),
            ("left_shoulder_elevation", {"left_elbow": (-0.5, 0, 1.5)}, 90),
            ("left_shoulder_plane", {"left_elbow": (-0.5, 0, 1.5)}, 0),
            ("right_shoulder_plane", {"right_elbow": (0.5, 0, 1.5)}, 0),
            ("left_shoulder_plane", {"left_elbow": (-0.2, 0.3, 1.5)}, 90),
            ("right_shoulder_plane", {"right_elbow": (0.2, 0.3, 1.5)}, 90),
            ("trunk_lean", {"left_shoulder": (-0.2, 0.5, 1.5), "right_shoulder": (0.2, 0.5, 1.5)}, 45),
            ("x_factor", {"left_shoulder": (0, -0.2, 1.5), "right_shoulder": (0, 0.2, 1.5)}, 90),
            ("x_factor_projected", {"left_shoulder": (0, -0.2, 1.5), "right_shoulder": (0, 0.2, 1.5)}, 90),
            ("x_factor_projected", {"left_hip": (0, -0.1, 1), "right_hip": (0, 0.1, 1)}, -90),
        ],
    )
    def test_postures_of_known_angles(self, name: str, moved: dict, degrees: float):
        assert ANGLES[name].of(self.posed(**(STANDING | moved)))[0] == pytest.approx(degrees, abs=1e-9)

    def test_turns_are_positive_to_the_left(self):
        before = self.posed(**STANDING)
        left = self.posed(**(STANDING | {"left_shoulder": (-0.17, -0.1, 1.5), "right_shoulder": (0.17, 0.1, 1.5)}))
        turn = ANGLES["trunk_turn"].of(left) - ANGLES["trunk_turn"].of(before)
        assert turn[0] % 360 == pytest.approx(np.degrees(np.arctan2(0.1, 0.17)), abs=1e-9)

    def test_every_angle_has_its_definition_and_source(self):
        for angle in ANGLES.values():
            assert angle.definition.endswith(".")
            assert any(year in angle.source for year in ("1983", "2001", "2002", "2005", "2010"))

    def test_points_of_other_spellings_are_found(self):
        points = with_derived(("LShoulder", "elbow_left", "l_wrist"), np.zeros((1, 3, 3)), None)
        assert not missing_points(ANGLES["left_elbow_flexion"], points)
        assert missing_points(ANGLES["trunk_lean"], points) == ["trunk", "up"]


class TestSmoothing:
    def test_clear_motion_is_hardly_bent(self):
        times = np.arange(60) / FPS
        track = (2 + 3 * times - 40 * times**2 + 30 * times**3)[:, None, None]
        value, slope = smoother(times, track, np.full((60, 1), 1e-6))(track)
        np.testing.assert_allclose(value, track, atol=3e-4)  # of a noise of 1e-3
        inner = slice(5, -5)
        np.testing.assert_allclose(slope[inner, 0, 0], (3 - 80 * times + 90 * times**2)[inner], atol=0.02)
        assert np.isnan(slope[0])  # an end alone says little of a velocity
        line = 2 + 3 * times[:, None, None]
        np.testing.assert_allclose(smoother(times, line, np.full((60, 1), 1e-6))(line)[0], line, atol=1e-9)

    @pytest.mark.parametrize("turns_hz", [0.5, 2.0, 6.0])
    def test_draws_are_as_wrong_as_the_estimate_and_short_gaps_are_bridged(self, turns_hz: float):
        """Of fast motions too, where what smoothing leaves out is as large as the noise."""
        rng, times = np.random.default_rng(0), np.arange(300) / FPS
        phases, speed = rng.uniform(0, 6, 10), 2 * np.pi * turns_hz
        angle = speed * times[:, None] + phases
        true = np.stack([np.sin(angle), np.cos(angle)], axis=-1)
        estimates = true + 0.01 * rng.standard_normal((21, *true.shape))
        estimates[1:] += estimates[0] - true
        estimates[:, 100:103], estimates[:, 200:220] = np.nan, np.nan
        value, slope = smoother(times, estimates[0], np.full((300, 10), 1e-4))(estimates)
        assert np.isfinite(value[:, 100:103]).all()
        assert np.isnan(value[:, 205:215]).all()
        for found, exact in ((value, true), (slope, speed * np.stack([np.cos(angle), -np.sin(angle)], axis=-1))):
            error, stated = found[0] - exact, np.sqrt(np.square(found[1:] - found[0]).mean(0))
            assert 0.7 < np.sqrt(np.nanmean(np.square(error / stated))) < 1.3
        assert np.nanmedian(np.abs(value[0] - true)) < 0.9 * 0.01 * 0.6745

    def test_directions_that_turn_evenly_are_not_bent(self):
        times = np.arange(50) / FPS
        angle = 20 * times
        direction = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1)[:, None]
        smooth = smoother(times, direction, np.full((50, 1), 1e-4), on_sphere(direction))
        unit, rate = from_sphere(direction, *smooth(direction))
        inner = slice(10, -10)
        np.testing.assert_allclose(unit[inner], direction[inner], atol=1e-9)
        np.testing.assert_allclose(np.linalg.norm(rate, axis=-1)[inner], 20, rtol=1e-9)
        in_space = smoother(times, direction, np.full((50, 1), 1e-2))(direction)[1]
        assert np.linalg.norm(in_space, axis=-1)[inner].max() < 19.8


class TestStickSmoothing:
    """A stick of 1 m whose hands move on a small circle and whose direction turns unevenly."""

    TIMES = np.arange(240) / FPS

    def moved(self, times: np.ndarray) -> np.ndarray:
        """Both ends, (T, 2, 3)."""
        angle = 3 * times + 1.2 * np.sin(5 * times)
        hands = 0.3 * np.stack([np.cos(4 * times), np.sin(4 * times), 0.2 * np.cos(3 * times)], axis=-1)
        tilt = 0.4 * np.sin(2 * times)
        along = np.stack([np.cos(angle) * np.cos(tilt), np.sin(angle) * np.cos(tilt), np.sin(tilt)], axis=-1)
        return np.stack([hands, hands + along], axis=1)

    def tracks(self, roots: np.ndarray, seed: int = 0) -> Tracks:
        """With errors of square roots of covariances ``roots`` (T, 2, 3, 3)."""
        noise = np.random.default_rng(seed).standard_normal((len(self.TIMES), 2, 3, 1))
        points = self.moved(self.TIMES) + (roots @ noise)[..., 0]
        none = np.zeros((*points.shape, 1))
        return Tracks(self.TIMES, points, roots, none, np.zeros((1, 1)), ("butt", "tip"), ((0, 1, 1.0, 0.0),), UP)

    def errors(self, tracks: Tracks, draws: int = 0) -> tuple[np.ndarray, np.ndarray]:
        """Of the velocity of the tip, (T, 3), and its draws, (N, T, 3), without both ends of the recording."""
        motion = StickSmoother.of(tracks, 0)(tracks.drawn(draws), np.ones(1 + draws))
        true = (self.moved(self.TIMES + 1e-5) - self.moved(self.TIMES - 1e-5))[:, 1] / 2e-5
        inner = slice(15, -15)
        return (motion.tip_velocity[0] - true)[inner], (motion.tip_velocity[1:] - motion.tip_velocity[0])[:, inner]

    def roots(self, tip: tuple[float, float, float] = (0.005, 0.005, 0.005)) -> np.ndarray:
        return np.tile(np.stack([0.005 * np.eye(3), np.diag(tip)]), (len(self.TIMES), 1, 1, 1))

    @pytest.mark.parametrize("tip", [(0.005, 0.005, 0.005), (0.04, 0.005, 0.005), (0.01, 0.03, 0.02)])
    def test_stated_deviations_are_right(self, tip: tuple[float, float, float]):
        ratios = []
        for seed in range(3):
            error, drawn = self.errors(self.tracks(self.roots(tip), seed), 12)
            ratios.append(error / np.sqrt(np.square(drawn).mean(0)))
        assert 0.75 < np.sqrt(np.square(ratios).mean()) < 1.3

    @pytest.mark.parametrize("tip", [(0.05, 0.005, 0.005), (0.005, 0.05, 0.05)])
    def test_each_end_counts_by_its_own_covariance(self, tip: tuple[float, float, float]):
        """Not by the mean over its axes."""
        tracks = self.tracks(self.roots(tip))
        alike = np.sqrt(np.mean(np.square(tip)))
        error, _ = self.errors(tracks)
        without, _ = self.errors(replace(tracks, roots=self.roots((alike, alike, alike))))
        assert np.sqrt(np.square(error).mean()) < 0.9 * np.sqrt(np.square(without).mean())

    def test_an_end_that_is_not_seen_for_some_frames_is_bridged_and_a_long_gap_is_not(self):
        roots = self.roots()
        roots[60:63, 1], roots[120:150, 0] = np.nan, np.nan
        motion = StickSmoother.of(self.tracks(roots), 0)(self.tracks(roots).drawn(0), np.ones(1))
        apart = np.linalg.norm(motion.tip[0] - self.moved(self.TIMES)[:, 1], axis=-1)
        assert apart[60:63].max() < 0.01
        assert np.isnan(apart[125:145]).all()

    def test_an_exact_motion_stays_as_it_is(self):
        tracks = replace(self.tracks(0.001 * self.roots()), points=self.moved(self.TIMES))
        assert np.abs(self.errors(tracks)[0]).max() < 0.01


class TestTracks:
    def test_frames_are_triangulated_by_themselves_and_errors_are_as_stated(self, golf):
        calibration, true, _ = golf
        tracks = tracks_of(calibration)
        error = tracks.points - true
        drawn = tracks.drawn(60)
        std = np.sqrt(np.square(drawn[1:] - drawn[0]).mean(0))
        assert 0.9 < np.sqrt(np.nanmean(np.square(error / std))) < 1.1
        smoothed = calibration.points.numpy() - true
        assert np.nanmean(np.square(error)) > 1.5 * np.nanmean(np.square(smoothed))

    def test_errors_of_the_cameras_move_points_as_other_cameras_would(self, golf):
        calibration, _, _ = golf
        tracks = tracks_of(calibration)
        tangent = torch.zeros(len(calibration.covariance), dtype=torch.float64)
        tangent[2], tangent[9] = 1e-5, 1e-5  # camera 1 moves, camera 2 rotates
        rotations, translations = calibration.rotations.clone(), calibration.translations.clone()
        translations[1] += 1e-5 * rotations[1, :, 2]
        x = torch.tensor([[0, 0, 0], [0, 0, -1e-5], [0, 1e-5, 0]], dtype=torch.float64)
        rotations[2] = rotations[2] @ torch.matrix_exp(x)
        points = calibration.points.flatten(0, 1)

        def pixels(r: torch.Tensor, t: torch.Tensor) -> torch.Tensor:
            moved = points @ r.mT + t[:, None]
            return calibration._cameras().project(moved).unflatten(1, calibration.points.shape[:2])

        keypoints = pixels(calibration.rotations, calibration.translations) - calibration.residuals_px
        residuals = pixels(rotations, translations) - keypoints
        moved = replace(calibration, rotations=rotations, translations=translations, residuals_px=residuals)
        change = tracks_of(moved).points - tracks.points
        np.testing.assert_allclose(change, (tracks.by_cameras @ tangent.numpy()), atol=3e-7)

    def test_vertical_of_level_cameras(self, golf):
        calibration, _, up = golf
        assert tracks_of(calibration).up @ up > np.cos(np.radians(0.3))
        assert tracks_of(calibration, up=[0, 0, 3]).up.tolist() == [0, 0, 1]

    def test_without_level_cameras_there_is_no_vertical(self, golf):
        rolled = golf[0].rotations.clone()
        turn = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]], dtype=rolled.dtype)
        rolled[::2] = turn @ rolled[::2]
        tracks = tracks_of(replace(golf[0], rotations=rolled))
        assert tracks.up is None
        assert "vertical is not known" in tracks.notes[0]

    def test_unusable_arguments_are_refused(self, golf):
        with pytest.raises(CalibrationError, match="--fps"):
            tracks_of(replace(golf[0], fps=None, times=None))
        with pytest.raises(CalibrationError, match="direction"):
            tracks_of(golf[0], up=[0, 0, 0])
        for options, message in (({"sport": "gofl"}, "golf"), ({"stick": 1}, "0 to 0"), ({"draws": 1}, "2 or more")):
            with pytest.raises(CalibrationError, match=message):
                analyse(golf[0], **options)


class TestPhases:
    @pytest.mark.parametrize("sport", ["golf", "baseball", "hockey", "kendo"])
    def test_rules_find_the_key_postures(self, sport: str):
        """Top and impact are key postures of the simulated motions; without variation their times are known."""
        key = {"golf": (1.15, 1.435), "baseball": (1.05, 1.32), "hockey": (1.90, 2.185), "kendo": (0.98, 1.21)}[sport]
        times, motion = true_motion(sport, 3.0)
        (peak,) = swing_peaks(times, motion.turn_rate[0])
        takeaway, top, impact, finish = events_of(times, motion, peak, SPORTS[sport], UP)
        assert 0 < takeaway < top < impact < finish
        stance = {"golf": 0.25, "baseball": 0.30, "hockey": 1.05, "kendo": 0.60}[sport]
        assert takeaway == pytest.approx(stance, abs=0.1)
        assert top == pytest.approx(key[0], abs=0.05)
        assert impact == pytest.approx(key[1], abs=0.06)

    @pytest.mark.parametrize(("carried_m", "turning"), [(0.2, 0.03), (0.3, 0.2)])
    def test_a_bat_that_is_carried_back_begins_when_it_moves(self, carried_m: float, turning: float):
        """A bat turns slowly all the time, is carried back from 1.0 to 1.4 s, and is swung at 2 s."""
        times = np.arange(0, 3, 1e-3)
        share = np.clip((times - 1.0) / 0.4, 0, 1)
        hands = carried_m * share**3 * (10 - 15 * share + 6 * share**2)
        angle = turning * times + 1.5 * (1 + np.tanh((times - 2.2) / 0.03))
        start = np.stack([hands, 0 * hands, 0 * hands], axis=-1)
        tip = start + 0.86 * np.stack([np.cos(angle), 0 * angle, np.sin(angle)], axis=-1)
        velocity = [np.gradient(part, times, axis=0)[None] for part in (start, tip)]
        rate = np.gradient(angle, times)
        motion = StickMotion(start[None], tip[None], *velocity, rate[None])
        (peak,) = swing_peaks(times, rate)
        takeaway, top, *_ = events_of(times, motion, peak, SPORTS["baseball"], UP)
        assert 1.0 < takeaway < 1.1
        assert 2.0 < top < 2.2

    @pytest.mark.parametrize("waggle_rad_s", [0.4, 0.55])
    def test_a_batter_who_moves_the_bat_slowly_has_not_begun(self, waggle_rad_s: float):
        """Before it is carried back at up to 0.94 m/s, the bat turns about its end, at up to 0.27 m/s as a whole."""
        self.test_a_bat_that_is_carried_back_begins_when_it_moves(0.2, waggle_rad_s)

    def test_events_of_a_swing_that_is_cut_off_are_unknown(self):
        times, motion = true_motion("golf", 1.5)
        (peak,) = swing_peaks(times, motion.turn_rate[0])
        events = events_of(times, motion, peak, SPORTS["golf"], UP)
        assert np.isfinite(events[:2]).all()
        assert np.isnan(events[2:]).all()

    def test_repeated_swings_are_found_and_slow_motions_are_not(self):
        times, motion = true_motion("golf", 11.0)
        peaks = times[swing_peaks(times, motion.turn_rate[0])]
        assert np.diff(peaks) == pytest.approx([4.0, 4.0], abs=0.1)

    def test_interpolation_is_exact_for_cubics(self):
        times = np.array([0.0, 0.1, 0.25, 0.3, 0.5, 0.6])
        when = np.array([0.0, 0.17, 0.6])
        np.testing.assert_allclose(at(times, 1 + times**3, when), 1 + when**3)
        assert np.isnan(at(times, times, 0.7))


class TestAnalysis:
    def test_angles_are_accurate_and_their_deviations_honest(self, golf, golf_analysis):
        _, true, up = golf
        derived = with_derived(NAMES, true, up)
        ratios = []
        for name in ("left_elbow_flexion", "right_knee_flexion", "left_hip_flexion", "trunk_lean", "x_factor"):
            curve = golf_analysis.curves[name]
            error = curve.values - ANGLES[name].of(derived)
            assert np.sqrt(np.nanmean(np.square(error))) < 1.2, name
            ratios.append(error / curve.std)
        assert 0.7 < np.sqrt(np.nanmean(np.square(ratios))) < 1.4

    def test_swing_is_that_of_the_truth(self, golf_analysis):
        times, motion = true_motion("golf", 2.4)
        events = events_of(times, motion, swing_peaks(times, motion.turn_rate[0])[0], SPORTS["golf"], UP)
        (swing,) = golf_analysis.swings
        for event, true_s in zip(EVENTS, events, strict=True):
            assert swing.events[event].value == pytest.approx(true_s, abs=1 / FPS), event
        figures = swing.figures
        assert figures["peak_tip_speed"].value == pytest.approx(motion.tip_speed.max(), rel=0.02)
        assert figures["tempo"].value == pytest.approx((events[1] - events[0]) / (events[2] - events[1]), rel=0.1)
        velocity = at(times, motion.tip_velocity[0], events[2])
        attack = np.degrees(np.arcsin(velocity[2] / np.linalg.norm(velocity)))
        assert abs(figures["attack_angle"].value - attack) < 4 * figures["attack_angle"].std + 0.5
        assert 40 < figures["plane_slope"].value < 70

    def test_same_seed_gives_the_same_numbers_and_float32_works(self, golf):
        short = replace(golf[0], points=golf[0].points.float(), residuals_px=golf[0].residuals_px.float())
        first, second = (analyse(short, "golf", draws=3) for _ in range(2))
        assert first.curves["tip_speed"].std.tobytes() == second.curves["tip_speed"].std.tobytes()

    def test_stick_length_uncertainty_is_in_the_speed(self, golf, golf_analysis):
        calibration = golf[0]
        sticks = tuple(replace(stick, sigma_m=0.05) for stick in calibration.sticks)
        vague = analyse(replace(calibration, sticks=sticks), "golf", draws=12)
        std = [a.swings[0].figures["peak_tip_speed"].std for a in (golf_analysis, vague)]
        assert std[1] > 1.5 * std[0]

    def test_skeleton_without_hips_leaves_angles_out_and_says_so(self, golf):
        keep = [number for number, name in enumerate(NAMES) if "hip" not in name]
        calibration = replace(
            golf[0],
            points=golf[0].points[:, keep],
            residuals_px=golf[0].residuals_px[:, :, keep],
            inliers=golf[0].inliers[:, :, keep],
            sigma_px=golf[0].sigma_px[keep],
            point_names=tuple(NAMES[number] for number in keep),
            sticks=(replace(golf[0].sticks[0], start=19, end=20),),
        )
        found = analyse(calibration, "golf", draws=2)
        assert "x_factor" not in found.curves
        assert "left_elbow_flexion" in found.curves
        assert any("left_knee_flexion" in note for note in found.notes)


class TestNotFound:
    """What is said of a swing of which a part is missing."""

    @staticmethod
    def part(calibration: Calibration, frames: slice) -> Calibration:
        index = calibration.frame_index[:, frames]
        return replace(
            calibration,
            points=calibration.points[frames],
            residuals_px=calibration.residuals_px[:, frames],
            inliers=calibration.inliers[:, frames],
            frame_index=index - index.min(),
            times=None,
        )

    @pytest.mark.parametrize(
        ("frames", "missing", "without"),
        [
            (slice(60, None), ("takeaway", "impact"), "tempo"),
            (slice(0, 150), ("impact", "finish"), "peak_tip_speed"),
            (slice(60, 150), ("takeaway", "impact", "finish"), "backswing"),
        ],
    )
    def test_every_event_that_is_missing_is_named(
        self, golf, tmp_path: Path, frames: slice, missing: tuple[str, ...], without: str
    ):
        found = analyse(self.part(golf[0], frames), "golf", draws=2)
        assert [swing.not_found for swing in found.swings] == [missing]
        text = table(found)
        assert "nan" not in text.lower()
        assert text.splitlines()[1].count("not found") == len(missing)
        said = {"takeaway": "no address found", "impact": "no impact found", "finish": "no finish found"}
        for event, sentence in said.items():
            assert (sentence in text) == (event in missing)
        assert without in next(note for note in found.notes if "without a value" in note)
        assert any("counted from the first frame" in note for note in found.notes) == ("takeaway" in missing)
        write_tables(tmp_path, found)
        assert json.loads((tmp_path / "analysis.json").read_text())["swings"][0]["not_found"] == list(missing)
        rows = list(csv.DictReader((tmp_path / "swings.csv").open()))
        assert [row["event"] for row in rows if row["figure"] == "not_found"] == list(missing)
        assert curves_picture(found).get_suptitle().count("found") == len(missing)

    def test_turns_are_not_spoken_of_where_there_are_none(self, golf):
        part = self.part(golf[0], slice(60, None))
        sticks = (replace(part.sticks[0], start=0, end=1),)
        names = ("butt", "tip")
        alone = replace(
            part,
            points=part.points[:, -2:],
            residuals_px=part.residuals_px[:, :, -2:],
            inliers=part.inliers[:, :, -2:],
            sigma_px=part.sigma_px[-2:],
            point_names=names,
            sticks=sticks,
        )
        notes = analyse(alone, "golf", draws=2).notes
        assert any("no address found" in note for note in notes)
        assert not any("Turns of" in note for note in notes)

    def test_a_whole_swing_has_no_such_note(self, golf_analysis):
        assert golf_analysis.swings[0].not_found == ()
        assert not any("found" in note for note in golf_analysis.notes)
        assert curves_picture(golf_analysis).get_suptitle() == ""


class TestRepeats:
    def test_correlation_of_alike_and_of_unrelated_curves(self):
        rng, steps = np.random.default_rng(0), np.linspace(0, 6, 101)
        alike = np.sin(steps) + 0.01 * rng.standard_normal((5, 101))
        assert multiple_correlation(alike) > 0.999
        unrelated = multiple_correlation(rng.standard_normal((5, 101)))
        assert not unrelated > 0.3  # NaN or small
        assert np.isnan(multiple_correlation(alike[:1]))

    def test_correlation_is_kadabas_formula(self):
        curves = np.random.default_rng(1).standard_normal((4, 101)) * 0.3 + np.cos(np.linspace(0, 3, 101))
        count, steps = curves.shape
        among = sum((curves[g, t] - curves[:, t].mean()) ** 2 for g in range(count) for t in range(steps)) / (
            steps * (count - 1)
        )
        total = ((curves - curves.mean()) ** 2).sum() / (count * steps - 1)
        assert multiple_correlation(curves) == pytest.approx((1 - among / total) ** 0.5)


def test_command_writes_tables_and_pictures(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    calibration, _, _ = recorded("kendo", 5.4, fps=50.0)
    calibration.save(tmp_path / "points.npz")
    assert main(["analyse", str(tmp_path), "--sport", "kendo", "--write", "trc"]) == 0
    assert "tempo" in capsys.readouterr().out
    files = sorted(file.name for file in (tmp_path / "analysis").iterdir())
    assert files == ["analysis.json", "curves.csv", "curves.png", "points.trc", "repeated.csv", "repeated.png", "swings.csv"]
    content = json.loads((tmp_path / "analysis" / "analysis.json").read_text())
    assert len(content["swings"]) == 2
    assert 0.9 < content["multiple_correlation"]["stick_turn_rate"]["value"] <= 1
    assert content["rules"]["impact"] == SPORTS["kendo"].rule
    rows = list(csv.DictReader((tmp_path / "analysis" / "curves.csv").open()))
    assert len(rows) == 270
    assert float(rows[100]["left_elbow_flexion_std"]) > 0
    repeated = list(csv.DictReader((tmp_path / "analysis" / "repeated.csv").open()))
    assert [row["per_cent"] for row in repeated[:2]] == ["0", "1"]


def test_triangulated_recording_is_analysed_too(golf, golf_analysis, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """And its C3D file has the phases as events."""
    calibration, true, _ = golf
    given = seen_by(calibration, true)
    calibration.save(tmp_path / "points.npz")
    write_npz(tmp_path / "swing.npz", given)
    formats = ["--write", "c3d"] if importlib.util.find_spec("ezc3d") else []
    command = ["triangulate", str(tmp_path / "swing.npz"), "--calibration", str(tmp_path / "points.npz"), "--analyse", "golf"]
    assert main([*command, "--out", str(tmp_path / "out"), *formats]) == 0
    assert "tempo" in capsys.readouterr().out
    swing = json.loads((tmp_path / "out" / "analysis" / "analysis.json").read_text())["swings"][0]
    for event in EVENTS:
        assert swing["events"][event]["value"] == pytest.approx(golf_analysis.swings[0].events[event].value, abs=1.5 / FPS)
    if formats:
        import ezc3d

        event = ezc3d.c3d(str(tmp_path / "out" / "analysis" / "points.c3d"))["parameters"]["EVENT"]
        assert event["LABELS"]["value"] == list(EVENTS)
        np.testing.assert_allclose(event["TIMES"]["value"][1], [swing["events"][name]["value"] for name in EVENTS], atol=1e-4)


def test_command_without_a_calibration_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert main(["analyse", str(tmp_path)]) == 2
    assert "torchstickcal calibrate" in capsys.readouterr().err


class TestOtherRecordings:
    def test_frame_of_the_world_changes_no_angle(self, golf):
        calibration, _, up = golf
        same = analyse(calibration, "golf", up=up, draws=5)
        placed = calibration.in_world("athlete")
        assert abs(tracks_of(placed).up @ [0, 0, 1]) > np.cos(np.radians(3))
        found = analyse(placed, "golf", up=placed.rotations[0].T.numpy() @ up, draws=5)
        for curve in ("left_elbow_flexion", "trunk_lean", "tip_speed"):
            np.testing.assert_allclose(found.curves[curve].values, same.curves[curve].values, atol=1e-4)
            assert 0.7 < np.nanmedian(found.curves[curve].std / same.curves[curve].std) < 1.4

    def test_vertical_is_that_of_a_measured_frame(self, golf):
        placed = golf[0].in_world("athlete")
        tilted = replace(placed, world=replace(placed.world, name="points"))
        assert tracks_of(tilted).up.tolist() == [0, 0, 1]
        assert "z axis of the frame" in tracks_of(tilted).notes[0]

    def test_tracks_of_what_was_triangulated(self, golf):
        """By fewer cameras in another order, and with cameras of a file, of whose errors nothing is known."""
        calibration, true, _ = golf
        given = seen_by(calibration, true)
        some = [2, 0, 3]
        names = [calibration.camera_names[number] for number in some]
        fewer = replace(given, keypoints=given.keypoints[some], intrinsics=given.intrinsics[some], camera_names=names)
        found = triangulate(fewer, Rig.of_calibration(calibration))
        assert not found.covariance.any()
        tracks = tracks_of(found)
        noise = np.sqrt(tracks.variances)[..., None]
        assert 0.8 < np.sqrt(np.nanmean(np.square((tracks.points - true) / noise))) < 1.2
        without = replace(found, sticks=())
        with pytest.raises(CalibrationError, match="a recording with a stick"):
            analyse(without, "golf")
