"""Are the reported standard deviations right, and is the calibration as accurate as possible? Statistics of simulated sessions.

    python examples/statistics_of_the_calibration.py                 # 2 runs of each: a few seconds
    python examples/statistics_of_the_calibration.py --runs 500      # the tables of docs/uncertainty.md

Each run simulates another motion and another random part of the rig, with keypoint noise of 1 px and, in half of the rows,
outliers of up to 150 px along each axis. The tables have means over the runs with their standard errors.

First table: are the standard deviations right? The normalised squared error is the squared error divided by the reported
variance, per degree of freedom. It is 1 if the reported variance is right. It is printed for all cameras together, for new
points that the calibrated cameras triangulate, and for the points of the session. "Inside 95 %" is the share of the true values
inside the reported 95 % region: ellipsoid of all cameras, ellipsoid of each new point, interval of each coordinate of a new
point by ``predict_std``.

A run has failed if more than half of the keypoints of a camera were set aside. Failed runs are counted and left out.

Second table: is the calibration as accurate as possible? The mean squared error of the camera centres and rotations, in the
first camera's frame, is divided by the Cramér-Rao bound of a method that knows the inliers, their noise and the stick's length
exactly. "Corrected for chance" is the same with less scatter: the best linear estimate, which attains the bound, is computed
from the same keypoints, and the difference between its squared error and the bound is subtracted.
"""

from __future__ import annotations

import argparse
import zlib
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from torchstickcal import Calibration, Observations, calibrate
from torchstickcal.config import InitialiseSettings
from torchstickcal.geometry import se3
from torchstickcal.losses import Loss, ReprojectionLoss, StickLengthLoss
from torchstickcal.metrics import rotation_angle
from torchstickcal.model.measurements import Measurements
from torchstickcal.model.objective import Objective
from torchstickcal.model.state import State
from torchstickcal.pipeline.initialise import triangulated
from torchstickcal.simulate import Noise, SessionSpec, SimulatedSession
from torchstickcal.solvers.elimination.normal_equations import NormalEquations
from torchstickcal.solvers.newton import polish
from torchstickcal.solvers.uncertainty import centre_covariances, point_covariances

SIGMA_PX = 1.0
EXACT_M = 1e-5
RIGS = (
    SessionSpec("golf, hemisphere", "golf", cameras=3, frames=40, fps=20.0),
    SessionSpec("hockey, ring", "hockey", cameras=5, frames=40, fps=20.0, layout="ring"),
    SessionSpec("baseball, arena", "baseball", cameras=8, frames=40, fps=20.0, layout="arena"),
)
NEW_POINTS, NEW_RADIUS_M, SCENE_CENTRE = 50, 0.9, (0.0, 0.0, 0.9)
INTERVAL_95 = 1.959964


class Poses(NamedTuple):
    """World to camera, (C, 3, 3) and (C, 3), the first camera being the world."""

    rotations: Tensor
    translations: Tensor


class Squared(NamedTuple):
    """Summed squared errors of the cameras."""

    centres_m2: float
    rotations_rad2: float


class Run(NamedTuple):
    """What one run contributes: means over its cameras or points, and sums of squares."""

    failed: bool
    cameras: float
    cameras_inside: float
    points: float
    points_inside: float
    coordinates_inside: float
    own_points: float
    found: Squared
    best: Squared
    """of the best linear estimate, which attains the bound"""
    bound: Squared


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=2)
    parser.add_argument("--outliers", type=float, nargs="+", default=[0.0, 0.1], help="shares of outliers, 0 to 1")
    parser.add_argument("--stick-sigma-m", type=float, default=0.001, help="standard deviation of the length")
    options = parser.parse_args()
    config = _with_stick_sigma(options.stick_sigma_m)
    consistency, efficiency = [], []
    for share in options.outliers:
        for rig in RIGS:
            spec = replace(rig, regimes=(Noise(SIGMA_PX, outliers=share),))
            every = [one_run(replace(spec, seed=seed), config) for seed in range(options.runs)]
            runs = [run for run in every if not run.failed]
            label = f"| {rig.cameras} | {rig.name} | {100 * share:.0f} % | {len(every)} | {len(every) - len(runs)} | "
            consistency.append(label + _consistency(runs))
            efficiency.append(label + _efficiency(runs))
    first = "| cameras | sport, layout | outliers | runs | failed | "
    print(
        f"{first}cameras: normalised squared error | cameras inside 95 % | new points: normalised squared error "
        "| new points inside 95 % | new coordinates inside 95 % | session's points: normalised squared error |"
    )
    print("|---" * 11 + "|")
    print("\n".join(consistency))
    print(f"\n{first}centres: error / bound | corrected for chance | rotations: error / bound | corrected for chance |")
    print("|---" * 9 + "|")
    print("\n".join(efficiency))


