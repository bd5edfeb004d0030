"""From pixels to the swing: rendered videos, marked ends of the stick found in them, calibrated, analysed, against the truth.

    python examples/from_video_to_swing.py --sessions 4 --seconds 1.2 --fps 120

Four cameras of 1280 x 720 film an athlete whose stick carries two coloured balls, or two pieces of tape with --tape: with
motion blur, noise, and a cluttered background that has things of their colours too. The videos are written with OpenCV and
read again. The body is drawn
without a face or clothes, which no pose network knows: body keypoints are the true ones with errors of 3 px. The same session
is also calibrated with the true places of the marks, with independent errors of the same median: ideal ends.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from torchstickcal import Calibration, Observations, Stick, calibrate
from torchstickcal.analysis import analyse
from torchstickcal.io import Given, load_session
from torchstickcal.metrics import pose_errors
from torchstickcal.simulate import Lens, Motion, action
from torchstickcal.simulate.footage import CameraFilm, Exposure, Markers, markers_of, write_video
from torchstickcal.simulate.rigs import CameraRig, camera_rig
from torchstickcal.simulate.skeleton import JOINTS
from torchstickcal.video import detect

Array = NDArray[np.float64]

SPORTS = ("golf", "baseball", "hockey", "kendo")
BEGIN_S = {"golf": 1.1, "baseball": 1.0, "hockey": 1.85, "kendo": 0.85}
"""When the fast part of the swing begins"""
CAMERAS, SIZE = 4, (1280, 720)
BALL_M = 0.065
"""Diameter of a tennis ball"""
WRONG_PX = 5.0
MEDIAN_OVER_SIGMA = 1.1774
"""Of the length of an error whose parts along x and y are normally distributed"""


class KnownBody:
    """In the place of a pose network: the true keypoints with errors, frame after frame."""

    def __init__(self, keypoints: Array) -> None:
        self._frames: Iterator[Array] = iter(keypoints)

    def __call__(self, image: object) -> Array:
        return next(self._frames)


@dataclass(frozen=True, eq=False)
class Recorded:
    """A session on disk, and its truth."""

    rig: CameraRig
    markers: Markers
    times: Array
    points: Array
    """(F, 21, 3): joints and the centres of both marks"""
    body: Array
    """(C, F, 19, 3), keypoints of the joints with errors"""
    speeds: Array
    """(F, 2), of the marks, metres per second"""


def record(folder: Path, sport: str, seed: int, seconds: float, fps: float, exposure_s: float, balls: bool = True) -> Recorded:
    """Render and write a video for each camera."""
    rng = np.random.default_rng(seed)
    rig = camera_rig("ring", CAMERAS, rng, Lens(image_size=SIZE), 4.5)
    motion, markers = Motion(action(sport), seed=seed), markers_of(action(sport))
    if balls:
        markers = replace(markers, balls=True, diameter_m=BALL_M)
    times = BEGIN_S[sport] + np.arange(round(seconds * fps)) / fps
    for camera in range(CAMERAS):
        film = CameraFilm(rig, camera, motion, markers, Exposure(exposure_s), seed)
        write_video(folder / f"cam{camera + 1}.mp4", film.pictures(times), fps)
    points = motion.points(times)
    tape = markers.on(points)
    later, before = (markers.on(motion.points(times + shift)) for shift in (1e-4, -1e-4))
    points = np.concatenate([points[:, : len(JOINTS)], tape], axis=1)
    pixels = rig.project(np.repeat(points[None, :, : len(JOINTS)], CAMERAS, axis=0))
    pixels = pixels + 3.0 * rng.standard_normal(pixels.shape)
    body = np.concatenate([pixels, np.ones_like(pixels[..., :1])], axis=-1)
    return Recorded(rig, markers, times, points, body, np.linalg.norm(later - before, axis=-1) / 2e-4)


def found_in_videos(folder: Path, session: Recorded) -> Observations:
    """The keypoints that are found in the videos, as the reader takes them from the table."""
    bodies = iter(session.body)
    videos = sorted(folder.glob("*.mp4"))
    colours = session.markers.colours
    kind, tapes, balls = ("ball", (), colours) if session.markers.balls else ("tape", colours, ())
    found = folder / "found"
    notes = detect(videos, found, lambda: KnownBody(next(bodies)), tapes=tapes, balls=balls, skeleton="sports-stick-syn")
    print("\n".join(notes))
    first, second = (f"{kind}_{colour}" for colour in colours)
    stick = Stick(first, second, session.markers.apart_m)
    fps = 1 / float(np.median(np.diff(session.times)))
    loaded = load_session(found / "keypoints.csv", given=Given(stick, image_size=SIZE, fps=fps)).observations
    names = (*JOINTS, first, second)
    assert loaded.point_names is not None
    order = [loaded.point_names.index(name) for name in names]
    return Observations(
        loaded.keypoints[:, :, order],
        session.rig.intrinsics,
        stick,
        confidence=None if loaded.confidence is None else loaded.confidence[:, :, order],
        image_size=SIZE,
        fps=fps,
        point_names=names,
        camera_names=loaded.camera_names,
    )


def ideal_ends(session: Recorded, found: Observations, sigma_px: float, seed: int) -> Observations:
    """The same body keypoints, with the true ends wherever one was found, and independent errors."""
    keypoints = found.keypoints.double().clone()
    exact = session.rig.project(np.repeat(session.points[None, :, -2:], CAMERAS, axis=0))
    true = torch.from_numpy(exact + sigma_px * np.random.default_rng(seed).standard_normal(exact.shape))
    keypoints[:, :, -2:] = true.where(keypoints[:, :, -2:].isfinite(), torch.nan)
    return Observations(
        keypoints,
        session.rig.intrinsics,
        Stick(len(JOINTS), len(JOINTS) + 1, session.markers.apart_m),
        confidence=found.confidence,
        image_size=SIZE,
        fps=found.fps,
        point_names=found.point_names,
        camera_names=found.camera_names,
    )


def centre_error_mm(calibration: Calibration, rig: CameraRig) -> float:
    errors = pose_errors(
        calibration.rotations, calibration.translations, torch.from_numpy(rig.rotations), torch.from_numpy(rig.translations)
    )
    return 1000 * float(errors.mean_translation_m)


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("--sessions", type=int, default=1, help="number of sessions (default: 1)")
    arguments.add_argument("--first", type=int, default=0, help="number of the first session (default: 0)")
    arguments.add_argument("--seconds", type=float, default=0.5, help="of each session (default: 0.5)")
    arguments.add_argument("--fps", type=float, default=60.0, help="frames per second (default: 60)")
    arguments.add_argument("--exposure", type=float, default=0.001, help="of each frame, seconds (default: 0.001)")
    arguments.add_argument("--tape", action="store_true", help="two pieces of tape instead of two balls")
    options = arguments.parse_args()
    torch.set_num_threads(1)
    errors, fast_errors, wrong, seen, ratios = [], [], 0, 0, []
    for number in range(options.first, options.first + options.sessions):
        sport = SPORTS[number % len(SPORTS)]
        with tempfile.TemporaryDirectory() as temporary:
            folder = Path(temporary)
            session = record(folder, sport, 300 + number, options.seconds, options.fps, options.exposure, not options.tape)
            found = found_in_videos(folder, session)
        true = session.rig.project(np.repeat(session.points[None, :, -2:], CAMERAS, axis=0))
        apart = np.linalg.norm(found.keypoints[:, :, -2:].double().numpy() - true, axis=-1)
        known = np.isfinite(found.keypoints[:, :, -2:].numpy()).all(-1)
        far = known & ~(apart <= WRONG_PX)
        streak = session.speeds[None] * options.exposure * session.rig.intrinsics[0, 0, 0] / 4.5
        good = known & ~far
        fast = good & (session.speeds[None] > 0.7 * session.speeds.max())
        errors.append(apart[good])
        fast_errors.append(apart[fast])
        wrong, seen = wrong + int(far.sum()), seen + int(known.sum())
        sigma_px = float(np.median(apart[good])) / MEDIAN_OVER_SIGMA
        calibration, ideal = calibrate(found), calibrate(ideal_ends(session, found, sigma_px, number))
        mm, ideal_mm = centre_error_mm(calibration, session.rig), centre_error_mm(ideal, session.rig)
        ratios.append((mm, ideal_mm))
        speed = analyse(calibration, sport).curves["tip_speed"]
        fastest = int(session.speeds[:, 1].argmax())
        print(
            f"{number} {sport}: ends in {100 * known.mean():.0f} % of images, median {np.median(apart[good]):.2f} px "
            f"({np.median(apart[fast]) if fast.any() else 0:.2f} px if fast), {far.sum()} of {known.sum()} wrong, "
            f"fastest {session.speeds.max():.1f} m/s ({streak.max():.0f} px of blur); cameras {mm:.1f} mm, "
            f"with ideal ends {ideal_mm:.1f} mm; speed found {speed.values[fastest]:.1f} +- {speed.std[fastest]:.1f} m/s",
            flush=True,
        )
    mean, ideal_mean = np.sqrt(np.square(ratios).mean(0))
    print(
        f"\n{options.sessions} sessions: median error {np.median(np.concatenate(errors)):.2f} px, where fastest "
        f"{np.median(np.concatenate(fast_errors)):.2f} px; wrong ends {wrong} of {seen} ({100 * wrong / seen:.2f} %); cameras "
        f"{mean:.1f} mm, with ideal ends {ideal_mean:.1f} mm ({mean / ideal_mean:.2f} times)"
    )


if __name__ == "__main__":
    main()
