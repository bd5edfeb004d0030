"""Sessions of fixed cameras: athletes and sticks of the simulator, drawn as small colour images, with labels that are wrong."""

from __future__ import annotations

import colorsys
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from torchstickcal import Stick
from torchstickcal.simulate import Lens, Motion, action
from torchstickcal.simulate.paths import Path
from torchstickcal.simulate.rigs import CameraRig, camera_rig
from torchstickcal.simulate.skeleton import JOINT_INDEX, JOINTS, PARENTS, Skeleton

CAMERAS, SIZE = 6, 64
SWINGS, FRAMES = 4, 8
"""Number of actions of a session, and of images of each action."""
SPORTS = ("golf", "baseball", "hockey", "kendo")
SIDES = ("left", "right")
TRACKED = ("head", *(f"{side}_{joint}" for side in SIDES for joint in ("shoulder", "elbow", "hand", "knee", "ankle")))
POINTS = len(TRACKED) + 2

_FPS = 8.0
_FOCAL_PX = 78.0
_LIMB_PX, _STICK_PX, _BLUR = 1.3, 0.8, 1.5
_CLUTTER = 14
_DISPLACED_VIEWS, _DISPLACED_PX, _SCATTER_PX = 2, 3.0, 0.7
_AT_ONCE = 72


@dataclass(frozen=True)
class Sessions:
    """S sessions of F frames, seen by the C cameras of the venue."""

    images: Tensor
    """(S, C, F, 3, H, W), 0 to 1"""
    keypoints: Tensor
    """(S, C, F, P, 2), true keypoints, pixels"""


class Venue:
    """A fixed rig, the background of its images, and the errors of its labels.

    The labels of each point have a constant error in two views. These views differ from point to point.
    """

    def __init__(self, seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        lens = Lens(image_size=(SIZE, SIZE), focal_px=_FOCAL_PX)
        self.rig: CameraRig = camera_rig("ring", CAMERAS, rng, lens, radius_m=4.0)
        self.intrinsics = torch.from_numpy(self.rig.intrinsics)
        self.rotations, self.translations = torch.from_numpy(self.rig.rotations), torch.from_numpy(self.rig.translations)
        self._background = _clutter(rng)
        self._bias = _bias(rng)

    def sessions(self, first: int, count: int) -> Sessions:
        """Sessions ``first`` to ``first + count``. Sport, athlete and motion differ from action to action."""
        swings = range(first * SWINGS, (first + count) * SWINGS)
        images, keypoints = zip(*map(self._swing, swings), strict=True)

        def joined(tensors: tuple[Tensor, ...]) -> Tensor:
            return torch.stack([torch.cat(tensors[at : at + SWINGS], dim=1) for at in range(0, len(tensors), SWINGS)])

        return Sessions(joined(images), joined(keypoints))

    def _swing(self, seed: int) -> tuple[Tensor, Tensor]:
        rng = np.random.default_rng(seed)
        points = _points(SPORTS[seed % len(SPORTS)], seed, float(rng.uniform(1.6, 1.9)))
        pixels = torch.from_numpy(self.rig.project(np.broadcast_to(points, (CAMERAS, *points.shape)).copy()))
        noise = 0.05 * torch.from_numpy(rng.standard_normal((CAMERAS, FRAMES, 3, SIZE, SIZE), dtype=np.float32))
        return (_drawn(pixels, self._background) + noise).clamp(0, 1), pixels[:, :, _CHOSEN]

    def labels(self, sessions: Sessions, seed: int) -> Tensor:
        """Labels with their errors, (S, C, F, P, 2)."""
        scatter = torch.randn(sessions.keypoints.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
        return sessions.keypoints + self._bias[:, None] + _SCATTER_PX * scatter


def stick() -> Stick:
    """The stick of all sessions; the sticks of the sports are scaled to its length."""
    return Stick(POINTS - 2, POINTS - 1, _STICK_M)


_STICK_M = 1.0
_CHOSEN = [*(JOINT_INDEX[name] for name in TRACKED), len(JOINTS), len(JOINTS) + 1]
_BONES = [(JOINT_INDEX[parent], JOINT_INDEX[joint]) for joint, parent in PARENTS.items()] + [(len(JOINTS), len(JOINTS) + 1)]
_COLOURS = torch.tensor([colorsys.hsv_to_rgb(index / len(_BONES), 0.9, 0.95) for index in range(len(_BONES))])


def _points(sport: str, seed: int, height_m: float) -> np.ndarray:
    """All points (F, P, 3) of an action; the end of the stick is moved so that the stick has the common length."""
    motion = Motion(action(sport), Skeleton(height_m), Path("stay", 0.3), 0.25, 1.0, 1.0, seed)
    points = motion.points(np.arange(FRAMES) / _FPS)
    grip, tip = points[:, -2], points[:, -1]
    points[:, -1] = grip + (tip - grip) * (_STICK_M / motion.action.stick_m)
    return points


def _drawn(pixels: Tensor, background: Tensor) -> Tensor:
    """Images (C, F, 3, H, W) of limbs and stick, from points (C, F, P, 2), over a background (C, 3, H, W)."""
    rows, columns = torch.meshgrid(torch.arange(SIZE), torch.arange(SIZE), indexing="ij")
    grid = torch.stack([columns, rows], dim=-1).reshape(-1, 2).float()
    flat = pixels.flatten(0, 1).float()
    found = []
    for part, behind in zip(
        flat.nan_to_num(nan=-1e4).split(_AT_ONCE), background.repeat_interleave(FRAMES, 0).split(_AT_ONCE), strict=True
    ):
        picture = behind.flatten(2).clone()
        for number, (start, end) in enumerate(_BONES):
            along = part[:, end] - part[:, start]
            offset = grid - part[:, start, None]
            share = ((offset * along[:, None]).sum(-1) / along.square().sum(-1, keepdim=True).clamp_min(1e-6)).clamp(0, 1)
            distance = (offset - share[..., None] * along[:, None]).norm(dim=-1)
            width = _STICK_PX if number == len(_BONES) - 1 else _LIMB_PX
            cover = torch.sigmoid((width - distance) * 2 / _BLUR)[:, None]
            picture = picture + cover * (_COLOURS[number][:, None] - picture)
        found.append(picture.unflatten(2, (SIZE, SIZE)))
    return torch.cat(found).unflatten(0, pixels.shape[:2])


def _clutter(rng: np.random.Generator) -> Tensor:
    """A background of soft blobs of random colours, (C, 3, H, W)."""
    rows, columns = np.mgrid[:SIZE, :SIZE]
    picture = np.full((CAMERAS, 3, SIZE, SIZE), 0.35)
    for camera in range(CAMERAS):
        for _ in range(_CLUTTER):
            (x, y), radius = rng.uniform(0, SIZE, 2), rng.uniform(2, 10)
            blob = np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * radius**2))
            picture[camera] += blob * rng.uniform(-0.3, 0.3, 3)[:, None, None]
    return torch.from_numpy(picture.clip(0, 1)).float()


def _bias(rng: np.random.Generator) -> Tensor:
    """The constant errors of the labels, (C, P, 2)."""
    bias = np.zeros((CAMERAS, POINTS, 2))
    for point in range(POINTS):
        views = rng.choice(CAMERAS, _DISPLACED_VIEWS, replace=False)
        angle = rng.uniform(0, 2 * np.pi, _DISPLACED_VIEWS)
        bias[views, point] = _DISPLACED_PX * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return torch.from_numpy(bias)
