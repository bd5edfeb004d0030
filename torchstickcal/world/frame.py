"""Frames of the world: where its origin is and how its axes lie."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from torchstickcal.geometry import se3

_NEVER_SURE_DEG = 0.1


@dataclass(frozen=True)
class World:
    """What the axes of a calibration are.

    Example:
        >>> World().name, World().up is None
        ('camera', True)
    """

    name: str = "camera"
    """``camera``, ``athlete``, ``floor``, ``points`` or ``calibration``"""
    origin: str = "the centre of the first camera"
    axes: str = "x to the right in its image, y down, z forward"
    up: str | None = None
    """the axis that points up: ``z``; None where none does, or where nobody knows"""
    vertical_std_deg: float | None = None
    """standard deviation of the angle between that axis and the true vertical, degrees; None where it is not estimated"""
    floor_std_m: float | None = None
    """standard deviation of the height of the floor, metres; None where it is not estimated"""

    @property
    def description(self) -> str:
        """The frame in one sentence.

        Example:
            >>> World().description
            'The origin is the centre of the first camera; x to the right in its image, y down, z forward.'
        """
        return f"The origin is {self.origin}; {self.axes}."


class Frame(NamedTuple):
    """A frame of the world, relative to the frame in which something was found: ``X_world = rotation X + translation``."""

    rotation: Tensor
    """(3, 3), float64"""
    translation: Tensor
    """(3,), float64, metres"""
    world: World

    def points(self, points: Tensor) -> Tensor:
        """Points (..., 3) in this frame."""
        return points @ self.rotation.mT + self.translation

    def poses(self, rotations: Tensor, translations: Tensor) -> tuple[Tensor, Tensor]:
        """Transforms from this frame to the cameras, of those (C, 3, 3), (C, 3) from the other."""
        turned = rotations @ self.rotation.mT
        return turned, translations - (turned @ self.translation[:, None])[..., 0]

    def covariance(self, covariance: Tensor) -> Tensor:
        """The covariance (6 n, 6 n) of n tangents that act in this frame: ``T' Exp(Ad xi) = T Exp(xi) F^-1``."""
        upper = torch.cat([self.rotation, se3.hat(self.translation) @ self.rotation], dim=1)
        lower = torch.cat([torch.zeros_like(self.rotation), self.rotation], dim=1)
        adjoint = torch.block_diag(*[torch.cat([upper, lower])] * (len(covariance) // 6))
        return adjoint @ covariance @ adjoint.mT


def upright_frame(up: Tensor, forward: Tensor, origin: Tensor, world: World) -> Frame:
    """The frame with z upward, x in a direction (3,) as far as it is horizontal, and an origin (3,)."""
    z = up / up.norm()
    x = forward - (forward @ z) * z
    x = x / x.norm()
    rotation = torch.stack([x, torch.linalg.cross(z, x), z])
    return Frame(rotation, -rotation @ origin, world)
