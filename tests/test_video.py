"""Videos in: frames and their times, marked ends of a stick, body networks, and the folder of a session."""

from __future__ import annotations

import csv
import json
import re
import struct
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from torchstickcal import Calibration, CalibrationError, FileFormatError
from torchstickcal.cli import main
from torchstickcal.io import Rig, RigCamera, read_recording, write_camera_toml
from torchstickcal.metrics import pose_errors
from torchstickcal.simulate import Lens, Motion, action
from torchstickcal.simulate.footage import CameraFilm, Exposure, Markers, markers_of, write_video
from torchstickcal.simulate.rigs import camera_rig
from torchstickcal.video import detect, detect_video, frames_of, video_info
from torchstickcal.video.ball import disc_in, discs_of
from torchstickcal.video.frames import frame_numbers
from torchstickcal.video.patch import Patch
from torchstickcal.video.shaft import shaft_in, shaft_track
from torchstickcal.video.tape import HUES, Background, Candidate, TapeTrack, candidates, check_colours, ends_of, learned

GREY, RED, YELLOW = (110, 105, 100), (30, 25, 215), (25, 220, 235)
SIZE = (320, 240)


def picture(*discs: tuple[float, float, tuple[int, int, int]], radius: float = 5.0, blur_px: float = 0.0) -> np.ndarray:
    """A grey image with discs at x, y; each is the mean over a motion of ``blur_px`` along x, around its place."""
    mean = np.zeros((SIZE[1], SIZE[0], 3))
    steps = max(1, int(4 * blur_px))
    for step in range(steps):
        drawn = np.full(mean.shape, GREY, np.uint8)
        for x, y, colour in discs:
            at = x + blur_px * ((step + 0.5) / steps - 0.5), y
            centre = [round(v * 16) for v in at]
            cv2.circle(drawn, (centre[0], centre[1]), round(radius * 16), colour, -1, cv2.LINE_AA, 4)
        mean += drawn / steps
    return mean.round().astype(np.uint8)


def written(path: Path, pictures: list[np.ndarray], fps: float = 30.0) -> Path:
    write_video(path, iter(pictures), fps)
    return path


EMPTY = picture()


class TestFrames:
    def test_frames_and_times(self, tmp_path: Path):
        path = written(tmp_path / "a.mp4", [picture((20.0 + 10 * k, 50, RED)) for k in range(8)], fps=25.0)
        times, images = zip(*frames_of(path), strict=True)
        np.testing.assert_allclose(times, np.arange(8) / 25, atol=1e-3)
        assert images[0].shape == (240, 320, 3)
        info = video_info(path)
        assert (info.size, info.frames, info.turned_deg) == ((320, 240), 8, 0)
        assert info.fps == pytest.approx(25)

    def test_a_turned_camera_gives_upright_frames(self, tmp_path: Path):
        path = written(tmp_path / "a.mp4", [picture((40, 50, RED))] * 3)
        content = bytearray(path.read_bytes())
        matrix = content.find(b"tkhd") + 4 + 40  # version 0: the 3 x 3 matrix of the track
        content[matrix : matrix + 36] = struct.pack(">9i", 0, 1 << 16, 0, -(1 << 16), 0, 0, 240 << 16, 0, 1 << 30)
        path.write_bytes(content)
        _, image = next(frames_of(path))
        assert image.shape == (320, 240, 3)
        assert video_info(path).size == (240, 320)
        assert video_info(path).turned_deg in (90, 270)
        red = np.argwhere((image[..., 2].astype(int) - image[..., 1]) > 100).mean(0)
        np.testing.assert_allclose(red, [40, 240 - 1 - 50], atol=1.0)

    @pytest.mark.parametrize("dropped", [(), (3,), (2, 3, 7)])
    def test_dropped_frames_are_seen_in_the_times(self, dropped: tuple[int, ...]):
        kept = np.array([k for k in range(12) if k not in dropped])
        jitter = 2e-4 * np.random.default_rng(0).standard_normal(len(kept))
        numbers, fps = frame_numbers(5.0 + kept / 59.94 + jitter)
        assert (numbers - numbers[0]).tolist() == (kept - kept[0]).tolist()
        assert fps == pytest.approx(59.94, rel=1e-2)

    def test_what_is_no_video_is_refused(self, tmp_path: Path):
        (tmp_path / "a.mp4").write_bytes(b"no video at all")
        with pytest.raises(FileFormatError, match="video"):
            list(frames_of(tmp_path / "a.mp4"))
        with pytest.raises(FileNotFoundError, match="no such video"):
            video_info(tmp_path / "b.mp4")
        with pytest.raises(FileFormatError, match="folder"):
            video_info(tmp_path)


