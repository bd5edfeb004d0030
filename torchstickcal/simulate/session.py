"""A simulated session: from its specification to observations, truth, and what a benchmark wants to know besides."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path as FilePath
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from torchstickcal.errors import FileFormatError
from torchstickcal.io.session import Truth, read_npz, write_npz
from torchstickcal.observations import Observations, Stick
from torchstickcal.simulate.clocks import Clocks, exposed_points
from torchstickcal.simulate.cube import Cube, CubeViews
from torchstickcal.simulate.motions import Motion, action
from torchstickcal.simulate.paths import Path
from torchstickcal.simulate.regimes import Regime, Views, apply
from torchstickcal.simulate.rigs import CameraRig, Lens, camera_rig
from torchstickcal.simulate.skeleton import JOINTS, STANDING_HEIGHT_M, Skeleton

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Assumptions:
    """What is told about lenses and stick, as far as it is wrong.

    Args:
        focal_scale: given over true focal length, of all cameras.
        focal_spread: standard deviation of a further such factor of each camera.
        centre_px: standard deviation of the given principal points along each axis.
        lens_known: whether the distortion is given.
        stick_scale: given over true length of the stick.
    """

    focal_scale: float = 1.0
    focal_spread: float = 0.0
    centre_px: float = 0.0
    lens_known: bool = True
    stick_scale: float = 1.0

    def intrinsics(self, rig: CameraRig, rng: np.random.Generator) -> tuple[Array, Array | None]:
        """Camera matrices (C, 3, 3) and distortion (C, 5) as they are told."""
        told = rig.intrinsics.copy()
        told[:, [0, 1], [0, 1]] *= (self.focal_scale * (1 + self.focal_spread * rng.standard_normal(len(told))))[:, None]
        told[:, :2, 2] += self.centre_px * rng.standard_normal((len(told), 2))
        return told, rig.distortion if self.lens_known else None


@dataclass(frozen=True, eq=False)
class SimulatedSession:
    """What the cameras observed, the truth, and how the keypoints came about."""

    name: str
    observations: Observations
    truth: Truth
    inliers: NDArray[np.bool_]
    """(C, F, P), False where a keypoint was drawn with a gross error"""
    sigma_px: Array
    """(C, F, P), standard deviation along each axis that a keypoint was drawn with"""
    cube: CubeViews | None
    height_m: float
    """of the athlete, standing"""
    fps: float


@dataclass(frozen=True)
class SessionSpec:
    """Everything that makes a session; the same specification generates the same bytes.

    Args:
        name: of the session. sport: one of the actions. seed: of everything random.
        cameras: their number. layout, lens, radius_m: as :func:`~torchstickcal.simulate.rigs.camera_rig` takes them.
        frames, fps: of camera 0, whose frame times are the common clock.
        path, path_m: its shape and radius. laps: how far the athlete goes around it after each action.
        tempo, variation: of the action. height_m: of the athlete.
        regimes: what goes wrong with the keypoints, one after another.
        clocks: what is wrong with the cameras' times. assumptions: what is wrong with what is known.
        cube: a calibration object that the cameras saw too.
    """

    name: str
    sport: str
    seed: int = 0
    cameras: int = 6
    frames: int = 240
    fps: float = 60.0
    layout: str = "hemisphere"
    lens: Lens = field(default_factory=Lens)
    radius_m: float = 4.0
    path: str = "stay"
    path_m: float = 0.5
    laps: float = 0.25
    tempo: float = 1.0
    variation: float = 1.0
    height_m: float = STANDING_HEIGHT_M
    regimes: tuple[Regime, ...] = ()
    clocks: Clocks = field(default_factory=Clocks)
    assumptions: Assumptions = field(default_factory=Assumptions)
    cube: Cube | None = None

    @property
    def motion(self) -> Motion:
        """The athlete's motion."""
        done = action(self.sport)
        path = Path(self.path, self.path_m)
        return Motion(done, Skeleton(self.height_m), path, self.laps, self.tempo, self.variation, self.seed)

    def generate(self) -> SimulatedSession:
        """The session.

        Raises:
            CalibrationError: for an unknown sport, path or layout, or an impossible number of cameras or height.
            ObservationError: if so little is left of the keypoints that the stick is never seen by two cameras.
        """
        rng_rig, rng_clocks, rng_told, rng_keypoints, rng_cube = np.random.default_rng(self.seed).spawn(5)
        motion = self.motion
        rig = camera_rig(self.layout, self.cameras, rng_rig, self.lens, self.radius_m)
        times = np.arange(self.frames) / self.fps
        offsets = self.clocks.offsets(self.cameras, rng_clocks)
        seen_at = exposed_points(motion, rig, times + offsets[:, None], self.clocks.readout_s)
        shape = seen_at.shape[:3]
        views = Views(rig, seen_at, rig.project(seen_at), np.ones(shape, dtype=bool), np.zeros(shape))
        views = apply(self.regimes, views, rng_keypoints)
        views = views.hiding(~rig.contains(views.keypoints))

        told, told_distortion = self.assumptions.intrinsics(rig, rng_told)
        stick = Stick(len(JOINTS), len(JOINTS) + 1, motion.action.stick_m * self.assumptions.stick_scale)
        observations = Observations(
            views.keypoints,
            told,
            stick,
            distortion=told_distortion,
            confidence=views.confidence,
            image_size=rig.image_size,
            fps=self.fps,
            point_names=[*JOINTS, *motion.action.stick_names],
            camera_names=[f"cam{number + 1:02d}" for number in range(self.cameras)],
        )
        truth = Truth(
            rotations=torch.from_numpy(rig.rotations),
            translations=torch.from_numpy(rig.translations),
            points=torch.from_numpy(motion.points(times)),
            intrinsics=torch.from_numpy(rig.intrinsics),
            distortion=None if rig.distortion is None else torch.from_numpy(rig.distortion),
            time_offsets_s=torch.from_numpy(offsets),
            readout_s=torch.full((self.cameras,), self.clocks.readout_s, dtype=torch.float64),
        )
        cube = None if self.cube is None else self.cube.seen_by(rig, float(np.median(views.sigma_px)), rng_cube)
        return SimulatedSession(self.name, observations, truth, views.inliers, views.sigma_px, cube, self.height_m, self.fps)


