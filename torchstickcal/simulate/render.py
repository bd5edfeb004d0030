"""Images of simulated sessions: the scene with athlete, stick and cameras, or the keypoints of one camera."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import islice, pairwise
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from torchstickcal.files import atomic_path
from torchstickcal.simulate.rigs import SCENE_CENTRE, look_at
from torchstickcal.simulate.session import SimulatedSession
from torchstickcal.simulate.skeleton import JOINT_INDEX, JOINTS, PARENTS

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]
"""(H, W, 3), RGB"""

_BACKGROUND, _FLOOR, _CAMERA = (250, 250, 247), (214, 216, 212), (150, 150, 158)
_LEFT, _RIGHT, _MIDDLE = (33, 118, 174), (210, 73, 52), (52, 56, 64)
_STICK, _TRACE = (20, 20, 20), (232, 152, 20)
_COLOURS = (_FLOOR, _CAMERA, _LEFT, _RIGHT, _MIDDLE, _STICK, _TRACE)
_FLOOR_M, _FRUSTUM_M = 2.5, 0.28
_SUBPIXEL_BITS = 4
_FILM_FPS = 25

Bone = tuple[int, int, tuple[int, int, int]]


def _bone(joint: str, parent: str) -> Bone:
    """Indices of the ends of a bone and its colour; the line to a shoulder starts at the neck."""
    if joint.endswith("shoulder"):
        return JOINT_INDEX["neck"], JOINT_INDEX[joint], _MIDDLE
    colour = {"left": _LEFT, "right": _RIGHT}.get(joint.partition("_")[0], _MIDDLE)
    return JOINT_INDEX[parent], JOINT_INDEX[joint], colour


_BONES = [_bone(joint, parent) for joint, parent in PARENTS.items()]


class View:
    """The virtual camera from which the scene is drawn; it looks at the centre of the scene.

    Args:
        azimuth: of the camera, degrees from the x axis. elevation: above the horizontal, degrees.
        distance_m: of the camera from the centre of the scene, metres.
        size: width and height of the images, pixels.
    """

    def __init__(
        self, azimuth: float = 60.0, elevation: float = 14.0, distance_m: float = 14.0, size: tuple[int, int] = (640, 560)
    ) -> None:
        a, e = np.deg2rad(azimuth), np.deg2rad(elevation)
        centre = np.array(SCENE_CENTRE) + distance_m * np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
        self._rotation, self._centre = look_at(centre[None], np.array(SCENE_CENTRE))[0], centre
        self._focal, self._size = 0.44 * min(size) * distance_m / 2.5, size

    def draw(self, points: Array, trace: Array, centres: Array, rotations: Array) -> Picture:
        """Image of one frame.

        Args:
            points: joints and stick ends, (21, 3), metres.
            trace: positions of the stick's end in the preceding frames, (K, 3), oldest first.
            centres: of the cameras, (C, 3). rotations: of the cameras, world to camera, (C, 3, 3).
        """
        picture = np.full((self._size[1], self._size[0], 3), _BACKGROUND, np.uint8)
        grid = np.linspace(-_FLOOR_M, _FLOOR_M, 11)
        for at in grid:
            self._line(picture, np.array([[at, -_FLOOR_M, 0], [at, _FLOOR_M, 0]]), _FLOOR, 1)
            self._line(picture, np.array([[-_FLOOR_M, at, 0], [_FLOOR_M, at, 0]]), _FLOOR, 1)
        for centre, rotation in zip(centres, rotations, strict=True):
            corners = centre + _FRUSTUM_M * np.array([[x, y, 1.6] for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))]) @ rotation
            self._line(picture, corners[[0, 1, 2, 3, 0]], _CAMERA, 1)
            for corner in corners:
                self._line(picture, np.stack([centre, corner]), _CAMERA, 1)
        self._line(picture, points[[JOINT_INDEX[j] for j in ("left_ankle", "pelvis", "right_ankle")]] * [1, 1, 0], _FLOOR, 3)
        for number, segment in enumerate(pairwise(trace), 1):
            share = number / max(1, len(trace) - 1)
            self._line(picture, np.stack(segment), _mixed(_TRACE, _BACKGROUND, 0.15 + 0.85 * share), 2)
        for start, end, colour in sorted(_BONES, key=lambda bone: -self._depth(points[list(bone[:2])]).mean()):
            self._line(picture, points[[start, end]], colour, 4)
        self._line(picture, points[len(JOINTS) :], _STICK, 3)
        head = points[[JOINT_INDEX["head"], JOINT_INDEX["head_top"]]].mean(0)
        radius = self._focal * 0.11 / float(self._depth(head))
        x, y = self._pixels(head).tolist()
        cv2.circle(picture, (x, y), round(radius * 2**_SUBPIXEL_BITS), _MIDDLE, 2, cv2.LINE_AA, _SUBPIXEL_BITS)
        return picture

    def _depth(self, points: Array) -> Array:
        return (points - self._centre) @ self._rotation[2]

    def _pixels(self, points: Array) -> NDArray[np.int32]:
        """Pixels (..., 2) of points (..., 3), in the fixed-point format of OpenCV's drawing functions."""
        in_camera = (points - self._centre) @ self._rotation.T
        pixels = self._focal * in_camera[..., :2] / np.maximum(in_camera[..., 2:], 0.1) + np.array(self._size) / 2
        return np.clip(np.round(pixels * 2**_SUBPIXEL_BITS), -(2**20), 2**20).astype(np.int32)

    def _line(self, picture: Picture, points: Array, colour: tuple[int, int, int], width: int) -> None:
        cv2.polylines(picture, [self._pixels(points)], False, colour, width, cv2.LINE_AA, _SUBPIXEL_BITS)


