"""Simulated sessions: a specification generates the observations together with their true values; files of sessions."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path as FilePath
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from torchstickcal.errors import CalibrationError, FileFormatError
from torchstickcal.io import Truth, read_npz, write_npz
from torchstickcal.observations import Observations
from torchstickcal.shapes import check_shapes
from torchstickcal.simulate.athlete import Motion
from torchstickcal.simulate.clocks import Clocks, exposed_points
from torchstickcal.simulate.cube import Cube, CubeViews
from torchstickcal.simulate.motions import action
from torchstickcal.simulate.paths import Path
from torchstickcal.simulate.regimes import Regime, Views, apply
from torchstickcal.simulate.rigs import CameraRig, Lens, camera_rig
from torchstickcal.simulate.skeleton import JOINTS, STANDING_HEIGHT_M, Skeleton
from torchstickcal.stick import Stick
from torchstickcal.untrusted import open_arrays, reading

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Assumptions:
    """Errors of the intrinsics and of the stick length that the observations carry.

    Args:
        focal_scale: given divided by true focal length, the same for all cameras.
        focal_spread: relative standard deviation of a further error of each camera's focal length.
        centre_px: standard deviation of the error of the principal points along each image axis, pixels.
        lens_known: whether the true distortion is given; if not, no distortion is given.
        stick_scale: given divided by true length of the stick.
    """

    focal_scale: float = 1.0
    focal_spread: float = 0.0
    centre_px: float = 0.0
    lens_known: bool = True
    stick_scale: float = 1.0

    def intrinsics(self, rig: CameraRig, rng: np.random.Generator) -> tuple[Array, Array | None]:
        """Draw the given camera matrices (C, 3, 3) and distortion (C, 5)."""
        given = rig.intrinsics.copy()
        given[:, [0, 1], [0, 1]] *= (self.focal_scale * (1 + self.focal_spread * rng.standard_normal(len(given))))[:, None]
        given[:, :2, 2] += self.centre_px * rng.standard_normal((len(given), 2))
        return given, rig.distortion if self.lens_known else None


@dataclass(frozen=True, eq=False)
class SimulatedSession:
    """A session with its true values."""

    name: str
    observations: Observations
    """what a calibration is given"""
    truth: Truth
    """true extrinsics, intrinsics, points, time offsets and read-out times"""
    inliers: NDArray[np.bool_]
    """(C, F, P), False for outliers"""
    sigma_px: Array
    """(C, F, P), standard deviation of the noise along each image axis, pixels"""
    cube: CubeViews | None
    """keypoints of a calibration cube, if the specification has one"""
    height_m: float
    """standing height of the athlete"""
    fps: float
    """frames per second"""


@dataclass(frozen=True)
class SessionSpec:
    """Specification of a simulated session. The same specification always generates the same session.

    Args:
        name: of the session.
        sport: name of a sport in :data:`~torchstickcal.simulate.SPORTS`.
        seed: of all random numbers, 0 or more.
        cameras: number of cameras, 2 to 16.
        frames: number of frames.
        fps: frames per second.
        layout: arrangement of the cameras, see :func:`~torchstickcal.simulate.rigs.camera_rig`.
        lens: intrinsics of the cameras.
        radius_m: distance of the cameras from the centre of the scene, metres.
        path: shape of the athlete's path on the floor: ``stay``, ``circle``, ``square``, ``triangle`` or ``figure8``.
        path_m: about half the extent of the path, metres.
        laps: part of the path that the athlete walks after each repetition of the action, in rounds.
        tempo: speed of the action; 1 is the speed of competition.
        variation: factor on the random variation between repetitions; 0 is none.
        height_m: standing height of the athlete, metres.
        regimes: errors of the keypoints (see :mod:`torchstickcal.simulate.regimes`), added one after another.
        clocks: time offsets and read-out time of the cameras.
        assumptions: errors of the given intrinsics and stick length.
        cube: a calibration cube that all cameras see too; None for none.

    Example:
        >>> from torchstickcal.simulate import Noise, SessionSpec
        >>> spec = SessionSpec("serve", "baseball", seed=1, cameras=4, frames=30, regimes=(Noise(sigma_px=1.0),))
        >>> session = spec.generate()
        >>> session.observations.keypoints.shape  # cameras, frames, points, image axes
        torch.Size([4, 30, 21, 2])
        >>> session.truth.points.shape
        torch.Size([30, 21, 3])
        >>> session.observations.sticks[0].length_m
        0.86
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
        """The motion of the athlete and the stick.

        Raises:
            CalibrationError: for an unknown sport or path, or an impossible height.
        """
        path = Path(self.path, self.path_m)
        return Motion(action(self.sport), Skeleton(self.height_m), path, self.laps, self.tempo, self.variation, self.seed)

    def generate(self) -> SimulatedSession:
        """Generate the session.

        Raises:
            CalibrationError: for an unknown sport, path or layout, a negative seed, or an impossible number of cameras or
                height.
            ObservationError: if no frame is left in which two cameras see the stick.
        """
        if self.seed < 0:
            raise CalibrationError("negative seed", where="seed", got=self.seed, expected="0 or more")
        rng_rig, rng_clocks, rng_assumptions, rng_keypoints, rng_cube = np.random.default_rng(self.seed).spawn(5)
        motion = self.motion
        rig = camera_rig(self.layout, self.cameras, rng_rig, self.lens, self.radius_m)
        times = np.arange(self.frames) / self.fps
        offsets = self.clocks.offsets(self.cameras, rng_clocks)
        points = exposed_points(motion, rig, times + offsets[:, None], self.clocks.readout_s)
        at_frames = motion.points(times) if self.clocks.readout_s else points[0].copy()  # the first camera's clock is right
        shape = points.shape[:3]
        views = Views(rig, points, rig.project(points), np.ones(shape, dtype=bool), np.zeros(shape))
        views = apply(self.regimes, views, rng_keypoints)
        views = views.hiding(~rig.contains(views.keypoints))

        intrinsics, distortion = self.assumptions.intrinsics(rig, rng_assumptions)
        stick = Stick(len(JOINTS), len(JOINTS) + 1, motion.action.stick_m * self.assumptions.stick_scale)
        observations = Observations(
            views.keypoints,
            intrinsics,
            stick,
            distortion=distortion,
            confidence=views.confidence,
            image_size=rig.image_size,
            fps=self.fps,
            point_names=[*JOINTS, *motion.action.stick_names],
            camera_names=[f"cam{number + 1:02d}" for number in range(self.cameras)],
        )
        truth = Truth(
            rotations=torch.from_numpy(rig.rotations),
            translations=torch.from_numpy(rig.translations),
            points=torch.from_numpy(at_frames),
            intrinsics=torch.from_numpy(rig.intrinsics),
            distortion=None if rig.distortion is None else torch.from_numpy(rig.distortion),
            time_offsets_s=torch.from_numpy(offsets),
            readout_s=torch.full((self.cameras,), self.clocks.readout_s, dtype=torch.float64),
        )
        cube = None if self.cube is None else self.cube.seen_by(rig, float(np.median(views.sigma_px)), rng_cube)
        return SimulatedSession(self.name, observations, truth, views.inliers, views.sigma_px, cube, self.height_m, self.fps)


