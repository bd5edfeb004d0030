"""How right the calibration is on the errors of detectors: outliers, exchanged labels, other people, and errors that stay.

    python examples/benchmark_detections.py --sessions 30 --jobs 2

All sessions are simulated. The bound is the mean error of the best unbiased estimate that knows which keypoints are outliers,
and nothing of errors that stay. The error over the covariance is 1 where the stated deviations are right.
"""

from __future__ import annotations

import argparse
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from statistics_of_the_calibration import deviation, true_poses

from torchstickcal import CalibrationError, ObservationError, calibrate
from torchstickcal.benchmark.bound import camera_bound
from torchstickcal.benchmark.cases import Case
from torchstickcal.metrics import pose_errors
from torchstickcal.simulate import Lens, SessionSpec
from torchstickcal.simulate.regimes import DetectorNoise, Flips, Gaps, Outliers, Regime, SelfOcclusion, SwappedEnds, Views

SPORTS, LAYOUTS = ("golf", "baseball", "hockey", "kendo"), ("ring", "hemisphere", "random", "arena")
LARGEST_BOUND_M = 0.1
"""Where the bound is larger, the stick is hardly seen: such sessions are left out."""
LENS = Lens(distortion=(-0.1, 0.02, 0.0005, -0.0005, 0.0))


@dataclass(frozen=True)
class Shifted:
    """A share of the keypoints is wrong by a normal distribution."""

    share: float
    sigma_px: float = 60.0

    def __call__(self, views: Views, rng: np.random.Generator) -> Views:
        hit = rng.random(views.inliers.shape) < self.share
        shift = self.sigma_px * rng.standard_normal(views.keypoints.shape)
        return replace(views, keypoints=views.keypoints + hit[..., None] * shift, inliers=views.inliers & ~hit)


@dataclass(frozen=True)
class Anywhere:
    """A share of the keypoints is anywhere in the image."""

    share: float

    def __call__(self, views: Views, rng: np.random.Generator) -> Views:
        hit = rng.random(views.inliers.shape) < self.share
        elsewhere = rng.uniform(0, 1, views.keypoints.shape) * np.array(LENS.image_size)
        seen = np.isfinite(views.keypoints)
        return replace(
            views, keypoints=np.where(hit[..., None] & seen, elsewhere, views.keypoints), inliers=views.inliers & ~hit
        )


@dataclass(frozen=True)
class HeavyTails:
    """Errors of Student's distribution."""

    degrees_of_freedom: float = 1.5
    scale_px: float = 1.5

    def __call__(self, views: Views, rng: np.random.Generator) -> Views:
        errors = self.scale_px * rng.standard_t(self.degrees_of_freedom, views.keypoints.shape)
        return replace(
            views, keypoints=views.keypoints + errors, sigma_px=np.full(views.inliers.shape, self.scale_px, dtype=float)
        )


@dataclass(frozen=True)
class OtherPerson:
    """Two cameras show somebody else, who does the same 12 frames later, in a share of their frames."""

    share: float

    def __call__(self, views: Views, rng: np.random.Generator) -> Views:
        keypoints, inliers = views.keypoints.copy(), views.inliers.copy()
        for camera in range(2):
            hit = rng.random(keypoints.shape[1]) < self.share
            keypoints[camera, hit] = (np.roll(views.keypoints[camera], 12, axis=0) + np.array([180.0, 10.0]))[hit]
            inliers[camera, hit] = False
        return replace(views, keypoints=keypoints, inliers=inliers)


@dataclass(frozen=True)
class Constant:
    """Each camera sees each joint, but no end of the stick, with an offset that stays."""

    sigma_px: float

    def __call__(self, views: Views, rng: np.random.Generator) -> Views:
        cameras, _, points, axes = views.keypoints.shape
        offsets = self.sigma_px * rng.standard_normal((cameras, 1, points, axes))
        offsets[:, :, -2:] = 0
        return replace(views, keypoints=views.keypoints + offsets)


class Row(NamedTuple):
    """Sessions of one kind."""

    cameras: int
    frames: int
    regimes: tuple[Regime, ...]
    path: str = "circle"