def scene_frames(session: SimulatedSession, view: View | None = None, trace_s: float = 0.5) -> Iterator[Picture]:
    """Images of the frames of a session, seen from outside the rig.

    Args:
        session: with true points.
        view: from where the scene is drawn.
        trace_s: duration of the trace of the stick's end, seconds.
    """
    view = view or View()
    assert session.truth.points is not None
    points, rotations = session.truth.points.numpy(), session.truth.rotations.numpy()
    centres = -(rotations.swapaxes(1, 2) @ session.truth.translations.numpy()[..., None])[..., 0]
    _, stick_end = session.observations.sticks[0].ends
    trace = max(1, round(trace_s * session.fps))
    for frame in range(len(points)):
        yield view.draw(points[frame], points[max(0, frame - trace) : frame + 1, stick_end], centres, rotations)


def camera_frames(session: SimulatedSession, camera: int, width: int = 640) -> Iterator[Picture]:
    """Images of the keypoints of one camera, joined by bones; outliers are circled.

    Args:
        session: any session.
        camera: index of the camera.
        width: of the images, pixels.
    """
    assert session.observations.image_size is not None
    size = session.observations.image_size.expand(session.observations.num_cameras, 2)[camera].tolist()
    scale = width / size[0]
    stick = session.observations.sticks[0]
    for keypoints, inliers in zip(session.observations.keypoints[camera].numpy(), session.inliers[camera], strict=True):
        picture = np.full((round(size[1] * scale), width, 3), _BACKGROUND, np.uint8)
        seen = np.isfinite(keypoints).all(-1)
        pixels = np.round(np.nan_to_num(keypoints) * scale * 2**_SUBPIXEL_BITS).astype(np.int32)
        for start, end, colour in [*_BONES, (*stick.ends, _STICK)]:
            if seen[start] and seen[end]:
                cv2.line(picture, pixels[start], pixels[end], colour, 2, cv2.LINE_AA, _SUBPIXEL_BITS)
        for point in np.flatnonzero(seen):
            radius, colour = (4, _MIDDLE) if inliers[point] else (9, _RIGHT)
            cv2.circle(picture, pixels[point], radius << _SUBPIXEL_BITS, colour, 1, cv2.LINE_AA, _SUBPIXEL_BITS)
        yield picture


def contact_sheet(pictures: Iterable[Picture], columns: int) -> Picture:
    """Images of equal size arranged in rows."""
    cells = list(pictures)
    cells += [np.full_like(cells[0], 255)] * (-len(cells) % columns)
    return np.concatenate([np.concatenate(cells[k : k + columns], axis=1) for k in range(0, len(cells), columns)])


def write_film(path: str | Path, session: SimulatedSession, view: View | None = None) -> None:
    """Write the session, seen from outside the rig, as an animated GIF in real time with at most 25 images per second."""
    every = max(1, round(session.fps / _FILM_FPS))
    write_gif(path, islice(scene_frames(session, view), 0, None, every), session.fps / every)


def write_gif(path: str | Path, pictures: Iterable[Picture], fps: float) -> None:
    """Write images as an animated GIF that repeats, with at most 50 images per second."""
    shades = [_mixed(colour, _BACKGROUND, share) for colour in _COLOURS for share in np.linspace(0, 1, 16)]
    palette = Image.new("P", (1, 1))
    palette.putpalette(np.array(shades, dtype=np.uint8).tobytes())
    first, *rest = (Image.fromarray(picture).quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures)
    with atomic_path(path) as temporary:
        duration = max(20, round(1000 / fps))
        first.save(temporary, format="GIF", save_all=True, append_images=rest, duration=duration, loop=0, optimize=False)


def write_png(path: str | Path, picture: Picture) -> None:
    """Write one image as a PNG file."""
    with atomic_path(path) as temporary:
        Image.fromarray(picture).save(temporary, format="PNG")


def _mixed(colour: tuple[int, int, int], other: tuple[int, int, int], share: float) -> tuple[int, int, int]:
    r, g, b = (round(share * a + (1 - share) * b) for a, b in zip(colour, other, strict=True))
    return r, g, b
