"""Videos of simulated sessions as their cameras would record them: an athlete with a stick whose ends are marked.

The body is drawn as limbs with a thickness, so that it hides what is behind it. Each frame is the mean over an exposure time,
with noise; the background is cluttered, also with things of the markers' colours. Images are not distorted by a lens.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from torchstickcal.errors import CalibrationError
from torchstickcal.simulate.athlete import Motion
from torchstickcal.simulate.motions import Action
from torchstickcal.simulate.regimes import LIMB_RADII_M
from torchstickcal.simulate.rigs import CameraRig
from torchstickcal.simulate.skeleton import JOINT_INDEX, JOINTS, PARENTS

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]
"""(H, W, 3), blue, green, red"""
Segment = tuple[Array, Array, float, tuple[int, int, int]]
"""Start and end, metres; diameter, metres; colour."""

MARKER_COLOURS = {"red": (30, 25, 215), "yellow": (25, 220, 235), "green": (40, 190, 30), "magenta": (200, 30, 220)}
_LIMB_COLOURS = {"left": (120, 96, 70), "right": (110, 86, 64), "middle": (96, 90, 84), "skin": (140, 168, 205)}
_STICK_COLOUR = (60, 60, 64)
_PIECES = 8
_CIRCLE = np.stack([np.cos(np.arange(24) * np.pi / 12), np.sin(np.arange(24) * np.pi / 12)], axis=-1)
_BITS = 4
_NOISES = 8
_CLUTTER = 40


@dataclass(frozen=True)
class Markers:
    """Two balls on a stick, or two pieces of tape around it.

    Args:
        places_m: distances of their centres from the stick's start, metres, as of :func:`markers_of`; empty for a bare stick.
        colours: keys of :data:`MARKER_COLOURS`.
        balls: whether they are balls. length_m: of a piece of tape along the stick, metres.
        diameter_m: of ball or tape. stick_m: diameter of the stick.
    """

    places_m: tuple[float, ...]
    colours: tuple[str, str] = ("yellow", "red")
    length_m: float = 0.06
    diameter_m: float = 0.045
    stick_m: float = 0.022
    balls: bool = False

    @property
    def apart_m(self) -> float:
        """The distance between them, metres: the length of the stick in a calibration."""
        return self.places_m[1] - self.places_m[0]

    def on(self, points: Array) -> Array:
        """Centres of the markers (..., 2, 3) on a stick whose start and end are the last two of points (..., P, 3)."""
        start, end = points[..., -2, :], points[..., -1, :]
        along = (end - start) / np.linalg.norm(end - start, axis=-1, keepdims=True)
        return start[..., None, :] + np.array(self.places_m)[:, None] * along[..., None, :]


def markers_of(action: Action) -> Markers:
    """Tape where the hands of a sport leave the stick free: below the lower hand, and at the end."""
    return Markers((max(action.grips_m.values()) + 0.13, action.stick_m - 0.03))


@dataclass(frozen=True)
class Exposure:
    """How a camera records.

    Args:
        seconds: for which each frame is exposed.
        noise: standard deviation of each pixel's noise, in steps of 256.
        steps: into how many moments an exposure is divided at most.
    """

    seconds: float = 1 / 1000
    noise: float = 2.5
    steps: int = 16


class CameraFilm:
    """Pictures of one camera of a rig.

    Args:
        rig: without distortion. camera: index of the camera.
        motion: of the athlete and the stick.
        markers: on the stick. exposure: of the frames.
        seed: of clutter and noise.

    Raises:
        CalibrationError: if the rig has distortion.
    """

    def __init__(
        self, rig: CameraRig, camera: int, motion: Motion, markers: Markers, exposure: Exposure, seed: int = 0
    ) -> None:
        if rig.distortion is not None:
            raise CalibrationError("pictures of distorted images", where="rig", got="distortion", expected="none")
        self._rotation, self._translation = rig.rotations[camera], rig.translations[camera]
        self._matrix, self._size = rig.intrinsics[camera], rig.image_size
        self._motion, self._markers, self._exposure = motion, markers, exposure
        self._rng = np.random.default_rng((seed, camera))
        self._background = _clutter(self._size, self._rng, markers)
        shape = (self._size[1], self._size[0], 3)
        count = _NOISES if exposure.noise else 0
        self._noises = [(exposure.noise * self._rng.standard_normal(shape)).astype(np.float32) for _ in range(count)]

    def pictures(self, times: Sequence[float] | Array) -> Iterator[Picture]:
        """The frames whose exposures have their middle at some times, seconds."""
        for time in times:
            yield self._with_noise(self._exposed(float(time)))

    def _exposed(self, time: float) -> NDArray[np.float32]:
        half = self._exposure.seconds / 2
        ends = self._motion.points(np.array([time - half, time + half]))
        pixels = self._pixels(ends)[0]
        moved = float(np.linalg.norm(pixels[1] - pixels[0], axis=-1).max())
        steps = int(np.clip(np.ceil(moved), 1, self._exposure.steps))
        moments = time + half * (2 * (np.arange(steps) + 0.5) / steps - 1)
        points = self._motion.points(moments)
        box = self._box(points)
        part = self._background[box]
        mean = np.zeros(part.shape, np.float32)
        for moment in points:
            drawn = part.copy()
            self._draw(drawn, moment, (box[1].start, box[0].start))
            mean += drawn
        picture = self._background.astype(np.float32)
        picture[box] = mean / steps
        return picture

    def _with_noise(self, picture: NDArray[np.float32]) -> Picture:
        if self._noises:
            noise = self._noises[int(self._rng.integers(_NOISES))]
            shift = self._rng.integers(self._size[1]), self._rng.integers(self._size[0])
            picture = picture + np.roll(noise, shift, (0, 1))
        return np.clip(np.round(picture), 0, 255).astype(np.uint8)

    def _pixels(self, points: Array) -> tuple[Array, Array]:
        """Pixels (..., 2) and depths (...) of points (..., 3)."""
        in_camera = points @ self._rotation.T + self._translation
        depth = np.maximum(in_camera[..., 2], 0.1)
        homogeneous = in_camera @ self._matrix.T
        return homogeneous[..., :2] / depth[..., None], depth

    def _box(self, points: Array) -> tuple[slice, slice]:
        """Rows and columns that hold the athlete and the stick."""
        pixels, depth = self._pixels(points)
        margin = 0.2 * self._matrix[0, 0] / depth.min() + 4
        low = np.clip(np.floor(pixels.min((0, 1)) - margin), 0, np.array(self._size) - 2).astype(int)
        high = np.clip(np.ceil(pixels.max((0, 1)) + margin), low + 2, self._size).astype(int)
        return slice(int(low[1]), int(high[1])), slice(int(low[0]), int(high[0]))

    def _draw(self, picture: Picture, points: Array, corner: tuple[int, int]) -> None:
        """Draw a moment, farthest things first."""
        shapes = [(self._capsule, limb) for limb in _limbs(points)]
        shapes += [(self._cylinder, piece) for piece in self._free_pieces(points[-2], points[-1])]
        around = self._capsule if self._markers.balls else self._cylinder
        shapes += [(around, marker) for marker in self._marked(points)]
        depths = [float(self._pixels((first + second)[None] / 2)[1][0]) for _, (first, second, *_) in shapes]
        for number in np.argsort(depths)[::-1]:
            outline, (first, second, diameter_m, colour) = shapes[int(number)]
            edge = outline(np.stack([first, second]), diameter_m / 2) - corner
            cv2.fillConvexPoly(picture, cv2.convexHull(_fixed(edge)), colour, cv2.LINE_AA, _BITS)

    def _marked(self, points: Array) -> list[Segment]:
        """Bands around the stick, or balls: bands of no length with round ends."""
        marks, along = self._markers, points[-1] - points[-2]
        half = 0.0 if marks.balls else marks.length_m / 2 / float(np.linalg.norm(along))
        return [
            (centre - half * along, centre + half * along, marks.diameter_m, MARKER_COLOURS[colour])
            for centre, colour in zip(marks.on(points), marks.colours, strict=False)
        ]

    def _free_pieces(self, start: Array, end: Array) -> list[Segment]:
        """The stick between the markers, in pieces each of which is in front of or behind a limb as a whole."""
        half = (self._markers.diameter_m if self._markers.balls else self._markers.length_m) / 2
        length_m = float(np.linalg.norm(end - start))
        free, pieces = [0.0], []
        for place in sorted(self._markers.places_m):
            free += [place - half, place + half]
        free.append(length_m)
        for low, high in zip(free[::2], free[1::2], strict=True):
            steps = max(1, round(_PIECES * (high - low) / length_m))
            places = start + np.linspace(low, high, steps + 1)[:, None] * (end - start) / length_m
            pieces += [(a, b, self._markers.stick_m, _STICK_COLOUR) for a, b in itertools.pairwise(places) if high - low > 1e-6]
        return pieces

    def _capsule(self, ends: Array, radius_m: float) -> Array:
        """Pixels (n, 2) whose convex hull is a limb with round ends (2, 3)."""
        pixels, depth = self._pixels(ends)
        radius = self._matrix[0, 0] * radius_m / depth
        return (pixels[:, None] + radius[:, None, None] * _CIRCLE).reshape(-1, 2)

    def _cylinder(self, ends: Array, radius_m: float) -> Array:
        """Pixels (n, 2) whose convex hull is a cylinder with flat ends (2, 3)."""
        aside = np.linalg.svd((ends[1] - ends[0])[None])[2][1:]
        return self._pixels((ends[:, None] + radius_m * (_CIRCLE @ aside)).reshape(-1, 3))[0]


def write_video(path: str | Path, pictures: Iterator[Picture], fps: float, codec: str = "mp4v") -> None:
    """Write pictures as a video with OpenCV.

    Raises:
        CalibrationError: if OpenCV cannot write such a video.
    """
    writer: cv2.VideoWriter | None = None
    for picture in pictures:
        if writer is None:
            code = cv2.VideoWriter.fourcc(*codec)
            writer = cv2.VideoWriter(str(path), code, fps, (picture.shape[1], picture.shape[0]))
            if not writer.isOpened():
                raise CalibrationError("a video cannot be written", where=str(path), got=codec, expected="a codec of OpenCV")
        writer.write(picture)
    if writer is not None:
        writer.release()


def _fixed(pixels: Array) -> NDArray[np.int32]:
    """Pixels in the fixed-point format of OpenCV's drawing functions."""
    return np.round(np.clip(pixels, -5000, 20000) * 2**_BITS).astype(np.int32)