def one_run(spec: SessionSpec, config: dict[str, object]) -> Run:
    """Simulate, calibrate, compare with the truth."""
    session = spec.generate()
    calibration = calibrate(session.observations, config)
    truth = true_poses(session)
    error = deviation(calibration, truth)
    squared = float(error @ torch.linalg.solve(calibration.covariance, error))
    points, coordinates = errors_of_new_points(calibration, session, truth)
    own = (calibration.points - true_points(session)).square().sum(-1) / calibration.points_std_m.square()
    best, covariance = best_estimate(session, truth)
    centres = se3.camera_centres(*truth)
    return Run(
        failed=bool((calibration.inliers.sum((1, 2)) < session.observations.visible.sum((1, 2)) / 2).any()),
        cameras=squared / len(error),
        cameras_inside=float(squared < chi_square_quantile(0.95, len(error))),
        points=float(points.mean()) / 3,
        points_inside=float((points < chi_square_quantile(0.95, 3)).double().mean()),
        coordinates_inside=float((coordinates.abs() < INTERVAL_95).double().mean()),
        own_points=float(own.nanmean()),
        found=squared_errors(Poses(calibration.rotations, calibration.translations), truth),
        best=squared_errors(best, truth),
        bound=Squared(
            float(centre_covariances(centres, covariance).diagonal(dim1=1, dim2=2).sum()),
            float(covariance.diagonal().view(-1, 6)[:, 3:].sum()),
        ),
    )


def true_poses(session: SimulatedSession) -> Poses:
    """The true poses in the first camera's frame."""
    truth = session.truth
    rotations = truth.rotations @ truth.rotations[0].mT
    return Poses(rotations, truth.translations - rotations @ truth.translations[0])


def true_points(session: SimulatedSession) -> Tensor:
    """The true points (F, P, 3) in the first camera's frame."""
    truth = session.truth
    assert truth.points is not None
    return truth.points @ truth.rotations[0].mT + truth.translations[0]


def deviation(calibration: Calibration, truth: Poses) -> Tensor:
    """Tangents (6 (C - 1),) that lead from the estimated poses to the true ones, to first order."""
    back = calibration.rotations.mT
    rotation = se3.vee(back @ truth.rotations)
    shift = (back @ (truth.translations - calibration.translations)[..., None])[..., 0]
    return torch.cat([shift, rotation], dim=1)[1:].flatten()


def squared_errors(poses: Poses, truth: Poses) -> Squared:
    """Of centres and rotation angles, in the first camera's frame."""
    centres = se3.camera_centres(*poses) - se3.camera_centres(*truth)
    angles = rotation_angle(poses.rotations @ truth.rotations.mT)
    return Squared(float(centres.square().sum()), float(angles.square().sum()))


def errors_of_new_points(calibration: Calibration, session: SimulatedSession, truth: Poses) -> tuple[Tensor, Tensor]:
    """Errors of new points: squared and divided by the covariance (N,), and by coordinate over ``predict_std`` (N, 3)."""
    generator = torch.Generator().manual_seed(zlib.crc32(session.observations.keypoints.numpy().tobytes()))
    direction = torch.nn.functional.normalize(torch.randn(NEW_POINTS, 3, generator=generator, dtype=torch.float64), dim=1)
    distance = NEW_RADIUS_M * torch.rand(NEW_POINTS, 1, generator=generator, dtype=torch.float64) ** (1 / 3)
    world = torch.tensor(SCENE_CENTRE, dtype=torch.float64) + distance * direction
    points = world @ session.truth.rotations[0].mT + session.truth.translations[0]
    lenses = session.observations.cameras
    seen = lenses.project((truth.rotations @ points.mT + truth.translations[..., None]).mT)
    keypoints = seen + SIGMA_PX * torch.randn(seen.shape, generator=generator, dtype=torch.float64)
    poses = Poses(calibration.rotations, calibration.translations)
    found = triangulated_by_least_squares(keypoints, poses, session.observations)
    sigma_px = calibration.sigma_px.median().expand(NEW_POINTS)
    visible = torch.ones(len(keypoints), NEW_POINTS, dtype=torch.bool)
    covariances = point_covariances(found, visible, sigma_px, poses, lenses, calibration.covariance)
    error = points - found
    squared = (error[:, None] @ torch.linalg.solve(covariances, error[..., None]))[:, 0, 0]
    return squared, error / calibration.predict_std(found)


