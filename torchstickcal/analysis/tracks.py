"""Points over time with all that is known of their errors: what an analysis begins with.

A calibration smooths its points, which pulls a fast swing inwards. Here each frame is triangulated by itself again, so that its
error is that of its own keypoints, and how much to smooth can be chosen for what is asked.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchstickcal.errors import CalibrationError
from torchstickcal.geometry import se3
from torchstickcal.geometry.cameras import Intrinsics
from torchstickcal.reconstruction import Reconstruction
from torchstickcal.result import Calibration
from torchstickcal.solvers.uncertainty import triangulation_terms
from torchstickcal.world import World

Array = NDArray[np.float64]

_LEVEL_SINE = 0.09
"""Sine of 5 degrees: cameras that are tilted to the side by more than this in the mean are not level."""


_MEASURED = ("points", "calibration")
"""Frames whose z axis comes from measurements."""


@dataclass(frozen=True, eq=False)
class Tracks:
    """Points over time, each frame estimated by itself, with their errors.

    The error of a point is ``roots @ noise + by_cameras @ camera_root @ common``, where ``noise`` is drawn for each point and
    frame and ``common`` once for the whole recording, both with variance 1.
    """

    times: Array
    """(T,), seconds, ascending"""
    points: Array
    """(T, P, 3), metres, in the frame of the calibration; NaN where not known"""
    roots: Array
    """(T, P, 3, 3), square roots of the covariances that the keypoints' noise gives, metres"""
    by_cameras: Array
    """(T, P, 3, K), derivatives of the points with respect to the tangents of the cameras"""
    camera_root: Array
    """(K, K), square root of the covariance of the tangents"""
    names: tuple[str, ...]
    """P"""
    sticks: tuple[tuple[int, int, float, float], ...]
    """start, end, length and standard deviation of the length, metres"""
    up: Array | None
    """(3,), unit vector; None if the vertical is not known"""
    notes: tuple[str, ...] = ()

    def drawn(self, count: int, seed: int = 0) -> Array:
        """The points, and ``count`` times the points with errors drawn at random, (1 + count, T, P, 3)."""
        rng = np.random.default_rng(seed)
        common = self.by_cameras @ (self.camera_root @ rng.standard_normal((len(self.camera_root), count)))
        drawn = np.empty((1 + count, *self.points.shape))
        drawn[0] = self.points
        for number in range(count):
            noise = rng.standard_normal(self.points.shape)
            drawn[1 + number] = self.points + (self.roots @ noise[..., None])[..., 0] + common[..., number]
        return drawn

    @property
    def variances(self) -> Array:
        """(T, P), variance of each point along an axis by the keypoints' noise, mean over the axes, square metres."""
        return np.square(self.roots).sum((-2, -1)) / 3


def tracks_of(calibration: Calibration | Reconstruction, fps: float | None = None, up: Sequence[float] | None = None) -> Tracks:
    """The tracks of a calibrated session, or of a recording that was triangulated.

    Args:
        calibration: of the session; or what :func:`torchstickcal.triangulate` found.
        fps: frames per second; None for those of the calibration.
        up: the vertical in the frame of the calibration, of any length; None to take it from the cameras, which then must
            stand level: not tilted to the side, as on a tripod; or from the frame, if its z is up.

    Raises:
        CalibrationError: if neither the calibration nor ``fps`` says how fast the frames follow each other, or ``up`` has no
            direction.

    Example:
        >>> from torchstickcal import calibrate
        >>> from torchstickcal.simulate import Noise, golf_session
        >>> observations, _ = golf_session(cameras=3, frames=30, noise=Noise(1.0))
        >>> tracks = tracks_of(calibrate(observations))
        >>> tracks.points.shape, tracks.up.shape
        ((30, 21, 3), (3,))
    """
    points, covariances, by_cameras = _frame_by_frame(calibration)
    vertical, notes = _vertical(calibration.rotations.double(), calibration.world, up)
    return Tracks(
        times=_times(calibration, fps),
        points=points.numpy(),
        roots=_roots(covariances.numpy()),
        by_cameras=by_cameras.numpy(),
        camera_root=_roots(calibration.covariance.double().cpu().numpy()),
        names=calibration.point_names or tuple(str(number) for number in range(points.shape[1])),
        sticks=tuple((*stick.ends, stick.length_m, stick.sigma_m) for stick in calibration.sticks),
        up=vertical,
        notes=tuple(notes),
    )


