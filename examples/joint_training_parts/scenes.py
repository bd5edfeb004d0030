"""Rendered sessions: an athlete with a stick, seen by good and cheap cameras whose true poses are known.

What makes keypoints wrong, each in its own way:

* cheap cameras are not synchronised: each of their frames is some milliseconds too early or too late. Their exposure
  is long, so that what moves fast is blurred; their images are soft and grainy;
* loose clothes: what is seen of a joint under them is displaced, differently in each camera, and stays so for the session;
* limbs behind the trunk, things in front of the athlete, and a background of lines that look like sticks.
"""

from __future__ import annotations

import colorsys
from dataclasses import dataclass, fields

import numpy as np
import torch
from kornia.filters import gaussian_blur2d
from torch import Tensor

from joint_training_parts.drawing import Capsules, draw
from torchstickcal.simulate import Lens, Motion, action
from torchstickcal.simulate.paths import Path
from torchstickcal.simulate.rigs import CameraRig, camera_rig
from torchstickcal.simulate.skeleton import JOINT_INDEX, JOINTS, Skeleton

CAMERAS, FRAMES, SIZE = 5, 16, 64
"""Cameras and frames of a session, and width and height of a crop in pixels."""
PAIRED = ("shoulder", "elbow", "hand", "knee", "ankle")
NAMES = ("head", "pelvis", *(f"{side}_{joint}" for joint in PAIRED for side in ("left", "right")), "stick_start", "stick_end")
POINTS = len(NAMES)
START, END = POINTS - 2, POINTS - 1

_CHOSEN = [JOINT_INDEX[name] for name in NAMES[:START]] + [len(JOINTS), len(JOINTS) + 1]
_SHOULDERS, _ELBOWS, _HANDS, _KNEES, _ANKLES = ((2, 3), (4, 5), (6, 7), (8, 9), (10, 11))
_CLOTHED = np.array([name == "pelvis" or name.endswith(("shoulder", "elbow", "knee")) for name in NAMES])
_DISPLACED_M = 0.015
_CHEAP, _EARLY_OR_LATE_S, _EXPOSURE_S, _CHEAP_EXPOSURE_S, _MOMENTS = 0.4, 0.02, 0.004, 0.03, 3
_SOFT_PX, _NOISE, _CHEAP_NOISE = 0.8, 0.02, 0.05
_BEHIND, _BEFORE = (6, 0.01, 0.06), (1, 0.02, 0.04)
_DURATION_S, _MARGIN = 3.6, 0.08
_TURN = 2.2


@dataclass(frozen=True)
class Sessions:
    """S sessions of C cameras and F frames. Pixels are those of the whole image, of which a crop shows the athlete."""

    images: Tensor
    """(S, C, F, 3, H, W), uint8"""
    origin: Tensor
    """(S, C, F, 2), the middle of a crop's first pixel"""
    scale: Tensor
    """(S, C, F), width of a crop's pixel"""
    labels: Tensor
    """(S, C, F, P, 2), where the points are in the images"""
    true: Tensor
    """(S, C, F, P, 2), where they would be if the cameras were synchronised"""
    intrinsics: Tensor
    """(S, C, 3, 3)"""
    rotations: Tensor
    """(S, C, 3, 3), world to camera"""
    translations: Tensor
    """(S, C, 3), metres"""
    stick_m: Tensor
    """(S, 1)"""

    def in_crops(self, pixels: Tensor) -> Tensor:
        """Pixels (S, C, F, P, 2) of the whole images as pixels of the crops."""
        return (pixels - self.origin[..., None, :]) / self.scale[..., None, None]

    def in_images(self, pixels: Tensor) -> Tensor:
        """Pixels (S, C, F, P, 2) of the crops as pixels of the whole images."""
        return pixels * self.scale[..., None, None] + self.origin[..., None, :]