class TestTape:
    BACKGROUND = Background(EMPTY.astype(np.float32), {"red": np.float32(RED), "yellow": np.float32(YELLOW)})

    @pytest.mark.parametrize("blur_px", [0.0, 6.0, 25.0, 40.0])
    @pytest.mark.parametrize("place", [(100.3, 80.7), (200.0, 120.5)])
    def test_centre_of_a_streak_is_sub_pixel(self, place: tuple[float, float], blur_px: float):
        noise = np.random.default_rng(0).normal(0, 2, EMPTY.shape)
        image = (picture((*place, RED), blur_px=blur_px) + noise).clip(0, 255).round().astype(np.uint8)
        best = candidates(image, self.BACKGROUND, "red")[0]
        assert np.hypot(best.x - place[0], best.y - place[1]) < 0.5
        assert best.area_px == pytest.approx(np.pi * 5**2, rel=0.3)
        assert best.streak_px > 0.7 * blur_px

    def test_other_colours_are_not_taken(self):
        other = picture((100, 80, YELLOW), (150, 80, (200, 80, 40)), (200, 80, (150, 170, 205)), (250, 80, (30, 30, 30)))
        assert candidates(other, self.BACKGROUND, "red") == []

    def test_background_is_learned_although_the_athlete_stands_still(self):
        standing = EMPTY.copy()
        cv2.rectangle(standing, (90, 60), (130, 200), (180, 120, 60), -1)
        frames = []
        for k in range(20):
            image = (standing if k < 14 else EMPTY).copy()
            cv2.circle(image, (30 + 12 * k, 30), 5, RED, -1)
            frames.append(image)
        person = np.array([[95, 65, 1.0], [125, 65, 1], [95, 195, 1], [125, 195, 1]])
        with_body = learned(frames, ["red"], [person if k < 14 else None for k in range(20)])
        np.testing.assert_allclose(with_body.image[100:180, 95:125], EMPTY[100:180, 95:125])
        assert abs(learned(frames, ["red"]).image[130, 110] - np.array(GREY)).max() > 40
        assert with_body.colours["red"] is not None
        assert np.abs(with_body.colours["red"] - RED).max() < 12
        never = learned(frames[:14], ["red"], [person] * 14)
        assert np.isnan(never.image[130, 110]).all()

    @staticmethod
    def track(frames: int = 30) -> TapeTrack:
        track = TapeTrack()
        for k in range(frames):
            track.add([Candidate(10.0 + 5 * k, 50 + 0.1 * k**2, 80.0, 10.0)])
        return track

    def test_no_end_rather_than_a_wrong_one(self):
        track = self.track()
        track.found[5] = [Candidate(200.0, 20.0, 80.0, 10.0)]  # a jump
        track.found[10].append(Candidate(90.0, 30.0, 70.0, 10.0))  # two of a kind
        track.found[15] = [Candidate(85.0, 72.0, 40.0, 8.0)]  # half hidden
        track.found[20] = []
        track.near[25] = (300.0, 200.0, 20.0)  # far from the hands
        ends = ends_of([track])[0]
        unsure = np.flatnonzero(np.isnan(ends[:, 0])).tolist()
        assert unsure == [5, 10, 15, 20, 25]
        np.testing.assert_allclose(ends[7, :2], [45.0, 54.9])
        assert set(ends[:, 2]) == {0.0, 1.0}

    def test_nothing_is_found_in_an_empty_video(self):
        track = TapeTrack()
        for _ in range(10):
            track.add([])
        assert np.isnan(ends_of([track])[0][:, :2]).all()

    def test_colours_that_are_none_are_refused(self):
        check_colours(list(HUES))
        for names in (["red", "red"], ["reed"], []):
            with pytest.raises(CalibrationError, match="--tape"):
                check_colours(names)


