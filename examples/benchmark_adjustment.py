"""Measure the time of bundle adjustment, and compare it with other programs on the same problem.

    python examples/benchmark_adjustment.py                    # 8 cameras, 50 frames: a few seconds
    python examples/benchmark_adjustment.py --frames 1000 6000 --cameras 8 --runs 5

Every program gets the same keypoints, starts from the same values with the same noise, and stops when an iteration decreases
the cost by less than 1e-6 of it. The table shows the cost that it reached. Programs that are not installed are skipped, and
named: ``pip install pycolmap gtsam scipy``. Times are medians over the runs, of the adjustment alone, without the time to set
up the problem.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import platform
import statistics
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchstickcal import Extrinsics, Intrinsics
from torchstickcal.geometry import se3
from torchstickcal.losses import Loss, ReprojectionLoss, SmoothnessLoss, StickLengthLoss
from torchstickcal.model.measurements import Measurements
from torchstickcal.model.objective import Objective
from torchstickcal.model.state import State
from torchstickcal.model.unknowns import RigUnknowns
from torchstickcal.solvers import Termination, gauss_newton
from torchstickcal.workers import on_worker

COST_TOLERANCE = 1e-6
FOCAL_PX, WIDTH, HEIGHT = 1400.0, 1920, 1080

Array = NDArray[np.float64]


class Problem(NamedTuple):
    """Keypoints of a simulated scene, and initial values near the truth."""

    pixels: Tensor
    """(C, 2, N)"""
    cameras: Intrinsics
    frames: int
    rotations: Tensor
    translations: Tensor
    points: Tensor
    """(3, N); the last two of a frame are the ends of a stick of 1 m"""


class Timing(NamedTuple):
    """Seconds, and the sum of squared reprojection residuals reached, in square pixels."""

    seconds: float
    cost: float


def simulated(cameras: int, frames: int, points: int) -> Problem:
    """A ring of cameras around points that move randomly; the last two are the ends of a stick of 1 m; noise of 1 px."""
    rng = np.random.default_rng(0)
    angles = 2 * np.pi * np.arange(cameras) / cameras
    centres = np.stack([4.5 * np.cos(angles), 4.5 * np.sin(angles), 1.5 + 0.5 * (np.arange(cameras) % 3)], axis=1)
    rotations = np.stack([_looking_at(centre, np.array([0.0, 0.0, 1.0])) for centre in centres])
    translations = -(rotations @ centres[..., None])[..., 0]
    structure = rng.normal(0, 0.35, (1, points, 3)) + rng.normal(0, 0.01, (frames, points, 3)).cumsum(0) * 0.3 + [0, 0, 1]
    stick = structure[:, -1] - structure[:, -2]
    structure[:, -1] = structure[:, -2] + stick / np.linalg.norm(stick, axis=1, keepdims=True)
    matrix = torch.tensor([[FOCAL_PX, 0, WIDTH / 2], [0, FOCAL_PX, HEIGHT / 2], [0, 0, 1]], dtype=torch.float64)
    lenses = Intrinsics(matrix.expand(cameras, 3, 3))
    points_m = torch.from_numpy(structure.reshape(-1, 3).T.copy())
    poses = torch.from_numpy(rotations)[None], torch.from_numpy(translations)[None]
    pixels = lenses.project(se3.moved(*poses, points_m[None])[0].movedim(1, -1)).movedim(-1, 1)
    pixels = (pixels + torch.from_numpy(rng.normal(0, 1, pixels.shape))).contiguous()
    tangents = torch.from_numpy(rng.normal(0, 0.003, (cameras - 1, 6)))
    shifts = torch.from_numpy(rng.normal(0, 0.01, points_m.shape))
    start = State.of(*poses, points_m[None]).retracted(tangents[None], shifts[None])
    return Problem(pixels, lenses, frames, start.rotations[0], start.translations[0], start.points[0])


def ours(problem: Problem, losses: dict[str, Loss]) -> Timing:
    """This project's Gauss-Newton; the cost is that of the reprojection."""
    points_per_frame = problem.pixels.shape[2] // problem.frames
    cameras, one = problem.cameras.batched(), torch.ones(1, 1, dtype=torch.float64)
    measurements = Measurements(
        pixels=problem.pixels[None],
        confidence=torch.ones_like(problem.pixels[None, :, 0]),
        cameras=cameras,
        frames=problem.frames,
        sticks=torch.tensor([[points_per_frame - 2, points_per_frame - 1]]),
        lengths_m=one,
        stick_sigma_m=0.001 * one[0],
        unknowns=RigUnknowns.of((), cameras),
    )
    start = State.of(problem.rotations[None], problem.translations[None], problem.points[None])
    objective = Objective(measurements, losses)
    began = time.perf_counter()
    outcome = on_worker(
        start.points.device,
        gauss_newton,
        objective,
        start,
        cameras_free=True,
        termination=Termination(cost_tolerance=COST_TOLERANCE, camera_tolerance=0.0),
        stage="",
        listener=lambda record: None,
    )
    return Timing(time.perf_counter() - began, outcome.iterations[0][-1].terms["reprojection"])


