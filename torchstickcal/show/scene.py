"""A calibrated scene as a triangle mesh, as TensorBoard's mesh plugin shows it: cameras, athlete and sticks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchstickcal.result import Calibration
from torchstickcal.show.look import COLOURS, camera_colour
from torchstickcal.show.skeleton import bones_of
from torchstickcal.show.space import frusta, plot_rotation

_FRUSTUM_EDGES = ((0, 1), (0, 2), (0, 3), (0, 4), (1, 2), (2, 3), (3, 4), (4, 1))
_EDGE = 0.025
"""Radius of the edges of a camera's pyramid, as a fraction of their length."""
_TUBE_CORNERS = 6
_BONE_M, _STICK_M, _POINT_M = 0.025, 0.02, 0.04
"""Radii of what is drawn."""
_Y_UP = ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, -1.0, 0.0))
"""From z up to y up, as the mesh plugin has it."""


@dataclass(frozen=True)
class Mesh:
    """Triangles with a colour for each corner."""

    vertices: Tensor
    """(n, 3), metres, y up"""
    colours: Tensor
    """(n, 3), 0 to 255"""
    faces: Tensor
    """(m, 3), corners of the triangles"""

    @staticmethod
    def of(parts: Sequence[tuple[Tensor, Tensor]], colours: Sequence[tuple[int, int, int]]) -> Mesh:
        """Parts, each of vertices and faces, as one mesh."""
        starts = torch.tensor([0, *(len(vertices) for vertices, _ in parts)]).cumsum(0).tolist()
        painted = [
            torch.tensor([colour]).expand(len(vertices), 3) for (vertices, _), colour in zip(parts, colours, strict=True)
        ]
        return Mesh(
            torch.cat([vertices for vertices, _ in parts]).float(),
            torch.cat(painted).int(),
            torch.cat([faces + start for (_, faces), start in zip(parts, starts, strict=False)]).int(),
        )


def scene_mesh(calibration: Calibration, frame: int) -> Mesh:
    """The cameras as pyramids, and the athlete's points, bones and sticks in one frame, around the middle of the cameras.

    Args:
        calibration: what was found.
        frame: one of the common frames.
    """
    rotation = torch.tensor(_Y_UP, dtype=torch.float64) @ plot_rotation(calibration)
    cameras = frusta(calibration).cpu() @ rotation.mT
    points = calibration.points[frame].detach().double().cpu() @ rotation.mT
    middle = cameras[:, 0].mean(0)
    cameras, points = cameras - middle, points - middle
    bones = bones_of(calibration.point_names)
    thickness = _EDGE * float((cameras[0, 1] - cameras[0, 0]).norm())
    parts = [_tubes(corners, _FRUSTUM_EDGES, thickness) for corners in cameras]
    colours = [camera_colour(number).rgb for number in range(len(cameras))]
    sticks = [stick.ends for stick in calibration.sticks]
    for shape in (_tubes(points, bones, _BONE_M), _octahedra(points, _POINT_M), _tubes(points, sticks, _STICK_M)):
        parts.append(shape)
        colours.append(COLOURS["body"].rgb)
    colours[-1] = COLOURS["stick"].rgb
    return Mesh.of(parts, colours)


def mesh_view(calibration: Calibration) -> dict[str, Any]:
    """How TensorBoard's mesh plugin shows such a mesh: a camera that sees all of it, light from two sides."""
    centres = calibration.camera_centres.detach().double()
    return {
        "camera": {"cls": "PerspectiveCamera", "fov": 60, "far": 100 * float(torch.cdist(centres, centres).max())},
        "lights": [
            {"cls": "AmbientLight", "color": "#ffffff", "intensity": 0.75},
            {"cls": "DirectionalLight", "color": "#ffffff", "intensity": 0.5, "position": [0.5, 1.0, 1.0]},
        ],
        "material": {"cls": "MeshStandardMaterial", "roughness": 1, "metalness": 0, "side": 2},
    }


def _tubes(points: Tensor, pairs: Sequence[tuple[int, int]], radius: float) -> tuple[Tensor, Tensor]:
    """A prism between each pair of points that are known."""
    ends = points[torch.tensor(pairs, dtype=torch.long).view(-1, 2)]
    first, second = ends[ends.isfinite().all((1, 2))].unbind(1)
    along = torch.nn.functional.normalize(second - first, dim=1)
    across = torch.linalg.cross(along, torch.eye(3).to(along)[along.abs().argmin(1)])
    side = torch.nn.functional.normalize(across, dim=1)
    angle = 2 * torch.pi * torch.arange(_TUBE_CORNERS).to(along) / _TUBE_CORNERS
    ring = angle.cos()[:, None] * side[:, None] + angle.sin()[:, None] * torch.linalg.cross(along, side)[:, None]
    vertices = torch.cat([first[:, None] + radius * ring, second[:, None] + radius * ring], dim=1)
    number = torch.arange(_TUBE_CORNERS)
    after, other = (number + 1) % _TUBE_CORNERS, number + _TUBE_CORNERS
    faces = torch.cat([torch.stack([number, after, other], 1), torch.stack([after, after + _TUBE_CORNERS, other], 1)])
    return vertices.flatten(0, 1), _repeated(faces, len(first), 2 * _TUBE_CORNERS)


def _octahedra(points: Tensor, radius: float) -> tuple[Tensor, Tensor]:
    """A small body around each point that is known."""
    known = points[points.isfinite().all(-1)]
    corners = radius * torch.cat([torch.eye(3), -torch.eye(3)]).to(points)
    faces = torch.cartesian_prod(torch.tensor([0, 3]), torch.tensor([1, 4]), torch.tensor([2, 5]))
    return (known[:, None] + corners).flatten(0, 1), _repeated(faces, len(known), 6)


def _repeated(faces: Tensor, count: int, corners: int) -> Tensor:
    """The faces of equal bodies, one after another."""
    return (corners * torch.arange(count)[:, None, None] + faces).flatten(0, 1)