def write_simulated(path: str | FilePath, session: SimulatedSession) -> None:
    """Write a simulated session to a file.

    :func:`read_simulated` reads it back; :func:`~torchstickcal.io.read_session` reads its observations and truth.

    Args:
        path: of the file, ending in ``.npz``.
        session: the session.

    Example:
        >>> import tempfile
        >>> from torchstickcal.simulate import SessionSpec, read_simulated, write_simulated
        >>> session = SessionSpec("cut", "kendo", cameras=3, frames=10).generate()
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_simulated(f"{folder}/cut.npz", session)
        ...     back = read_simulated(f"{folder}/cut.npz")
        >>> back.name, back.fps, back.inliers.shape
        ('cut', 60.0, (3, 10, 21))
    """
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
    """Read a simulated session from a file that :func:`write_simulated` wrote (see there for an example).

    Args:
        path: of the file.

    Raises:
        FileFormatError: if the file is damaged or does not hold a simulated session.
    """
    observations, truth = read_npz(path)
    with reading(path, "a simulated session"), open_arrays(path) as arrays:
        missing = [name for name in ("name", "inliers", "sigma_px", "height_m") if name not in arrays]
        if truth is None or missing or observations.fps is None:
            raise FileFormatError(
                "not a simulated session",
                where=str(path),
                got=f"no {', '.join(missing) or 'truth or frame rate'}",
                expected="truth, inliers, sigma_px, height_m",
            )
        per_keypoint = {"visible": observations.visible, "inliers": arrays["inliers"], "sigma_px": arrays["sigma_px"]}
        check_shapes("session", per_keypoint, dict.fromkeys(per_keypoint, "C F P"))
        cube = None
        if "cube_corners_m" in arrays:
            cube = CubeViews(arrays["cube_corners_m"], arrays["cube_keypoints"])
            views = {"cameras": observations.visible, "cube_corners_m": cube.corners_m, "cube_keypoints": cube.keypoints}
            check_shapes("session", views, {"cameras": "C F P", "cube_corners_m": "K 3", "cube_keypoints": "C K 2"})
        return SimulatedSession(
            name=str(arrays["name"]),
            observations=observations,
            truth=truth,
            inliers=arrays["inliers"],
            sigma_px=arrays["sigma_px"],
            cube=cube,
            height_m=float(arrays["height_m"]),
            fps=observations.fps,
        )