def sessions(seeds: range, sports: tuple[str, ...], layouts: tuple[str, ...], *, invented: bool = False) -> Sessions:
    """Sessions with an athlete, clothes, a rig and backgrounds of their own.

    Args:
        seeds: one for each session.
        sports: their sports, in turn. layouts: those of their rigs.
        invented: whether arms are turned at random in each image, so that a detector learns more postures than two sports have.
    """
    drawn = [
        _session(np.random.default_rng(seed), sports[seed % len(sports)], layouts[seed // 2 % len(layouts)], invented)
        for seed in seeds
    ]
    return Sessions(*(torch.stack([getattr(one, field.name) for one in drawn]) for field in fields(Sessions)))


def _session(rng: np.random.Generator, sport: str, layout: str, invented: bool) -> Sessions:
    path = Path("circle", float(rng.uniform(0.5, 1.0)))
    motion = Motion(action(sport), Skeleton(float(rng.uniform(1.6, 1.95))), path, seed=int(rng.integers(1 << 30)))
    rig = camera_rig(layout, CAMERAS, rng, Lens(image_size=(1280, 960)), radius_m=float(rng.uniform(3.5, 5.0)))
    cheap = rng.uniform(size=CAMERAS) < _CHEAP
    frames = np.broadcast_to(np.sort(rng.uniform(0, _DURATION_S, FRAMES)), (CAMERAS, FRAMES))[..., None]
    taken = frames + cheap[:, None, None] * rng.uniform(-_EARLY_OR_LATE_S, _EARLY_OR_LATE_S, frames.shape)
    exposed = taken + np.where(cheap, _CHEAP_EXPOSURE_S, _EXPOSURE_S)[:, None, None] * np.linspace(-0.5, 0.5, _MOMENTS)
    points = motion.points(np.concatenate([frames, taken, exposed], axis=-1))[:, :, :, _CHOSEN]
    if invented:
        points = _with_arms_turned(points, rng)
    loose = rng.uniform(0.3, 1.7)
    aside = _DISPLACED_M * loose * _CLOTHED[:, None] * rng.normal(size=(CAMERAS, POINTS, 2)) @ rig.rotations[:, :2]
    true, labels = (_projected(rig, points[:, :, moment])[0] for moment in (0, 1))
    pixels, depth = _projected(rig, points[:, :, 2:] + aside[:, None, None])
    low, high = labels.amin(2), labels.amax(2)
    extent = (high - low).amax(-1) * (1 + 2 * _MARGIN)
    off_centre = torch.from_numpy(rng.uniform(-0.5, 0.5, low.shape)).float() * _MARGIN
    origin, scale = (low + high) / 2 + (off_centre - 0.5) * extent[..., None], extent / (SIZE - 1)
    images = _images(rng, rig, pixels, depth, origin, scale, cheap, loose)
    intrinsics, rotations, translations = map(torch.from_numpy, (rig.intrinsics, rig.rotations, rig.translations))
    stick_m = torch.tensor([motion.action.stick_m], dtype=torch.float64)
    return Sessions(images, origin, scale, labels, true, intrinsics, rotations, translations, stick_m)


def _with_arms_turned(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Points (C, F, T, P, 3) with arms and stick turned about the chest, and sticks of other lengths, in each image."""
    every = (CAMERAS, FRAMES, 1)
    axis = rng.normal(size=(*every, 3))
    x, y, z = np.moveaxis(axis / np.linalg.norm(axis, axis=-1, keepdims=True), -1, 0)
    zero = np.zeros(every)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(*every, 3, 3)
    angle = rng.uniform(-_TURN, _TURN, (*every, 1, 1))
    turn = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    start, end = points[..., START, :], points[..., END, :]
    points = points.copy()
    points[..., START, :] = start - rng.uniform(0.0, 0.3, (*every, 1)) * (end - start)
    points[..., END, :] = start + rng.uniform(0.7, 1.8, (*every, 1)) * (end - start)
    arms, chest = [*_ELBOWS, *_HANDS, START, END], points[..., list(_SHOULDERS), :].mean(-2, keepdims=True)
    points[..., arms, :] = chest + (points[..., arms, :] - chest) @ turn.swapaxes(-1, -2)
    return points


def _projected(rig: CameraRig, points: np.ndarray) -> tuple[Tensor, Tensor]:
    """Pixels (C, ..., 2) and depths (C, ...) of points (C, ..., 3), also outside the images."""
    shape = points.shape[:-1]
    local = points.reshape(CAMERAS, -1, 3) @ rig.rotations.swapaxes(1, 2) + rig.translations[:, None]
    homogeneous = local @ rig.intrinsics.swapaxes(1, 2)
    pixels = homogeneous[..., :2] / homogeneous[..., 2:]
    return torch.from_numpy(pixels.reshape(*shape, 2)).float(), torch.from_numpy(local[..., 2].reshape(shape)).float()


def _images(
    rng: np.random.Generator,
    rig: CameraRig,
    pixels: Tensor,
    depth: Tensor,
    origin: Tensor,
    scale: Tensor,
    cheap: np.ndarray,
    loose: float,
) -> Tensor:
    """Crops (C, F, 3, H, W), uint8, of points (C, F, T, P, 2) at depths (C, F, T, P), T moments of the exposure."""
    origin, scale = origin.flatten(0, 1), scale.flatten(0, 1)
    centre, reach = pixels.mean((1, 2, 3)), (pixels.amax((1, 2, 3)) - pixels.amin((1, 2, 3))).amax(-1)
    focal = torch.from_numpy(rig.intrinsics[:, 0, 0]).float().repeat_interleave(FRAMES)
    wall = torch.from_numpy(rng.uniform(0.2, 0.7, (CAMERAS, 3))).float().repeat_interleave(FRAMES, 0)
    behind = draw(_clutter(rng, centre, reach, *_BEHIND), wall[..., None, None].expand(-1, -1, SIZE, SIZE), origin, scale)
    body, picture = _Body.dressed(rng, loose), torch.zeros_like(behind)
    for moment in range(_MOMENTS):
        capsules = body.capsules(pixels[:, :, moment].flatten(0, 1), depth[:, :, moment].flatten(0, 1), focal)
        picture += draw(capsules, behind, origin, scale) / _MOMENTS
    picture = draw(_clutter(rng, centre, reach, *_BEFORE), picture, origin, scale)
    soft = torch.from_numpy(cheap).repeat_interleave(FRAMES)
    picture[soft] = gaussian_blur2d(picture[soft], (7, 7), (_SOFT_PX, _SOFT_PX))
    noise = torch.from_numpy(rng.standard_normal(picture.shape, dtype=np.float32))
    picture += noise * torch.where(soft, _CHEAP_NOISE, _NOISE)[:, None, None, None]
    return (picture.clamp_(0, 1) * 255).to(torch.uint8).unflatten(0, (CAMERAS, FRAMES))


@dataclass(frozen=True)
class _Body:
    """Limbs, trunk and stick as K capsules between points. Each has its own colour, so that a small network can learn it."""

    ends: Tensor
    """(K, 2), indices of points"""
    radius_m: Tensor
    """(K,)"""
    colour: Tensor
    """(K, 3)"""

    @staticmethod
    def dressed(rng: np.random.Generator, loose: float) -> _Body:
        """With clothes that are wider the looser they are."""
        wide = 0.8 + 0.3 * loose
        parts = [(0, 0, 0.11), (1, 1, 0.09 * wide), (*_SHOULDERS, 0.05 * wide)]
        for side in range(2):
            parts += [
                (_SHOULDERS[side], 1, 0.06 * wide),
                (_SHOULDERS[side], _ELBOWS[side], 0.05 * wide),
                (_ELBOWS[side], _HANDS[side], 0.05),
                (_HANDS[side], _HANDS[side], 0.045),
                (1, _KNEES[side], 0.065 * wide),
                (_KNEES[side], _ANKLES[side], 0.05 * wide),
                (_ANKLES[side], _ANKLES[side], 0.06),
            ]
        parts += [(START, END, 0.025), (START, START, 0.08), (END, END, 0.06)]
        first, second, radius = zip(*parts, strict=True)
        hues = (0.382 * np.arange(len(parts)) + rng.normal(0, 0.005, len(parts))) % 1
        colours = [colorsys.hsv_to_rgb(hue, *rng.uniform(0.6, 1.0, 2)) for hue in hues]
        return _Body(torch.tensor([first, second]).mT, torch.tensor(radius), torch.tensor(colours).float())

    def capsules(self, pixels: Tensor, depth: Tensor, focal: Tensor) -> Capsules:
        """In N images, of points (N, P, 2) at depths (N, P), from the farthest to the nearest; focal lengths are (N,)."""
        first, second = self.ends.unbind(1)
        middle = (depth[:, first] + depth[:, second]) / 2
        radius = self.radius_m * focal[:, None] / middle
        return Capsules(pixels[:, first], pixels[:, second], radius, self.colour.expand(len(pixels), -1, -1)).ordered(middle)


def _clutter(rng: np.random.Generator, centre: Tensor, reach: Tensor, count: int, thin: float, thick: float) -> Capsules:
    """Lines and spots around an athlete who is at a centre (C, 2) and has a reach (C,), the same in all frames."""
    place = rng.uniform(-0.8, 0.8, (CAMERAS, count, 2))
    along = rng.normal(0, 0.35, place.shape) * (rng.uniform(size=(CAMERAS, count, 1)) < 0.7)
    start, end = (centre[:, None] + reach[:, None, None] * torch.from_numpy(at).float() for at in (place, place + along))
    radius = reach[:, None] * torch.from_numpy(rng.uniform(thin, thick, (CAMERAS, count))).float()
    colour = torch.from_numpy(rng.uniform(0, 1, (CAMERAS, count, 3))).float()
    return Capsules(*(values.repeat_interleave(FRAMES, 0) for values in (start, end, radius, colour)))