DETECTOR = (DetectorNoise(2.5, 1.5), SelfOcclusion())
HARD = (*DETECTOR, Flips(0.1), SwappedEnds(0.03), Outliers(0.15), Gaps(0.1, mean_frames=4))
ROWS = {
    "noise and occlusion": Row(4, 60, DETECTOR),
    "15 % outliers, 10 % flips, 3 % swapped ends": Row(3, 60, HARD),
    "the same, 2 cameras": Row(2, 120, HARD),
    "20 % wrong by N(0, 60 px)": Row(3, 60, (*DETECTOR, Shifted(0.2))),
    "30 % wrong by N(0, 60 px)": Row(3, 60, (*DETECTOR, Shifted(0.3))),
    "30 % anywhere in the image": Row(3, 60, (*DETECTOR, Anywhere(0.3))),
    "40 % wrong by N(0, 60 px), 6 cameras": Row(6, 60, (*DETECTOR, Shifted(0.4))),
    "50 % anywhere in the image, 6 cameras": Row(6, 60, (*DETECTOR, Anywhere(0.5))),
    "30 % flips, 30 % swapped ends, 20 % N(0, 60 px)": Row(4, 80, (*DETECTOR, Flips(0.3), SwappedEnds(0.3), Shifted(0.2))),
    "another person in 20 % of the frames of 2 cameras": Row(3, 100, (*DETECTOR, OtherPerson(0.2))),
    "Student's t, 1.5 degrees of freedom": Row(4, 100, (HeavyTails(),)),
    "errors that stay, 2 px": Row(4, 100, (DetectorNoise(3, 1.5), Constant(2)), "stay"),
    "errors that stay, 4 px": Row(4, 100, (DetectorNoise(3, 1.5), Constant(4)), "stay"),
    "errors that stay, 6 px": Row(4, 100, (DetectorNoise(3, 1.5), Constant(6)), "stay"),
}


class Outcome(NamedTuple):
    """Of one session; NaN where it was refused, and a bound of NaN where it determines too little."""

    error_m: float
    bound_m: float
    squared: float
    """mean squared error of the tangents over their covariance"""


def outcome(number: int, name: str, seed: int) -> Outcome:
    """Simulate and calibrate a session of a row."""
    torch.set_num_threads(1)
    row = ROWS[name]
    spec = SessionSpec(
        f"session{number}",
        SPORTS[number % 4],
        seed=seed + 1000 * list(ROWS).index(name) + number,
        cameras=row.cameras,
        frames=row.frames,
        layout=LAYOUTS[number // 4 % 4],
        lens=LENS,
        radius_m=4.5,
        path=row.path,
        regimes=row.regimes,
    )
    try:
        given = spec.generate()
    except ObservationError:  # no two cameras see both ends of the stick
        return Outcome(float("nan"), float("nan"), float("nan"))
    case = Case(given.name, given.observations, given.truth, sigma_px=given.sigma_px, inliers=given.inliers)
    bound = camera_bound(case, draws=300)
    bound_m = float("nan") if bound is None or bound.translation_m > LARGEST_BOUND_M else bound.translation_m
    try:
        found = calibrate(given.observations)
    except CalibrationError:
        return Outcome(float("nan"), bound_m, float("nan"))
    errors = pose_errors(found.rotations, found.translations, given.truth.rotations, given.truth.translations)
    tangents = deviation(found, true_poses(given))
    squared = float(tangents @ torch.linalg.solve(found.covariance, tangents)) / len(tangents)
    return Outcome(errors.mean_translation_m, bound_m, squared)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--sessions", type=int, default=1, metavar="N", help="of each row")
    parser.add_argument("--rows", type=int, default=1, metavar="N", help="the first N rows; 0 for all")
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="processes")
    parser.add_argument("--seed", type=int, default=970_000)
    options = parser.parse_args()
    print("| sessions | cameras x frames | bound | mean error | median | within 3 x bound | error / covariance: median, mean |")
    print("|---|---|---|---|---|---|---|")
    with ProcessPoolExecutor(options.jobs) as pool:
        for name, row in list(ROWS.items())[: options.rows or None]:
            found = np.array(list(pool.map(partial(outcome, name=name, seed=options.seed), range(options.sessions))))
            found = found[np.isfinite(found[:, 1])]
            error, bound, squared = found.T
            print(
                f"| {name} | {row.cameras} x {row.frames} | {1000 * np.nanmean(bound):.1f} mm "
                f"| {1000 * np.nanmean(error):.1f} mm "
                f"| {1000 * np.nanmedian(error):.1f} mm | {int((error <= 3 * bound).sum())} of {len(found)} "
                f"| {np.nanmedian(squared):.2f}, {np.nanmean(squared):.3g} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
