"""A cube with a square marker on each face, seen by all cameras before the athlete comes: the classical calibration object."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from torchstickcal.simulate.rigs import SCENE_CENTRE, CameraRig
from torchstickcal.simulate.skeleton import unit

Array = NDArray[np.float64]

_NORMALS = np.array([[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], float)
_GRAZING = np.cos(np.deg2rad(75))


@dataclass(frozen=True)
class Cube:
    """The cube.

    Args:
        edge_m: its edge.
        marker_share: edge of a marker as a share of it.
        faces: 6 for a hanging cube, 5 for a standing one, whose lower face is not seen.
    """

    edge_m: float = 0.4
    marker_share: float = 0.8
    faces: int = 6

    @property
    def corners_m(self) -> Array:
        """The markers' corners (4 faces, 3) in the world, four after four, counter-clockwise seen from outside."""
        half = self.edge_m / 2
        corners = []
        for normal in _NORMALS[: self.faces]:
            right = np.array([0.0, 1.0, 0.0]) if normal[2] else np.cross([0.0, 0.0, 1.0], normal)
            up = np.cross(normal, right)
            for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1)):
                corners.append(half * normal + self.marker_share * half * (x * right + y * up))
        return np.array(SCENE_CENTRE) + np.array(corners)

    def seen_by(self, rig: CameraRig, sigma_px: float, rng: np.random.Generator) -> CubeViews:
        """The corners in the images: of markers turned towards the camera, up to 75 degrees, and wholly in its image."""
        corners = self.corners_m
        faces = corners.reshape(-1, 4, 3)
        sight = unit(rig.centres[:, None] - faces.mean(1))
        turned = (sight * _NORMALS[: self.faces]).sum(-1) > _GRAZING
        keypoints = rig.project(np.broadcast_to(corners, (len(rig.centres), *corners.shape)))
        whole = np.isfinite(keypoints).reshape(len(keypoints), -1, 8).all(-1)
        seen = np.repeat(turned & whole, 4, axis=1)
        keypoints = keypoints + sigma_px * rng.standard_normal(keypoints.shape)
        return CubeViews(corners, np.where(seen[..., None], keypoints, np.nan))


@dataclass(frozen=True, eq=False)
class CubeViews:
    """A cube as the cameras saw it."""

    corners_m: Array
    """(K, 3), the corners in the world, four for each marker"""
    keypoints: Array
    """(C, K, 2) pixels, NaN where not seen"""
