"""How right the calibration is on the errors of detectors: outliers, exchanged labels, other people, and errors that stay.

    python examples/benchmark_detections.py --sessions 30 --jobs 2

All sessions are simulated. The bound is the mean error of the best unbiased estimate that knows which keypoints are outliers.
Where detectors err alike in many frames, it knows how these errors are distributed, and not what they are. The error over the
covariance is 1 where the stated deviations are right.
"""

from __future__ import annotations

import argparse
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from statistics_of_the_calibration import deviation, true_poses
from torch import Tensor

from torchstickcal import CalibrationError, ObservationError, calibrate
from torchstickcal.benchmark.bound import Bound, camera_bound, expected_errors
from torchstickcal.benchmark.cases import Case
from torchstickcal.geometry import se3
from torchstickcal.geometry.cameras import Intrinsics
from torchstickcal.metrics import pose_errors
from torchstickcal.simulate import Lens, SessionSpec
from torchstickcal.simulate.regimes import DetectorNoise, Flips, Gaps, Outliers, Regime, SelfOcclusion, SwappedEnds, Views
from torchstickcal.simulate.skeleton import JOINT_INDEX

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

    def basis(self, points: NDArray[np.float64], centres: NDArray[np.float64]) -> NDArray[np.float64]:
        """Functions (C, F, m) of which the offsets are sums with random factors, in units of their standard deviation.

        Args:
            points: (F, P, 3), metres. centres: of the cameras, (C, 3), metres.
        """
        return np.ones((len(centres), len(points), 1))

    def __call__(self, views: Views, rng: np.random.Generator) -> Views:
        basis = self.basis(views.points[0], views.rig.centres)
        factors = self.sigma_px * rng.standard_normal((len(basis), basis.shape[2], *views.keypoints.shape[2:]))
        factors[:, :, -2:] = 0
        return replace(views, keypoints=views.keypoints + np.einsum("cfm,cmpk->cfpk", basis, factors))


@dataclass(frozen=True)
class BySide(Constant):
    """The same with an offset that depends on the side from which the camera sees the athlete: a Fourier series."""

    order: int = 2

    def basis(self, points: NDArray[np.float64], centres: NDArray[np.float64]) -> NDArray[np.float64]:
        across = (points[:, JOINT_INDEX["right_shoulder"]] - points[:, JOINT_INDEX["left_shoulder"]])[:, :2]
        towards = (centres[:, None] - points[:, JOINT_INDEX["pelvis"]])[..., :2]
        side = np.arctan2(towards[..., 1], towards[..., 0]) - np.arctan2(across[:, 1], across[:, 0])
        waves = [wave(number * side) for number in range(1, self.order + 1) for wave in (np.cos, np.sin)]
        return np.stack([np.ones_like(side), *(np.sqrt(2) * wave for wave in waves)], axis=-1) / np.sqrt(1 + len(waves))


class Row(NamedTuple):
    """Sessions of one kind."""

    cameras: int
    frames: int
    regimes: tuple[Regime, ...]
    path: str = "circle"
    laps: float = 0.25

    @property
    def bias(self) -> Constant | None:
        """The errors that stay."""
        return next((regime for regime in self.regimes if isinstance(regime, Constant)), None)


DETECTOR = (DetectorNoise(2.5, 1.5), SelfOcclusion())
STAYING = (DetectorNoise(3, 1.5),)
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
    **{f"errors that stay, {px} px": Row(4, 100, (*STAYING, Constant(px)), "stay") for px in (2, 4, 6)},
    **{f"the same {px} px, 2 cameras": Row(2, 100, (*STAYING, Constant(px)), "stay") for px in (2, 4, 6)},
    **{f"errors by the side that is seen, {px} px": Row(4, 200, (*STAYING, BySide(px)), laps=1.0) for px in (2, 4, 6)},
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
        laps=row.laps,
        regimes=row.regimes,
    )
    try:
        given = spec.generate()
    except ObservationError:  # no two cameras see both ends of the stick
        return Outcome(float("nan"), float("nan"), float("nan"))
    case = Case(given.name, given.observations, given.truth, sigma_px=given.sigma_px, inliers=given.inliers)
    bound = camera_bound(case, draws=300) if row.bias is None else bound_with_bias(case, row.bias)
    bound_m = float("nan") if bound is None or bound.translation_m > LARGEST_BOUND_M else bound.translation_m
    try:
        found = calibrate(given.observations)
    except CalibrationError:
        return Outcome(float("nan"), bound_m, float("nan"))
    errors = pose_errors(found.rotations, found.translations, given.truth.rotations, given.truth.translations)
    tangents = deviation(found, true_poses(given))
    squared = float(tangents @ torch.linalg.solve(found.covariance, tangents)) / len(tangents)
    return Outcome(errors.mean_translation_m, bound_m, squared)