def ball(stick_px: float, turned_deg: float, covered: bool = False) -> tuple[Patch, np.ndarray]:
    """A ball at (30, 30) and a stick that comes out of it towards the camera, or a hand that covers one side."""
    x, y = np.meshgrid(np.arange(60.0), np.arange(60.0))
    axis = np.array([np.cos(np.radians(turned_deg)), np.sin(np.radians(turned_deg))])
    along, across = (x - 30) * axis[0] + (y - 30) * axis[1], (y - 30) * axis[0] - (x - 30) * axis[1]
    shares = np.clip(9.5 - np.hypot(x - 30, y - 30), 0, 1)
    front = (along > 3) & ((np.abs(across) < stick_px / 2) | covered)
    behind = (along < 0) & (np.abs(across) < stick_px / 2) & (shares == 0)
    return Patch(np.where(front, 0, shares).astype(np.float32), front | behind, (0, 0)), axis


class TestPatch:
    @pytest.mark.parametrize("turned_deg", [0.0, 35.0, 90.0, 200.0])
    @pytest.mark.parametrize("stick_px", [3.0, 5.0])
    def test_the_stick_in_front_does_not_move_the_centre(self, stick_px: float, turned_deg: float):
        patch, axis = ball(stick_px, turned_deg)
        assert abs((patch.centre - 30) @ axis) > 0.3
        for direction in (axis, -3 * axis):
            centre = patch.centre_on(direction)
            assert centre is not None
            np.testing.assert_allclose(centre, [30, 30], atol=0.25)

    @pytest.mark.parametrize("turned_deg", [0.0, 120.0])
    def test_a_side_that_is_covered_is_noticed(self, turned_deg: float):
        patch, axis = ball(4.0, turned_deg, covered=True)
        assert patch.is_covered(axis)
        assert patch.centre_on(axis) is None
        assert not ball(4.0, turned_deg)[0].is_covered(axis)


