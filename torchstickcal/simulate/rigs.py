"""Camera rigs around the scene: layouts of the cameras, and their lenses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from torchstickcal.errors import CalibrationError
from torchstickcal.geometry.cameras import Intrinsics
from torchstickcal.simulate.skeleton import unit

Array = NDArray[np.float64]

LAYOUTS = ("hemisphere", "random", "ring", "line", "arena")
SCENE_CENTRE = (0.0, 0.0, 0.9)
_GOLDEN_ANGLE = np.pi * (3 - np.sqrt(5))
_MIN_HEIGHT_M = 0.35
_ARENA_M = (12.0, 9.0, 3.2)
_NEAR_PLANE_M = 0.1


@dataclass(frozen=True)
class Lens:
    """Intrinsics of the cameras.

    Args:
        image_size: width and height, pixels.
        focal_px: focal length, pixels; None to choose it for each camera so that a ball around the centre of the scene
            fills the image.
        scene_m: radius of that ball, metres.
        distortion: k1, k2, p1, p2, k3 of OpenCV's model; None for no distortion.
        variation: differences between the cameras: relative standard deviation of focal length and k1, and standard
            deviation of the principal point, which is 0.3 times this share of the focal length. 0: all cameras are equal.

    Example:
        >>> from torchstickcal.simulate import Lens, SessionSpec
        >>> spec = SessionSpec("golf", "golf", frames=5, lens=Lens(image_size=(1280, 720), focal_px=900.0))
        >>> spec.generate().observations.intrinsics[0].tolist()
        [[900.0, 0.0, 640.0], [0.0, 900.0, 360.0], [0.0, 0.0, 1.0]]
    """

    image_size: tuple[int, int] = (1920, 1080)
    focal_px: float | None = None
    scene_m: float = 1.9
    distortion: tuple[float, float, float, float, float] | None = None
    variation: float = 0.0


@dataclass(frozen=True, eq=False)
class CameraRig:
    """True extrinsics and intrinsics of the cameras."""

    rotations: Array
    """(C, 3, 3), world to camera"""
    translations: Array
    """(C, 3), metres"""
    intrinsics: Array
    """(C, 3, 3), pixels"""
    distortion: Array | None
    """(C, 5), coefficients of OpenCV's model"""
    image_size: tuple[int, int]
    """width and height, pixels"""

    @property
    def centres(self) -> Array:
        """Camera centres (C, 3), metres."""
        return -(self.rotations.swapaxes(1, 2) @ self.translations[..., None])[..., 0]

    def project(self, points: Array) -> Array:
        """Project points into the images.

        Args:
            points: of each camera, (C, ..., 3), metres.

        Returns:
            Pixels (C, ..., 2); NaN for points behind the camera or outside its image.
        """
        in_cameras = points.reshape(len(points), -1, 3) @ self.rotations.swapaxes(1, 2) + self.translations[:, None]
        pixels = self._lenses(slice(None)).project(torch.from_numpy(in_cameras)).numpy()
        seen = (in_cameras[..., 2] > _NEAR_PLANE_M) & self.contains(pixels)
        return np.where(seen[..., None], pixels, np.nan).reshape(*points.shape[:-1], 2)

    def contains(self, pixels: Array) -> NDArray[np.bool_]:
        """Whether pixels (..., 2) are in the image, (...); False for NaN."""
        return np.all((pixels >= 0) & (pixels <= np.array(self.image_size) - 1.0), axis=-1)

    def rows(self, points: Array, cameras: NDArray[np.intp]) -> Array:
        """Image rows of points, not limited to the image.

        Args:
            points: (N, 3), metres.
            cameras: index of the camera of each point, (N,).

        Returns:
            (N,), pixels.
        """
        in_cameras = (self.rotations[cameras] @ points[..., None])[..., 0] + self.translations[cameras]
        in_cameras[:, 2] = np.maximum(in_cameras[:, 2], _NEAR_PLANE_M)
        return self._lenses(cameras.tolist()).project(torch.from_numpy(in_cameras)).numpy()[..., 1]

    def _lenses(self, cameras: slice | list[int]) -> Intrinsics:
        lens = None if self.distortion is None else torch.from_numpy(self.distortion)
        return Intrinsics(torch.from_numpy(self.intrinsics), lens)[cameras]