def triangulated_by_least_squares(keypoints: Tensor, poses: Poses, observations: Observations) -> Tensor:
    """Points (N, 3) of keypoints (C, N, 2) by least squares in the image, with fixed cameras."""
    measurements = Measurements.of(Observations(keypoints[:, :, None], observations.intrinsics, []))
    rotations, translations = poses.rotations[None], poses.translations[None]
    start = State.of(rotations, translations, triangulated(measurements, rotations, translations, InitialiseSettings()))
    return polish(Objective(measurements, {"reprojection": ReprojectionLoss()}), start, cameras_free=False).points[0].mT


def best_estimate(session: SimulatedSession, truth: Poses) -> tuple[Poses, Tensor]:
    """The linear estimate at the truth from the inliers, and its covariance: the least of any unbiased estimate's."""
    points = true_points(session).flatten(0, 1).mT.contiguous()
    state = State.of(truth.rotations[None], truth.translations[None], points[None])
    measurements = Measurements.of(session.observations).keeping(torch.from_numpy(session.inliers).flatten(1)[None])
    losses: dict[str, Loss] = {"reprojection": ReprojectionLoss(SIGMA_PX), "stick_length": StickLengthLoss(EXACT_M)}
    system = NormalEquations(Objective(measurements, losses), state, cameras_free=True)
    step = system.step()
    found = state.retracted(step.cameras, step.points)
    return Poses(found.rotations[0], found.translations[0]), torch.linalg.inv(system.reduced[0])


def chi_square_quantile(probability: float, freedom: int) -> float:
    """Where the chi-square distribution function reaches a probability, by bisection of the incomplete gamma function.

    The tables have 7.815, 21.026, 36.415 and 58.124 for 0.95 and 3, 12, 24 and 42 degrees of freedom.
    """
    low, high = 0.0, 10.0 * freedom + 100.0
    half = torch.tensor(freedom / 2, dtype=torch.float64)
    for _ in range(60):
        middle = (low + high) / 2
        below = float(torch.special.gammainc(half, half.new_tensor(middle / 2))) < probability
        low, high = (middle, high) if below else (low, middle)
    return (low + high) / 2


def _with_stick_sigma(sigma_m: float) -> dict[str, object]:
    stages = ("metric", "refined", "trajectories")
    return {"extends": "default", "stages": {stage: {"stick_length": {"sigma_m": sigma_m}} for stage in stages}}


def _consistency(runs: Sequence[Run]) -> str:
    columns = torch.tensor([run[1:7] for run in runs], dtype=torch.float64).mT
    shares = (False, True, False, True, True, False)
    return " | ".join(_mean(values, share) for values, share in zip(columns, shares, strict=True)) + " |"


def _efficiency(runs: Sequence[Run]) -> str:
    found, best, bound = (torch.tensor([run[column] for run in runs], dtype=torch.float64).mT for column in (7, 8, 9))
    pairs = [(_ratio(f, c), _ratio(f - b + c, c)) for f, b, c in zip(found, best, bound, strict=True)]
    return " | ".join(text for pair in pairs for text in pair) + " |"


def _mean(values: Tensor, share: bool) -> str:
    mean, error = float(values.mean()), float(values.std()) / len(values) ** 0.5
    return f"{100 * mean:.1f} ± {100 * error:.1f} %" if share else f"{mean:.3f} ± {error:.3f}"


def _ratio(found: Tensor, bound: Tensor) -> str:
    """The ratio of the means and its standard error."""
    ratio = found.mean() / bound.mean()
    return f"{ratio:.3f} ± {float((found - ratio * bound).std() / bound.mean()) / len(found) ** 0.5:.3f}"


if __name__ == "__main__":
    main()
