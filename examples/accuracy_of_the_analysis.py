"""How accurate the analysis of swings is: simulated sessions, whose truth is known.

    python examples/accuracy_of_the_analysis.py --sessions 20 --fps 240

Each session is one swing of golf, baseball, hockey or kendo in turn, seen by four cameras, with independent errors of the
keypoints. Three things are compared with the truth:

- the analysis of the calibrated session;
- the analysis of the same keypoints with the true cameras: what the keypoints' own noise does;
- exact keypoints with the calibrated cameras: what the calibration alone does.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from torchstickcal import Calibration, Observations, Stick, calibrate
from torchstickcal.analysis import ANGLES, EVENTS, Analysis, analyse
from torchstickcal.analysis.angles import missing_points, with_derived
from torchstickcal.analysis.phases import SPORTS, events_of, swing_peaks
from torchstickcal.analysis.stick import StickMotion
from torchstickcal.analysis.tracks import tracks_of
from torchstickcal.geometry.cameras import Intrinsics
from torchstickcal.simulate import Lens, SessionSpec
from torchstickcal.simulate.rigs import camera_rig
from torchstickcal.simulate.skeleton import JOINTS

Array = NDArray[np.float64]

DENSE_HZ, TINY_S = 2000.0, 1e-4
LENS = Lens(distortion=(-0.1, 0.02, 0.0005, -0.0005, 0.0))
SWINGS = ("golf", "baseball", "hockey", "kendo")


@dataclass(frozen=True, eq=False)
class Scene:
    """A swing in the frame of the first camera, and its keypoints."""

    spec: SessionSpec
    observations: Observations
    rotations: Array
    translations: Array

    @property
    def times(self) -> Array:
        return np.arange(self.spec.frames) / self.spec.fps

    def points(self, times: Array) -> Array:
        """Joints, hips and ends of the stick, (T, 23, 3), metres, in the frame of the first camera."""
        return in_world(self.spec, times) @ self.rotations[0].T + self.translations[0]


def in_world(spec: SessionSpec, times: Array) -> Array:
    points, hips = spec.motion.points(times), spec.motion.hips(times)
    return np.concatenate([points[:, : len(JOINTS)], hips, points[:, len(JOINTS) :]], axis=1)


def scene(sport: str, seed: int, fps: float, sigma_px: float, stick_sigma_px: float, seconds: float | None = None) -> Scene:
    frames = round((seconds or spec_seconds(sport)) * fps)
    spec = SessionSpec(sport, sport, seed=seed, cameras=4, frames=frames, fps=fps, layout="ring", path="circle")
    rng = np.random.default_rng(seed)
    rig = camera_rig("ring", 4, rng, LENS, 4.5)
    points = in_world(spec, np.arange(frames) / fps)
    sigma = np.full(points.shape[1], sigma_px)
    sigma[-2:] = stick_sigma_px
    exact = rig.project(np.repeat(points[None], 4, axis=0))
    action = spec.motion.action
    observations = Observations(
        exact + sigma[:, None] * rng.standard_normal(exact.shape),
        rig.intrinsics,
        Stick(len(JOINTS) + 2, len(JOINTS) + 3, action.stick_m),
        distortion=rig.distortion,
        image_size=rig.image_size,
        fps=fps,
        point_names=[*JOINTS, "left_hip", "right_hip", *action.stick_names],
    )
    rotations = rig.rotations @ rig.rotations[0].T
    translations = rig.translations - (rotations @ rig.translations[0][:, None])[..., 0]
    found = Scene(spec, observations, rig.rotations, rig.translations)
    assert np.allclose(rotations[0], np.eye(3))
    assert np.allclose(translations[0], 0)
    return found


def spec_seconds(sport: str) -> float:
    return 3.0 if sport in ("golf", "hockey") else 2.6


def with_true_cameras(calibration: Calibration, truth: Scene) -> Calibration:
    """The same keypoints, with cameras that have no errors."""
    rotations = truth.rotations @ truth.rotations[0].T
    translations = truth.translations - (rotations @ truth.translations[0][:, None])[..., 0]
    return with_keypoints(
        replace(
            calibration,
            rotations=torch.from_numpy(rotations),
            translations=torch.from_numpy(translations),
            covariance=torch.zeros_like(calibration.covariance),
        ),
        truth.points(truth.times),
        truth.observations.keypoints.double().numpy(),
    )


def with_keypoints(calibration: Calibration, points: Array, keypoints: Array) -> Calibration:
    """A calibration of points near the true ones, with keypoints (C, F, P, 2)."""
    return replace(
        calibration,
        points=torch.from_numpy(points),
        residuals_px=torch.from_numpy(projected(calibration, points) - keypoints),
    )


def projected(calibration: Calibration, points: Array) -> Array:
    """Pixels (C, F, P, 2) of points (F, P, 3)."""
    flat = torch.from_numpy(points).flatten(0, 1)
    moved = flat @ calibration.rotations.mT + calibration.translations[:, None]
    cameras = Intrinsics(calibration.intrinsics, calibration.distortion, calibration.fisheye)
    return cameras.project(moved).unflatten(1, points.shape[:2]).numpy()


def all_angles(names: tuple[str, ...], points: Array, up: Array) -> dict[str, Array]:
    derived = with_derived(names, points, up)
    return {name: angle.of(derived) for name, angle in ANGLES.items() if not missing_points(angle, derived)}


def apart(first: Array, second: Array | float) -> Array:
    """Differences of angles, -180 to 180 degrees."""
    return (first - second + 180.0) % 360.0 - 180.0


def true_events(truth: Scene, up: Array) -> tuple[Array, float, Array]:
    """Times of the events by the same rules, largest speed of the tip, and speeds of the tip at the frames."""
    times = np.arange(0.0, truth.times[-1], 1 / DENSE_HZ)
    points, later, before = (truth.points(times + shift) for shift in (0.0, TINY_S, -TINY_S))
    velocity = (later - before)[:, -2:] / (2 * TINY_S)
    along = points[:, -1] - points[:, -2]
    length = np.linalg.norm(along, axis=-1, keepdims=True)
    rate = np.linalg.norm(np.cross(along / length, (velocity[:, 1] - velocity[:, 0]) / length), axis=-1)
    motion = StickMotion(points[None, :, -2], points[None, :, -1], velocity[None, :, 0], velocity[None, :, 1], rate[None])
    peak = swing_peaks(times, rate)[0]
    events = events_of(times, motion, peak, SPORTS[truth.spec.sport], up)
    speed = motion.tip_speed[0]
    return events, float(speed[(times >= events[1]) & (times <= events[3])].max()), speed


def measured(sport: str, seed: int, fps: float, sigma_px: float, stick_sigma_px: float) -> dict[str, Array]:
    """Errors of one session, and their ratios to the stated standard deviations."""
    truth = scene(sport, seed, fps, sigma_px, stick_sigma_px)
    calibration = calibrate(truth.observations)
    found = analyse(calibration, sport)
    noise_alone = analyse(with_true_cameras(calibration, truth), sport, draws=2)
    up = truth.rotations[0] @ [0.0, 0.0, 1.0]
    events, peak_speed, _ = true_events(truth, up)
    names = calibration.point_names or ()
    true = all_angles(names, truth.points(truth.times), up)
    errors = {
        "angles (deg)": pooled(found, true),
        "angles, keypoints' noise alone (deg)": pooled(noise_alone, true),
        "angles, difference of both (deg)": pooled(found, {name: noise_alone.curves[name].values for name in true}),
        "angles / stated": pooled(found, true, by_std=True),
    }
    if found.swings:
        swing = max(found.swings, key=lambda swing: swing.figures["peak_tip_speed"].value)
        figure = swing.figures["peak_tip_speed"]
        errors["peak tip speed (%)"] = np.array([100 * (figure.value / peak_speed - 1)])
        errors["peak tip speed / stated"] = np.array([(figure.value - peak_speed) / figure.std])
        for event, true_s in zip(EVENTS, events, strict=True):
            estimate = swing.events[event]
            errors[f"{event} (frames)"] = np.array([(estimate.value - true_s) * fps])
            errors[f"{event} / stated"] = np.array([(estimate.value - true_s) / estimate.std])
        tempo, true_tempo = swing.figures["tempo"], (events[1] - events[0]) / (events[2] - events[1])
        errors["tempo / stated"] = np.array([(tempo.value - true_tempo) / tempo.std])
    return errors | calibration_alone(calibration, truth, up)


def calibration_alone(calibration: Calibration, truth: Scene, up: Array) -> dict[str, Array]:
    """Errors of angles and of the tip's velocity for exact keypoints."""
    cameras = with_true_cameras(calibration, truth)

    def seen(shift_s: float) -> Array:
        points = truth.points(truth.times + shift_s)
        return tracks_of(with_keypoints(calibration, points, projected(cameras, points))).points

    estimate = tracks_of(calibration)
    assert estimate.up is not None
    names = calibration.point_names or ()
    true = all_angles(names, truth.points(truth.times), up)
    found = all_angles(names, seen(0.0), estimate.up)
    later, before = seen(TINY_S)[:, -1], seen(-TINY_S)[:, -1]
    true_later, true_before = truth.points(truth.times + TINY_S)[:, -1], truth.points(truth.times - TINY_S)[:, -1]
    speed = np.linalg.norm(later - before, axis=-1)
    true_speed = np.linalg.norm(true_later - true_before, axis=-1)
    fast = true_speed > 0.5 * true_speed.max()
    angles = [apart(found[name], true[name]) for name in true if not name.endswith("_turn")]
    return {
        "angles, calibration alone (deg)": np.concatenate(angles),
        "tip speed, calibration alone (%)": 100 * (speed / true_speed - 1)[fast],
    }