class TestBall:
    @staticmethod
    def seen(centre: tuple[float, float], streak: np.ndarray, hidden: np.ndarray | None = None, radius: float = 7.0) -> Patch:
        """A ball that moves during the exposure, and where a stick or a hand hides it; colours are blurred over a pixel."""
        y, x = np.mgrid[:60, :60].astype(float)
        moments = (np.arange(40) + 0.5) / 40 - 0.5
        places = [np.array(centre) + moment * streak for moment in moments]
        shares = np.mean([np.clip(radius + 0.5 - np.hypot(x - px, y - py), 0, 1) for px, py in places], axis=0)
        hidden = np.zeros(shares.shape, bool) if hidden is None else hidden
        blurred = cv2.GaussianBlur(np.where(hidden, 0.0, shares), (0, 0), 0.7)
        return Patch(np.where(blurred > 0.02, blurred, 0).astype(np.float32), hidden & (blurred < 0.3), (0, 0))

    @staticmethod
    def strip(centre: tuple[float, float], turned_deg: float, from_px: float, half_px: float) -> tuple[np.ndarray, np.ndarray]:
        """A stick that comes out of a ball towards the camera, and its direction."""
        y, x = np.mgrid[:60, :60].astype(float)
        axis = np.array([np.cos(np.radians(turned_deg)), np.sin(np.radians(turned_deg))])
        along, across = (
            (x - centre[0]) * axis[0] + (y - centre[1]) * axis[1],
            (y - centre[1]) * axis[0] - (x - centre[0]) * axis[1],
        )
        return (along > from_px) & (np.abs(across) < half_px), axis

    @pytest.mark.parametrize("turned_deg", [0.0, 50.0, 200.0])
    @pytest.mark.parametrize(("from_px", "half_px", "streak"), [(2.0, 2.0, (0, 0)), (0.0, 2.5, (0, 0)), (3.0, 2.0, (9, -4))])
    def test_centre_behind_a_stick(self, turned_deg: float, from_px: float, half_px: float, streak: tuple[float, float]):
        centre = (30.3, 29.6)
        hidden, axis = self.strip(centre, turned_deg, from_px, half_px)
        patch = self.seen(centre, np.array(streak, dtype=float), hidden)
        assert np.linalg.norm(patch.centre - centre) > 0.4
        disc = disc_in(patch, axis, np.array(streak, dtype=float))
        assert disc is not None
        np.testing.assert_allclose(disc.centre, centre, atol=0.15)
        assert disc.radius_px == pytest.approx(7.0, abs=0.4)
        assert disc.sigma_px > disc_in(self.seen(centre, np.array(streak)), axis, np.array(streak)).sigma_px

    def test_no_disc_where_too_much_is_hidden_or_it_is_no_ball(self):
        centre, still = (30.0, 30.0), np.zeros(2)
        half, axis = self.strip(centre, 0.0, 0.5, 20.0)
        assert disc_in(self.seen(centre, still, half), axis, still) is None
        band = Patch(np.zeros((60, 60), np.float32), np.zeros((60, 60), bool), (0, 0))
        band.shares[27:33, 10:50] = 1.0
        assert disc_in(band, axis, still) is None

    @pytest.mark.parametrize("smaller", [0.5, 1.0])
    def test_what_is_smaller_than_usual_is_partly_hidden(self, smaller: float):
        radii = [7.0] * 12 + [smaller * 7.0] * 3 + [7.0] * 12
        patches = [self.seen((30.0, 30.0), np.zeros(2), radius=radius) for radius in radii]
        discs = discs_of(patches, [np.array([1.0, 0])] * len(radii), np.zeros((len(radii), 2)), 6)
        assert [disc is None for disc in discs] == [radius < 5 for radius in radii]

    def test_balls_in_videos(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
        frames = [picture((30.0 + 8 * k, 60, YELLOW), (30.0 + 8 * k, 150, RED), radius=6.0, blur_px=3.0) for k in range(20)]
        path = written(tmp_path / "a.mp4", frames, 60.0)
        found = detect_video(path, "a", balls=["yellow", "red"])
        assert found.points == ("ball_yellow", "ball_red")
        assert (found.keypoints[..., 2] > 0).mean() > 0.8
        true = np.stack([[(30.0 + 8 * k, 60), (30.0 + 8 * k, 150)] for k in range(20)])
        assert np.nanmedian(np.linalg.norm(found.keypoints[..., :2] - true, axis=-1)) < 0.2
        assert main(["detect", str(path), "--balls", "red", "--tape", "yellow", "--out", str(tmp_path / "out")]) == 2
        assert "two kinds of marks" in capsys.readouterr().err


class TestShaft:
    HANDS, BODY_PX = (100.0, 180.0), 200.0

    def frame(
        self,
        end: tuple[float, float],
        background: np.ndarray,
        colour: tuple[int, int, int] = (40, 40, 45),
        swept_px: float = 0.0,
    ) -> np.ndarray:
        """A body, hands and a shaft whose far end sweeps over some pixels along x during the exposure."""
        mean, steps = np.zeros(background.shape), max(1, int(2 * swept_px))
        for step in range(steps):
            drawn = background.copy()
            tip = end[0] + swept_px * ((step + 0.5) / steps - 0.5), end[1]
            (x0, y0), (x1, y1) = ((round(16 * x), round(16 * y)) for x, y in (self.HANDS, tip))
            cv2.line(drawn, (x0, y0), (x1, y1), colour, 3, cv2.LINE_AA, 4)
            cv2.rectangle(drawn, (60, 150), (98, 239), (90, 60, 50), -1)
            cv2.circle(drawn, (100, 180), 9, (140, 165, 200), -1)
            mean += drawn / steps
        noise = np.random.default_rng(0).normal(0, 2.0, mean.shape)
        return np.clip(mean + noise, 0, 255).astype(np.uint8)

    def found(self, image: np.ndarray, background: np.ndarray) -> np.ndarray:
        return shaft_in(image, background.astype(np.float32), self.HANDS, self.BODY_PX)

    @pytest.mark.parametrize(
        ("end", "swept_px"), [((200.0, 60.0), 0.0), ((90.0, 40.0), 0.0), ((230.0, 190.0), 0.0), ((190.0, 70.0), 8.0)]
    )
    def test_the_end_is_where_the_line_stops(self, end: tuple[float, float], swept_px: float):
        cluttered = EMPTY.copy()
        for k in range(6):
            cv2.line(cluttered, (20 + 40 * k, 10), (140 + 30 * k, 230), (150, 150, 60), 3, cv2.LINE_AA)
        for background in (EMPTY, cluttered):
            shaft = self.found(self.frame(end, background, swept_px=swept_px), background)
            assert shaft[1, 2] > 0.1
            np.testing.assert_allclose(shaft[1, :2], end, atol=3.0)
            assert np.linalg.norm(shaft[0, :2] - self.HANDS) < 2

    def test_no_end_rather_than_a_wrong_one(self):
        alike = EMPTY.copy()
        cv2.rectangle(alike, (150, 20), (319, 120), (40, 40, 45), -1)
        unknown = EMPTY.astype(np.float32)
        unknown[20:120, 150:] = np.nan
        without = self.frame(self.HANDS, EMPTY)
        for image, background in (
            (without, EMPTY),  # no stick
            (self.frame((200.0, 60.0), alike), alike),  # the far part is in front of something of its colour
            (self.frame((200.0, 60.0), EMPTY), unknown),  # the background is not known there
            (self.frame((200.0, 60.0), EMPTY, colour=(104, 100, 96)), EMPTY),  # hardly another colour than the background
            (self.frame((300.0, -40.0), EMPTY), EMPTY),  # it leaves the image
        ):
            assert np.isnan(self.found(image, background)[:, :2]).all()
        thing = self.frame((200.0, 60.0), EMPTY)
        cv2.rectangle(thing, (185, 30), (240, 75), (90, 60, 50), -1)  # a thing that came in hides the end
        assert np.isnan(self.found(thing, EMPTY)[:, :2]).all()

    @pytest.mark.parametrize("reach_px", [16.0, 40.0])
    def test_no_end_where_it_moves_along_the_line_during_the_exposure(self, reach_px: float):
        middle = np.array([180.0, 70.0])
        unit = (middle - self.HANDS) / np.linalg.norm(middle - self.HANDS)
        moments = np.linspace(-0.5, 0.5, 30)
        frames = [self.frame(tuple(middle + reach_px * m * unit), EMPTY).astype(float) for m in moments]
        assert np.isnan(self.found(np.mean(frames, axis=0).astype(np.uint8), EMPTY)[:, :2]).all()

    def test_ends_that_jump_are_left_out(self):
        ends = [np.array([[100.0, 180.0, 0.8], [150.0 + 4 * k, 60.0, 0.8]]) for k in range(12)]
        ends[6] = ends[6] + [[0, 0, 0], [0, 40, 0]]
        track = shaft_track(ends)
        assert np.flatnonzero(np.isnan(track[:, 1, 0])).tolist() == [6]

    def test_in_a_video(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
        tips = [(120.0 + 4 * k, 60.0 + k) for k in range(24)]
        frames = [EMPTY] * 12 + [self.frame(tip, EMPTY) for tip in tips]
        path = written(tmp_path / "a.mp4", frames, 60.0)
        person = np.zeros((len(frames), 17, 3))
        person[12:, :, :] = np.linspace([60, 60, 1], [98, 239, 1], 17)
        person[12:, 9:11, :2] = self.HANDS
        found = detect_video(path, "a", Scripted(person), shaft=True, skeleton="coco-17")
        assert found.points[-2:] == ("shaft_hands", "shaft_end")
        seen = found.keypoints[:, -1, 2] > 0
        assert seen[12:].mean() > 0.5
        assert not seen[:12].any()
        apart = np.linalg.norm(found.keypoints[12:, -1, :2] - tips, axis=-1)[seen[12:]]
        assert apart.max() < 4
        assert main(["detect", str(path), "--shaft", "--out", str(tmp_path / "out")]) == 2
        assert "the hands are not known" in capsys.readouterr().err


class Scripted:
    """A body detector that knows the answers."""

    def __init__(self, keypoints: np.ndarray) -> None:
        self._frames: Iterator[np.ndarray] = iter(keypoints)

    def __call__(self, image: np.ndarray) -> np.ndarray:
        return next(self._frames)


class TestFootage:
    def test_ends_in_rendered_frames_are_where_they_are(self, tmp_path: Path):
        rig = camera_rig("ring", 2, np.random.default_rng(3), Lens(image_size=(640, 480), focal_px=600.0), 4.0)
        motion = Motion(action("kendo"), seed=2)
        markers = Markers(markers_of(motion.action).places_m, ("green", "red"), 0.08, 0.06)
        times = 0.9 + np.arange(24) / 80
        film = CameraFilm(rig, 0, motion, markers, Exposure(1 / 500), seed=1)
        path = tmp_path / "cam1.mp4"
        write_video(path, film.pictures(times), 80.0)
        points = motion.points(times)
        true = rig.project(np.repeat(markers.on(points)[None], 2, axis=0))[0]
        body = rig.project(np.repeat(points[None, :, :19], 2, axis=0))[0]
        person = np.concatenate([np.nan_to_num(body), np.isfinite(body[..., :1]).astype(float)], axis=-1)
        found = detect_video(path, "cam1", Scripted(person), ("green", "red"), "sports-stick-syn")
        assert found.points[-2:] == ("tape_green", "tape_red")
        apart = np.linalg.norm(found.keypoints[:, -2:, :2] - true, axis=-1)
        known = found.keypoints[:, -2:, 2] > 0
        assert known.mean() > 0.25
        assert np.median(apart[known]) < 0.7
        assert apart[known].max() < 5

    def test_without_a_lens_only(self):
        rig = camera_rig("ring", 2, np.random.default_rng(3), Lens(distortion=(-0.1, 0, 0, 0, 0)), 4.0)
        with pytest.raises(CalibrationError, match="distort"):
            CameraFilm(rig, 0, Motion(action("golf")), markers_of(action("golf")), Exposure())


class TestFolder:
    @pytest.fixture
    def videos(self, tmp_path: Path) -> list[Path]:
        paths = []
        for camera, shift in (("left", 0), ("right", 30)):
            frames = [picture((30 + shift + 8 * k, 60, YELLOW), (30 + shift + 8 * k, 150, RED)) for k in range(20)]
            paths.append(written(tmp_path / f"{camera}.mp4", frames, 60.0))
        return paths

    def test_table_is_read_as_keypoints(self, videos: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]):
        out = tmp_path / "found"
        assert main(["detect", *map(str, videos), "--out", str(out), "--tape", "yellow,red"]) == 0
        assert "left: 20 frames, 60.000 Hz" in capsys.readouterr().out
        recording = read_recording(out / "keypoints.csv")
        assert [view.name for view in recording.views] == ["left", "right"]
        view = recording.views[1]
        assert view.point_names is not None
        red = view.keypoints[:, view.point_names.index("tape_red")]
        np.testing.assert_allclose(red[:, 0], 60 + 8.0 * view.frames, atol=0.4)
        content = json.loads((out / "videos.json").read_text())
        assert content["left"]["image_size"] == [320, 240]
        assert content["left"]["points"]["tape_red"] > 0.8
        rows = list(csv.DictReader((out / "keypoints.csv").open()))
        assert float(rows[-1]["time_s"]) == pytest.approx(19 / 60, abs=2e-3)

    def test_finished_videos_are_not_read_again(self, videos: list[Path], tmp_path: Path):
        out = tmp_path / "found"
        detect(videos, out, tapes=("yellow", "red"))
        table = (out / "keypoints.csv").read_bytes()
        (out / "cameras" / "right.csv").unlink()
        seen: list[str] = []
        notes = detect(videos, out, tapes=("yellow", "red"), progress=lambda camera, done, frames: seen.append(camera))
        assert set(seen) == {"right"}
        assert notes[0] == "left: done before."
        assert (out / "keypoints.csv").read_bytes() == table
        seen.clear()
        detect(videos, out, tapes=("red", "yellow"), progress=lambda camera, done, frames: seen.append(camera))
        assert set(seen) == {"left", "right"}

    def test_what_cannot_be_done_is_refused(self, videos: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]):
        out = str(tmp_path / "found")
        twin = tmp_path / "other" / "left.mp4"
        twin.parent.mkdir()
        twin.write_bytes(videos[0].read_bytes())
        for arguments, message in (
            ([str(videos[0])], "nothing to look for"),
            ([str(videos[0]), str(twin), "--tape", "red"], "two videos of one name"),
            ([str(videos[0]), "--tape", "purple"], "unusable colours"),
            ([str(videos[0]), "--weights", str(tmp_path / "none.onnx")], "none.onnx"),
            ([str(tmp_path / "none.mp4"), "--tape", "red"], "none.mp4"),
        ):
            assert main(["detect", *arguments, "--out", out]) == 2
            assert message in capsys.readouterr().err


