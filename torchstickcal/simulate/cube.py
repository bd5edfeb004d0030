"""A calibration object: a cube with a square marker on each face, recorded by all cameras in the empty scene."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from torchstickcal.simulate.rigs import SCENE_CENTRE, CameraRig
from torchstickcal.simulate.skeleton import unit

Array = NDArray[np.float64]

_NORMALS = np.array([[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], float)
_MIN_COSINE = np.cos(np.deg2rad(75))


@dataclass(frozen=True)
class Cube:
    """A cube in the centre of the scene with a square marker on each face.

    Args:
        edge_m: edge of the cube, metres.
        marker_share: edge of a marker as a share of the edge of the cube.
        faces: number of faces with a marker: 6 for a hanging cube, 5 for a cube that stands on its lower face.

    Example:
        >>> Cube(edge_m=0.4).corners_m.shape
        (24, 3)
    """

    edge_m: float = 0.4
    marker_share: float = 0.8
    faces: int = 6

    @property
    def corners_m(self) -> Array:
        """Corners of the markers in the world, (4 * faces, 3), metres; four per marker, counter-clockwise seen from outside."""
        half = self.edge_m / 2
        corners = []
        for normal in _NORMALS[: self.faces]:
            right = np.array([0.0, 1.0, 0.0]) if normal[2] else np.cross([0.0, 0.0, 1.0], normal)
            up = np.cross(normal, right)
            for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1)):
                corners.append(half * normal + self.marker_share * half * (x * right + y * up))
        return np.array(SCENE_CENTRE) + np.array(corners)

    def seen_by(self, rig: CameraRig, sigma_px: float, rng: np.random.Generator) -> CubeViews:
        """Keypoints of the corners with Gaussian noise.

        A camera sees a marker if the marker is completely in the image and its normal is less than 75 degrees from the
        direction to the camera.

        Args:
            rig: the cameras.
            sigma_px: standard deviation of the noise along each image axis, pixels.
            rng: random generator.
        """
        corners = self.corners_m
        faces = corners.reshape(-1, 4, 3)
        to_camera = unit(rig.centres[:, None] - faces.mean(1))
        facing = (to_camera * _NORMALS[: self.faces]).sum(-1) > _MIN_COSINE
        keypoints = rig.project(np.broadcast_to(corners, (len(rig.centres), *corners.shape)))
        complete = np.isfinite(keypoints).reshape(len(keypoints), -1, 8).all(-1)
        seen = np.repeat(facing & complete, 4, axis=1)
        keypoints = keypoints + sigma_px * rng.standard_normal(keypoints.shape)
        return CubeViews(corners, np.where(seen[..., None], keypoints, np.nan))


@dataclass(frozen=True, eq=False)
class CubeViews:
    """The keypoints of a cube."""

    corners_m: Array
    """(K, 3), the corners of the markers in the world, metres; four per marker"""
    keypoints: Array
    """(C, K, 2), pixels; NaN where not seen"""