def pooled(found: Analysis, true: dict[str, Array], by_std: bool = False) -> Array:
    """Errors of all angles in all frames; turns are compared from where the estimate is 0."""
    errors = []
    for name, values in true.items():
        error = apart(found.curves[name].values, values)
        if ANGLES[name].turns:
            error = apart(error, error[np.nanargmin(np.abs(found.curves[name].values))])
        if name.endswith("_shoulder_plane"):  # without a meaning where the arm hangs down
            error = np.where(np.abs(found.curves[name].std) < 10, error, np.nan)
        errors.append(error / found.curves[name].std if by_std else error)
    return np.concatenate(errors)


def rms(values: Array) -> float:
    return float(np.sqrt(np.nanmean(np.square(values))))


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("--sessions", type=int, default=1, help="number of sessions (default: 1)")
    arguments.add_argument("--first", type=int, default=0, help="number of the first session (default: 0)")
    arguments.add_argument("--fps", type=float, default=60.0, help="frames per second (default: 60)")
    arguments.add_argument("--sigma", type=float, default=3.0, help="noise of the joints' keypoints, pixels (default: 3)")
    arguments.add_argument("--stick-sigma", type=float, default=3.0, help="noise of the stick's ends, pixels (default: 3)")
    options = arguments.parse_args()
    torch.set_num_threads(1)
    collected: dict[str, list[Array]] = defaultdict(list)
    for number in range(options.first, options.first + options.sessions):
        sport = SWINGS[number % len(SWINGS)]
        errors = measured(sport, 100 + number, options.fps, options.sigma, options.stick_sigma)
        for name, values in errors.items():
            collected[name].append(values)
        shown = ", ".join(f"{name} {rms(values):.3g}" for name, values in errors.items() if "frames" in name or "speed" in name)
        print(f"{number} {sport}: {shown}", flush=True)
    print(f"\n{options.sessions} sessions, {options.fps:g} Hz, noise {options.sigma:g} px, stick {options.stick_sigma:g} px")
    print(f"{'':40}{'RMS':>8}{'median':>8}{'95 %':>8}")
    for name, parts in collected.items():
        values = np.concatenate(parts)
        size = np.abs(values[np.isfinite(values)])
        if not len(size):
            continue
        within = f"  within 1 frame: {100 * (size <= 1).sum() / len(values):.0f} %" if "frames" in name else ""
        print(f"{name:40}{rms(values):8.3f}{np.median(size):8.3f}{np.percentile(size, 95):8.3f}{within}")


if __name__ == "__main__":
    main()