class TestNetworks:
    @pytest.fixture
    def weights(self, tmp_path: Path) -> Path:
        """A network of the kind of RTMPose whose points are the brightest columns and rows of red and of green."""
        pytest.importorskip("onnxruntime")
        onnx = pytest.importorskip("onnx")
        helper, tensors = onnx.helper, onnx.TensorProto
        nodes, outputs = [], []
        for name, axis, bins in (("x", 2, 96), ("y", 3, 128)):
            nodes += [
                helper.make_node("ReduceMean", ["channels"], [f"mean_{name}"], axes=[axis], keepdims=0),
                helper.make_node("Resize", [f"wide_{name}", "", "scales"], [f"long_{name}"], mode="linear"),
                helper.make_node("Unsqueeze", [f"mean_{name}", "one"], [f"wide_{name}"]),
                helper.make_node("Squeeze", [f"long_{name}", "one"], [f"low_{name}"]),
                helper.make_node("Add", [f"low_{name}", "three"], [f"out_{name}"]),
            ]
            nodes[-4], nodes[-3] = nodes[-3], nodes[-4]
            outputs.append(helper.make_tensor_value_info(f"out_{name}", tensors.FLOAT, [1, 2, bins]))
        nodes.insert(0, helper.make_node("Slice", ["image", "from", "to", "axes"], ["channels"]))
        constants = {"from": [0], "to": [2], "axes": [1], "one": [1]}
        values = [helper.make_tensor(n, tensors.INT64, [1], v) for n, v in constants.items()]
        values.append(helper.make_tensor("three", tensors.FLOAT, [1], [3.0]))
        values.append(helper.make_tensor("scales", tensors.FLOAT, [4], [1.0, 1.0, 1.0, 2.0]))
        image = helper.make_tensor_value_info("image", tensors.FLOAT, [1, 3, 64, 48])
        graph = helper.make_graph(nodes, "tiny", [image], outputs, values)
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
        onnx.save(model, str(tmp_path / "tiny.onnx"))
        return tmp_path / "tiny.onnx"

    def test_keypoints_are_in_pixels_of_the_image(self, weights: Path, tmp_path: Path):
        from torchstickcal.video import SimccModel

        image = np.zeros((240, 320, 3), np.uint8)
        cv2.rectangle(image, (96, 56), (104, 64), (0, 0, 255), -1)
        cv2.rectangle(image, (196, 176), (204, 184), (0, 255, 0), -1)
        model = SimccModel(weights)
        keypoints = model._within(image, (0.0, 0.0, 320.0, 240.0))
        np.testing.assert_allclose(keypoints[:, :2], [[100, 60], [200, 180]], atol=6)
        np.testing.assert_allclose(model._within(image, (60.0, 20.0, 240.0, 220.0))[:, :2], [[100, 60], [200, 180]], atol=4)

    def test_detect_with_a_network(self, weights: Path, tmp_path: Path):
        (tmp_path / "two.toml").write_text('points = ["left_wrist", "right_wrist"]')
        frames = [np.full((240, 320, 3), 150, np.uint8) for _ in range(4)]
        for number, frame in enumerate(frames):
            cv2.circle(frame, (100 + 20 * number, 80), 12, (60, 60, 255), -1)
        video = written(tmp_path / "cam.mp4", frames)
        arguments = ["--weights", str(weights), "--skeleton", str(tmp_path / "two.toml"), "--out", str(tmp_path / "out")]
        assert main(["detect", str(video), *arguments]) == 0
        recording = read_recording(tmp_path / "out" / "keypoints.csv")
        assert recording.point_names is not None
        wrist = recording.views[0].keypoints[:, recording.point_names.index("left_wrist")]
        np.testing.assert_allclose(wrist[0, :2], [100, 80], atol=8)  # then around the points that were found before
        assert np.isfinite(wrist).all()

    def test_another_network_is_refused(self, tmp_path: Path):
        pytest.importorskip("onnxruntime")
        from torchstickcal.video import SimccModel

        (tmp_path / "broken.onnx").write_bytes(b"not a network")
        with pytest.raises(FileFormatError, match="ONNX"):
            SimccModel(tmp_path / "broken.onnx")

    def test_missing_packages_are_named(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
        import sys

        from torchstickcal.video import RtmlibModel, SimccModel

        monkeypatch.setitem(sys.modules, "onnxruntime", None)
        monkeypatch.setitem(sys.modules, "rtmlib", None)
        (tmp_path / "any.onnx").write_bytes(b"")
        for make in (lambda: SimccModel(tmp_path / "any.onnx"), RtmlibModel):
            with pytest.raises(CalibrationError, match=r"torchstickcal\[video\]"):
                make()


class TestCalibratingVideos:
    RIG = camera_rig("ring", 3, np.random.default_rng(5), Lens(image_size=SIZE, focal_px=300.0), 3.0)

    @pytest.fixture
    def arguments(self, tmp_path: Path) -> list[str]:
        """Videos of a stick that is swung, drawn from its true places, and the arguments to calibrate them."""
        phase = np.arange(40) / 3
        start = np.stack([0.5 * np.sin(phase), 0.5 * np.cos(0.7 * phase), 1 + 0.3 * np.sin(1.3 * phase)], axis=-1)
        along = np.stack([np.cos(0.9 * phase), np.sin(1.1 * phase), np.cos(0.6 * phase + 1)], axis=-1)
        along /= np.linalg.norm(along, axis=-1, keepdims=True)
        points = np.stack([start, start + 0.8 * along], axis=1)
        pixels = self.RIG.project(np.repeat(points[None], 3, axis=0))
        videos = []
        for camera, moments in enumerate(pixels):
            pictures = [
                picture((*ends[0], YELLOW), (*ends[1], RED)) if np.isfinite(ends).all() else picture() for ends in moments
            ]
            videos.append(str(written(tmp_path / f"cam{camera}.mp4", pictures, 40.0)))
        lenses = [RigCamera(f"cam{n}", matrix, image_size=SIZE) for n, matrix in enumerate(self.RIG.intrinsics)]
        write_camera_toml(tmp_path / "lenses.toml", Rig.of(lenses))
        stick = ["--stick", "tape_yellow", "tape_red", "0.8"]
        return [*videos, "--tape", "yellow,red", *stick, "--intrinsics", str(tmp_path / "lenses.toml")]

    def test_videos_are_calibrated_in_one_command(
        self, arguments: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ):
        out, folder = tmp_path / "results", tmp_path / "results-keypoints"
        command = ["calibrate", *arguments, "--out", str(out)]
        assert main(command) in (0, 3)
        assert "note: cam2: 40 frames" in capsys.readouterr().err
        found = Calibration.load(out / "points.npz")
        assert found.fps == pytest.approx(40, rel=1e-3)
        truth = torch.from_numpy(self.RIG.rotations), torch.from_numpy(self.RIG.translations)
        assert pose_errors(found.rotations, found.translations, *truth).mean_translation_m < 0.05
        assert main(command) in (0, 3)
        assert "cam0: done before" in capsys.readouterr().err

        recording = read_recording(folder)
        assert [view.image_size for view in recording.views] == [SIZE] * 3
        about = json.loads((folder / "videos.json").read_text())
        about["cam1"]["fps"] = 50.0
        (folder / "videos.json").write_text(json.dumps(about))
        recording = read_recording(folder)
        assert recording.fps is None
        assert "different frame rates: 40, 50, 40 Hz" in recording.notes[0]

    def test_what_cannot_be_meant_is_refused(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
        (tmp_path / "cam1.mp4").write_bytes(b"")
        (tmp_path / "keypoints.csv").write_text("camera,frame,point,x,y\n")
        for arguments, message in (
            (["cam1.mp4"], "nothing to look for"),
            (["cam1.mp4", "keypoints.csv", "--tape", "red"], "Give videos alone|--tape out"),
            (["keypoints.csv", "--tape", "red"], "Leave --tape out"),
        ):
            given = [str(tmp_path / word) if "." in word else word for word in arguments]
            assert main(["calibrate", *given, "--out", str(tmp_path / "results")]) == 2
            assert re.search(message, capsys.readouterr().err)