def ceres(problem: Problem) -> Timing:
    """COLMAP's bundle adjuster on Ceres, two threads."""
    import pycolmap

    scene = pycolmap.Reconstruction()
    pixels = problem.pixels.movedim(1, -1).numpy()
    cameras, _, columns = problem.pixels.shape
    for index in range(cameras):
        parameters = [FOCAL_PX, FOCAL_PX, WIDTH / 2, HEIGHT / 2]
        camera = pycolmap.Camera(camera_id=index + 1, model="PINHOLE", width=WIDTH, height=HEIGHT, params=parameters)
        scene.add_camera_with_trivial_rig(camera)
        pose = pycolmap.Rigid3d(np.hstack([problem.rotations[index].numpy(), problem.translations[index].numpy()[:, None]]))
        image = pycolmap.Image(name=str(index), keypoints=pixels[index], camera_id=index + 1, image_id=index + 1)
        scene.add_image_with_trivial_frame(image, pose)
    for column, point in enumerate(problem.points.numpy().T):
        track = pycolmap.Track([pycolmap.TrackElement(index + 1, column) for index in range(cameras)])
        scene.add_point3D(point, track)
    config = pycolmap.BundleAdjustmentConfig()
    for index in range(cameras):
        config.add_image(index + 1)
        config.set_constant_cam_intrinsics(index + 1)
    config.set_constant_rig_from_world_pose(1)
    options = pycolmap.BundleAdjustmentOptions(print_summary=False, refine_sensor_from_rig=False)
    options.ceres.solver_options.num_threads = 2
    options.ceres.solver_options.function_tolerance = COST_TOLERANCE
    adjuster = pycolmap.create_default_bundle_adjuster(options, config, scene)
    began = time.perf_counter()
    adjuster.solve()
    seconds = time.perf_counter() - began
    poses = [scene.images[index + 1].cam_from_world().matrix() for index in range(cameras)]
    points = np.stack([scene.points3D[index + 1].xyz for index in range(columns)], axis=1)
    return Timing(seconds, _cost(problem, np.stack(poses), points))


def gtsam_lm(problem: Problem) -> Timing:
    """GTSAM's Levenberg-Marquardt on projection factors."""
    import gtsam

    noise, exact = gtsam.noiseModel.Isotropic.Sigma(2, 1.0), gtsam.noiseModel.Constrained.All(6)
    lens = gtsam.Cal3_S2(FOCAL_PX, FOCAL_PX, 0.0, WIDTH / 2, HEIGHT / 2)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    cameras, _, columns = problem.pixels.shape
    pixels = problem.pixels.numpy()
    for index in range(cameras):
        rotation, translation = problem.rotations[index].numpy(), problem.translations[index].numpy()
        pose = gtsam.Pose3(gtsam.Rot3(rotation.T), -rotation.T @ translation)
        values.insert(gtsam.symbol("x", index), pose)
        if index == 0:
            graph.add(gtsam.PriorFactorPose3(gtsam.symbol("x", 0), pose, exact))
        for column in range(columns):
            keys = gtsam.symbol("x", index), gtsam.symbol("l", column)
            graph.add(gtsam.GenericProjectionFactorCal3_S2(pixels[index, :, column], noise, *keys, lens))
    for column, point in enumerate(problem.points.numpy().T):
        values.insert(gtsam.symbol("l", column), point)
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(COST_TOLERANCE)
    parameters.setAbsoluteErrorTol(0.0)
    optimiser = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters)
    began = time.perf_counter()
    optimiser.optimize()
    return Timing(time.perf_counter() - began, 2 * optimiser.error())