def _frame_by_frame(calibration: Calibration | Reconstruction) -> tuple[Tensor, Tensor, Tensor]:
    """Points (G, P, 3) of each frame by itself, covariances (G, P, 3, 3) and derivatives (G, P, 3, K), on the CPU.

    The calibration's points fit their keypoints up to the residuals; one step of Gauss-Newton undoes the smoothing.
    """
    c = calibration
    points = c.points.double().cpu()
    frames, count = points.shape[:2]
    residuals, inliers, index = c.residuals_px.double().cpu(), c.inliers.cpu(), c.frame_index.cpu()
    of_frame = residuals.new_full((len(residuals), frames, count, 2), torch.nan)
    seen = inliers.new_zeros(of_frame.shape[:3])
    cameras, own = (index >= 0).nonzero(as_tuple=True)
    of_frame[cameras, index[cameras, own]] = residuals[cameras, own]
    seen[cameras, index[cameras, own]] = inliers[cameras, own]
    lens = None if c.distortion is None else c.distortion.double().cpu()
    intrinsics = Intrinsics(c.intrinsics.double().cpu(), lens, c.fisheye)
    poses = c.rotations.double().cpu(), c.translations.double().cpu()
    flat = points.flatten(0, 1)
    moved = se3.moved(poses[0][None], poses[1][None], flat.mT[None])[0]
    pixels = intrinsics.project(moved.movedim(1, -1)) - of_frame.flatten(1, 2)
    sigma_px = c.sigma_px.double().cpu().expand(frames, count).flatten()
    found = triangulation_terms(flat, seen.flatten(1), sigma_px, poses, intrinsics, pixels)
    step, covariances, by_cameras = (term.unflatten(0, (frames, count)) for term in found)
    return points + step, covariances, by_cameras


def _times(calibration: Calibration | Reconstruction, fps: float | None) -> Array:
    if fps is None and calibration.times is not None:
        return calibration.times.double().cpu().numpy()
    rate = fps or calibration.fps
    if not rate or not np.isfinite(rate) or rate <= 0:
        raise CalibrationError(
            "an analysis needs to know how fast the frames follow each other",
            where="fps",
            got=fps if fps is not None else "a calibration without a frame rate",
            expected="frames per second, above 0",
            remedy="Give it with --fps.",
        )
    return np.arange(len(calibration.points)) / rate


def _vertical(rotations: Tensor, world: World, up: Sequence[float] | None) -> tuple[Array | None, list[str]]:
    """The vertical (3,) and a sentence about where it comes from.

    The x axis of a level camera is horizontal: the vertical is what is most nearly perpendicular to all of them. A frame by
    measured points is better than that; one by the posture of the athlete is not.
    """
    if up is not None:
        given = np.asarray(up, dtype=np.float64)
        length = np.linalg.norm(given) if given.shape == (3,) else np.nan
        if not np.isfinite(length) or length == 0:
            raise CalibrationError("not a direction", where="up", got=up, expected="three numbers, not all of them 0")
        return given / length, []
    of_frame = np.array([0.0, 0.0, 1.0]), [f"The vertical is the z axis of the frame: {world.axes}."]
    if world.up == "z" and world.name in _MEASURED:
        return of_frame
    rotations = rotations.cpu()
    _, values, axes = torch.linalg.svd(rotations[:, 0] / len(rotations) ** 0.5)
    tilt, second = (float(v) for v in (values[2] if len(values) > 2 else 0.0, values[1]))
    candidate = axes[2]
    mean_up = -rotations[:, 1].mean(0)
    if tilt > _LEVEL_SINE or second < 2 * _LEVEL_SINE or abs(float(candidate @ mean_up)) < 0.5:
        if world.up == "z":
            return of_frame
        return None, [
            "The vertical is not known, because the cameras do not stand level or look in one direction. Angles that need it "
            "are left out. Give it as `up`."
        ]
    sign = 1.0 if float(candidate @ mean_up) > 0 else -1.0
    return (sign * candidate).numpy(), [
        "The vertical was taken from the cameras, as if none of them were tilted to the side "
        f"(their axes agree to {np.degrees(np.arcsin(min(1.0, tilt))):.1f} degrees)."
    ]


def _roots(covariances: Array) -> Array:
    """Symmetric square roots of covariances (..., n, n); NaN where a covariance is NaN."""
    known = np.asarray(np.isfinite(covariances).all((-2, -1)))
    values, vectors = np.linalg.eigh(np.where(known[..., None, None], covariances, 0.0))
    roots = (vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :]) @ np.swapaxes(vectors, -1, -2)
    return np.where(known[..., None, None], roots, np.nan)