def write_simulated(path: str | FilePath, session: SimulatedSession) -> None:
    """Write a session for :func:`read_simulated`; to :func:`~torchstickcal.io.read_session` it is a session with truth."""
    more: dict[str, Any] = {
        "name": np.array(session.name),
        "inliers": session.inliers,
        "sigma_px": session.sigma_px,
        "height_m": np.array(session.height_m),
    }
    if session.cube is not None:
        more |= {"cube_corners_m": session.cube.corners_m, "cube_keypoints": session.cube.keypoints}
    write_npz(path, session.observations, session.truth, more)


def read_simulated(path: str | FilePath) -> SimulatedSession:
    """Read a session that :func:`write_simulated` wrote.

    Raises:
        FileFormatError: if it is damaged or no simulated session.
    """
    observations, truth = read_npz(path)
    with np.load(path, allow_pickle=False) as file:
        data = {name: file[name] for name in ("name", "inliers", "sigma_px", "height_m") if name in file.files}
        cube = CubeViews(file["cube_corners_m"], file["cube_keypoints"]) if "cube_corners_m" in file.files else None
    if truth is None or len(data) < 4 or observations.fps is None:
        raise FileFormatError(
            "not a simulated session",
            where=str(path),
            got=f"arrays {sorted(data)}",
            expected="truth, inliers, sigma_px, height_m",
        )
    return SimulatedSession(
        name=str(data["name"]),
        observations=observations,
        truth=truth,
        inliers=data["inliers"],
        sigma_px=data["sigma_px"],
        cube=cube,
        height_m=float(data["height_m"]),
        fps=observations.fps,
    )