def scipy_trf(problem: Problem) -> Timing:
    """scipy's least_squares with an analytic, sparse Jacobian."""
    from scipy.optimize import least_squares
    from scipy.sparse import csr_matrix

    cameras, _, columns = problem.pixels.shape
    free = 6 * (cameras - 1)
    extrinsics = Extrinsics(problem.rotations, problem.translations)
    residual_rows = np.arange(cameras * columns * 2).reshape(cameras, columns, 2, 1)
    camera_unknowns = 6 * np.arange(cameras - 1)[:, None, None, None] + np.arange(6)
    point_unknowns = free + 3 * np.arange(columns)[:, None, None] + np.arange(3)
    by_camera_at = np.broadcast_arrays(residual_rows[1:], camera_unknowns)
    by_point_at = np.broadcast_arrays(residual_rows, point_unknowns)
    row_index, column_index = (
        np.concatenate([cam.ravel(), pt.ravel()]) for cam, pt in zip(by_camera_at, by_point_at, strict=True)
    )

    def state(x: Array) -> tuple[Tensor, Tensor, Tensor]:
        rotations, translations = extrinsics.compose(torch.from_numpy(x[:free]).view(-1, 6))
        rotations = torch.cat([problem.rotations[:1], rotations])
        translations = torch.cat([problem.translations[:1], translations])
        return rotations, translations, torch.from_numpy(x[free:]).view(-1, 3).mT

    def residuals(x: Array) -> Array:
        return (_projected(problem, *state(x)) - problem.pixels.movedim(1, -1)).numpy().ravel()

    def jacobian(x: Array) -> csr_matrix:
        rotations, translations, points = state(x)
        px, py, pz = se3.moved(rotations[None], translations[None], points[None])[0].unbind(1)
        rows = torch.zeros(cameras, columns, 2, 3, dtype=torch.float64)
        rows[..., 0, 0], rows[..., 0, 2] = FOCAL_PX / pz, -FOCAL_PX * px / pz**2
        rows[..., 1, 1], rows[..., 1, 2] = FOCAL_PX / pz, -FOCAL_PX * py / pz**2
        tangents = torch.from_numpy(x[:free]).view(-1, 6)
        by_tangent = torch.autograd.functional.jacobian(extrinsics.compose, tangents)
        turned, shifted = (torch.stack([d[c, ..., c, :] for c in range(cameras - 1)]) for d in by_tangent)
        moved = torch.einsum("cijk,jn->cnik", turned, points) + shifted[:, None]
        data = [(rows[1:] @ moved).numpy().ravel(), (rows @ rotations[:, None]).numpy().ravel()]
        shape = residual_rows.size, free + 3 * columns
        return csr_matrix((np.concatenate(data), (row_index, column_index)), shape=shape)

    x = np.concatenate([np.zeros(free), problem.points.mT.reshape(-1).numpy()])
    began = time.perf_counter()
    with torch.no_grad():
        options: dict[str, Any] = {"x_scale": "jac", "ftol": COST_TOLERANCE, "xtol": None, "gtol": None}
        found = least_squares(residuals, x, jacobian, **options)  # pyright: ignore[reportArgumentType]
    return Timing(time.perf_counter() - began, 2 * float(found.cost))


REPROJECTION: dict[str, Loss] = {"reprojection": ReprojectionLoss()}
LENGTH: dict[str, Loss] = REPROJECTION | {"stick_length": StickLengthLoss(0.001)}
SMOOTHNESS: dict[str, Loss] = LENGTH | {"smoothness": SmoothnessLoss(0.05)}

ADJUSTERS: dict[str, tuple[str | None, Callable[[Problem], Timing]]] = {
    "torchstickcal": (None, lambda problem: ours(problem, REPROJECTION)),
    "torchstickcal + length": (None, lambda problem: ours(problem, LENGTH)),
    "torchstickcal + length + smoothness": (None, lambda problem: ours(problem, SMOOTHNESS)),
    "COLMAP (Ceres, 2 threads)": ("pycolmap", ceres),
    "GTSAM": ("gtsam", gtsam_lm),
    "scipy least_squares": ("scipy", scipy_trf),
}
SLOW_PROGRAMS = {"GTSAM": 50_000, "scipy least_squares": 50_000}
"""Largest number of keypoints with which these slow programs are run."""


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cameras", type=int, nargs="+", default=[8])
    parser.add_argument("--frames", type=int, nargs="+", default=[50])
    parser.add_argument("--points", type=int, default=21)
    parser.add_argument("--runs", type=int, default=3)
    options = parser.parse_args()
    threads = torch.get_num_threads()
    print(
        f"{platform.machine()}, {os.cpu_count()} cores, torch {torch.__version__} on {threads} threads, {options.runs} runs\n"
    )
    print(f"{'cameras':>7} {'frames':>7} {'keypoints':>10}  {'adjuster':36} {'median s':>9} {'ratio':>7}  cost per keypoint")
    for cameras in options.cameras:
        for frames in options.frames:
            _compare(cameras, frames, options.points, options.runs)


def _compare(cameras: int, frames: int, points: int, runs: int) -> None:
    problem = simulated(cameras, frames, points)
    keypoints = cameras * frames * points
    ours(problem, REPROJECTION)
    own: float | None = None
    for name, (module, adjust) in ADJUSTERS.items():
        label = f"{cameras:7d} {frames:7d} {keypoints:10d}  {name:36}"
        if module is not None and importlib.util.find_spec(module) is None:
            print(f"{label} not installed: {module}")
            continue
        if keypoints > SLOW_PROGRAMS.get(name, keypoints):
            print(f"{label} skipped: too slow for this number of keypoints")
            continue
        timings = [adjust(problem) for _ in range(runs)]
        seconds = statistics.median(timing.seconds for timing in timings)
        own = own or seconds
        print(f"{label} {seconds:9.4f} {seconds / own:6.1f}x  {timings[0].cost / keypoints:.7f}", flush=True)


def _projected(problem: Problem, rotations: Tensor, translations: Tensor, points: Tensor) -> Tensor:
    """Pixels (C, N, 2)."""
    return problem.cameras.project(se3.moved(rotations[None], translations[None], points[None])[0].movedim(1, -1))


def _cost(problem: Problem, poses: Array, points: Array) -> float:
    arrays = (poses[:, :, :3], poses[:, :, 3], points)
    projected = _projected(problem, *(torch.from_numpy(array.copy()) for array in arrays))
    return float((projected - problem.pixels.movedim(1, -1)).square().sum())


def _looking_at(centre: Array, target: Array) -> Array:
    forward = (target - centre) / np.linalg.norm(target - centre)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward])


if __name__ == "__main__":
    main()