def camera_rig(layout: str, count: int, rng: np.random.Generator, lens: Lens | None = None, radius_m: float = 4.0) -> CameraRig:
    """A rig of cameras that look at the centre of the scene.

    Args:
        layout: one of :data:`LAYOUTS`. ``hemisphere``: spread evenly over a hemisphere, from its top downwards; ``random``:
            at random positions on a hemisphere; ``ring``: around the scene at alternating heights; ``line``: in a row on
            one side; ``arena``: in the upper corners of a hall of 12 x 9 m and along its walls.
        count: number of cameras, 2 to 16.
        rng: random generator of positions and lenses.
        lens: intrinsics of the cameras; None for the default ones.
        radius_m: distance of the cameras from the centre of the scene, metres; not used by ``arena``.

    Raises:
        CalibrationError: for an unknown layout or an unsupported number of cameras.
    """
    if layout not in LAYOUTS:
        raise CalibrationError("unknown layout", where="layout", got=repr(layout), expected=f"one of {', '.join(LAYOUTS)}")
    if not 2 <= count <= 16:
        raise CalibrationError("unsupported number of cameras", where="cameras", got=count, expected="2 to 16")
    centres = _centres(layout, count, rng, radius_m)
    rotations = look_at(centres, np.array(SCENE_CENTRE))
    intrinsics, distortion = _drawn_lenses(lens or Lens(), np.linalg.norm(centres - SCENE_CENTRE, axis=-1), rng)
    translations = -(rotations @ centres[..., None])[..., 0]
    return CameraRig(rotations, translations, intrinsics, distortion, (lens or Lens()).image_size)


def look_at(centres: Array, target: Array) -> Array:
    """Rotations (C, 3, 3), world to camera, of upright cameras that look at a target.

    Args:
        centres: of the cameras, (C, 3). target: (3,).
    """
    forward = unit(target - centres)
    right = unit(np.cross(forward, [0.0, 0.0, 1.0]))
    return np.stack([right, np.cross(forward, right), forward], axis=-2)


def _centres(layout: str, count: int, rng: np.random.Generator, radius_m: float) -> Array:
    """Camera centres (C, 3) of a layout, metres."""
    number = np.arange(count)
    if layout == "hemisphere":
        return _on_sphere(_GOLDEN_ANGLE * number, 1 - (number + 0.5) / count, radius_m)
    if layout == "random":
        angle = 2 * np.pi * (rng.permutation(count) + rng.uniform(-0.4, 0.4, count)) / count
        return _on_sphere(angle, rng.uniform(0.05, 0.75, count), radius_m)
    if layout == "ring":
        angle = 2 * np.pi * number / count + rng.uniform(0.2, 0.4, count)
        return _on_sphere(angle, np.where(number % 2, 0.35, 0.1), radius_m)
    if layout == "line":
        along = np.linspace(-radius_m, radius_m, count)
        return np.stack([along, np.full(count, -radius_m), 1.4 + 0.5 * (number % 2)], axis=-1)
    length, width, height = _ARENA_M
    angle = 2 * np.pi * np.where(number < 4, number / 4, (number - 4 + 0.5) / max(count - 4, 1))
    corners = np.stack([np.cos(angle + np.pi / 4), np.sin(angle + np.pi / 4)], axis=-1)
    corners = corners / np.abs(corners).max(-1, keepdims=True) * [length / 2, width / 2]
    return np.concatenate([corners, rng.uniform(0.8 * height, height, (count, 1))], axis=-1)


def _on_sphere(azimuth: Array, sine: Array, radius_m: float) -> Array:
    """Points (C, 3) on a sphere around the centre of the scene, at a minimum height above the floor.

    Args:
        azimuth: (C,), radians. sine: of the elevation, (C,).
        radius_m: of the sphere, metres.
    """
    sine = np.maximum(sine, (_MIN_HEIGHT_M - SCENE_CENTRE[2]) / radius_m)
    cosine = np.sqrt(1 - sine**2)
    return np.array(SCENE_CENTRE) + radius_m * np.stack([cosine * np.cos(azimuth), cosine * np.sin(azimuth), sine], axis=-1)


def _drawn_lenses(lens: Lens, distances: Array, rng: np.random.Generator) -> tuple[Array, Array | None]:
    """Draw camera matrices (C, 3, 3) and distortion (C, 5) of cameras at distances (C,) from the centre of the scene."""
    count, size = len(distances), np.array(lens.image_size, float)
    focal = 0.5 * size.min() * distances / lens.scene_m if lens.focal_px is None else np.full(count, float(lens.focal_px))
    focal = focal * (1 + lens.variation * rng.standard_normal(count))
    centre = size / 2 + lens.variation * focal[:, None] * 0.3 * rng.standard_normal((count, 2))
    intrinsics = np.zeros((count, 3, 3))
    intrinsics[:, 0, 0] = intrinsics[:, 1, 1] = focal
    intrinsics[:, :2, 2], intrinsics[:, 2, 2] = centre, 1.0
    if lens.distortion is None:
        return intrinsics, None
    distortion = np.tile(lens.distortion, (count, 1))
    distortion[:, 0] *= 1 + lens.variation * rng.standard_normal(count)
    return intrinsics, distortion