def bound_with_bias(case: Case, bias: Constant) -> Bound | None:
    """The bound where the joints have offsets of known distribution: they are unknowns with a prior, and eliminated."""
    truth = case.truth
    assert truth.points is not None
    assert truth.intrinsics is not None
    assert case.inliers is not None
    assert case.sigma_px is not None
    rotations, points = truth.rotations[:, None], truth.points.double()
    lenses = Intrinsics(truth.intrinsics.double(), None if truth.distortion is None else truth.distortion.double())
    in_cameras = points[None] @ rotations.mT + truth.translations[:, None, None]
    step = 1e-5
    by_axis = [
        (lenses.project(in_cameras + step * axis) - lenses.project(in_cameras - step * axis)) / (2 * step)
        for axis in rotations[:, :, None].unbind(-1)
    ]
    seen = case.observations.visible & torch.from_numpy(case.inliers)
    weights = seen / torch.from_numpy(case.sigma_px).clamp_min(1e-6)
    by_points = weights[..., None, None] * torch.stack(by_axis, dim=-1)
    tangents = torch.cat([torch.eye(3, dtype=torch.float64).expand(*points.shape, 3), -se3.hat(points)], dim=-1)
    cameras = len(weights)
    own = torch.zeros(cameras, *by_points.shape[1:4], cameras, 6, dtype=torch.float64)
    for camera in range(1, cameras):
        own[camera, ..., camera, :] = by_points[camera] @ tangents
    by_cameras = own[..., 1:, :].flatten(-2)

    def rows(values: Tensor, point: int) -> Tensor:  # (F, 2 C, ...)
        return values[:, :, point].movedim(0, 1).flatten(1, 2)

    def eliminating(by_point: Tensor) -> Tensor:
        information = by_point.mT @ by_point + 1e-6 * torch.eye(by_point.shape[-1], dtype=torch.float64)
        return torch.eye(by_point.shape[1]).double() - by_point @ torch.linalg.solve(information, by_point.mT)

    ends = [int(end) for end in case.observations.sticks[0].ends]
    along = torch.nn.functional.normalize(points[:, ends[1]] - points[:, ends[0]], dim=-1)[:, None] / 1e-5
    stick = torch.stack([torch.block_diag(a, b) for a, b in zip(*(rows(by_points, end) for end in ends), strict=True)])
    stick = torch.cat([stick, torch.cat([-along, along], dim=-1)], dim=1)
    of_stick = torch.cat([rows(by_cameras, end) for end in ends], dim=1)
    of_stick = torch.nn.functional.pad(of_stick, (0, 0, 0, 1))
    information = (of_stick.mT @ eliminating(stick) @ of_stick).sum(0)
    centres = se3.camera_centres(truth.rotations, truth.translations)
    basis = torch.from_numpy(bias.basis(points.numpy(), centres.numpy())).movedim(0, 1)
    for point in set(range(points.shape[1])) - set(ends):
        left = eliminating(rows(by_points, point))
        offsets = (rows(weights[..., None].expand(*weights.shape, 2), point)[..., None] * basis.repeat_interleave(2, 1))[
            :, :, None
        ]
        offsets = (offsets * torch.eye(2 * cameras)[None, :, :, None].double()).flatten(2)
        own = rows(by_cameras, point)
        coupled = (offsets.mT @ left @ own).sum(0)
        known = (offsets.mT @ left @ offsets).sum(0) + torch.eye(offsets.shape[-1]).double() / bias.sigma_px**2
        information += (own.mT @ left @ own).sum(0) - coupled.mT @ torch.linalg.solve(known, coupled)
    return expected_errors(information, truth, draws=300)


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