def _limbs(points: Array) -> list[Segment]:
    """The limbs of a body."""
    limbs = []
    for joint, parent in PARENTS.items():
        side, _, name = joint.rpartition("_")
        radius = LIMB_RADII_M.get(joint, LIMB_RADII_M.get(name, 0.05))
        skin = joint in ("head", "head_top") or name in ("wrist", "hand")
        colour = _LIMB_COLOURS["skin" if skin else side if side in ("left", "right") else "middle"]
        limbs.append((points[JOINT_INDEX[parent]], points[JOINT_INDEX[joint]], 2 * radius, colour))
    chest = points[[JOINT_INDEX["left_shoulder"], JOINT_INDEX["right_shoulder"]]]
    limbs.append((chest[0], chest[1], 0.2, _LIMB_COLOURS["middle"]))
    assert len(points) == len(JOINTS) + 2
    return limbs


def _clutter(size: tuple[int, int], rng: np.random.Generator, markers: Markers) -> Picture:
    """A background of things of all colours, also of those of the markers."""
    width, height = size
    coarse = rng.uniform(70, 150, (9, 16, 3)).astype(np.float32)
    picture = cv2.resize(coarse, size, interpolation=cv2.INTER_CUBIC).clip(0, 255).astype(np.uint8)
    for number in range(_CLUTTER):
        colour, largest = rng.integers(20, 235, 3).tolist(), 90
        if number % 10 == 0:
            colour, largest = list(MARKER_COLOURS[markers.colours[number // 10 % 2]]), 25
        x, y = int(rng.integers(width)), int(rng.integers(height))
        w, h = (int(v) for v in rng.integers(6, largest, 2))
        if number % 2:
            cv2.rectangle(picture, (x, y), (x + w, y + h), colour, -1)
        else:
            cv2.ellipse(picture, (x, y), (w, h), float(rng.uniform(0, 180)), 0, 360, colour, -1, cv2.LINE_AA)
    return cv2.GaussianBlur(picture, (0, 0), 1.0).astype(np.uint8)
