"""Cameras of other libraries: the same pixels by each library's own documented rule, and the way back."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from torchstickcal import CalibrationError, CalibrationLayer, Intrinsics
from torchstickcal.bridges import PinholeCameras
from torchstickcal.geometry import se3
from torchstickcal.simulate import golf_session


def cameras(*leading: int, dtype: torch.dtype = torch.float64) -> PinholeCameras:
    generator = torch.Generator().manual_seed(0)
    tangents = torch.randn(*leading, 6, generator=generator, dtype=torch.float64)
    rotations, translations = se3.exp(tangents)
    matrix = torch.tensor([[900.0, 0, 650], [0, 910, 350], [0, 0, 1]], dtype=torch.float64).expand(*leading, 3, 3)
    size = torch.tensor([1280.0, 720], dtype=torch.float64).expand(*leading, 2)
    return PinholeCameras(*(value.to(dtype) for value in (rotations, translations, matrix, size)))


def points_of(given: PinholeCameras) -> tuple[Tensor, Tensor]:
    """A point in front of each camera, and where it appears."""
    generator = torch.Generator().manual_seed(1)
    in_camera = torch.randn(given.translations.shape, generator=generator, dtype=torch.float64)
    in_camera[..., 2] = 4.0 + in_camera[..., 2].abs()
    world = (given.rotations.mT @ (in_camera - given.translations)[..., None])[..., 0]
    seen = (given.intrinsics @ in_camera[..., None])[..., 0]
    return world, seen[..., :2] / seen[..., 2:]


def assert_same(found: PinholeCameras, expected: PinholeCameras) -> None:
    for name in ("rotations", "translations", "intrinsics", "image_size"):
        torch.testing.assert_close(getattr(found, name), getattr(expected, name), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("leading", [(3,), (2, 3)])
def test_kornia_projects_to_the_same_pixels(leading: tuple[int, ...]):
    given = cameras(*leading)
    world, pixels = points_of(given)
    camera = given.to_kornia()
    torch.testing.assert_close(camera.project(world.reshape(-1, 1, 3))[:, 0], pixels.reshape(-1, 2))
    flat = PinholeCameras(*(value.flatten(0, len(leading) - 1) for value in vars(given).values()))
    assert_same(PinholeCameras.from_kornia(camera), flat)


@pytest.mark.parametrize("leading", [(3,), (2, 3)])
def test_pytorch3d_projects_to_the_same_pixels(leading: tuple[int, ...]):
    given = cameras(*leading)
    world, pixels = points_of(given)
    fields = given.to_pytorch3d()
    x, y, z = ((world[..., None, :] @ fields["R"])[..., 0, :] + fields["T"]).unbind(-1)
    height, width = fields["image_size"].unbind(-1)
    scale = (
        torch.minimum(height, width) / 2
    )  # normalised device coordinates: x to the left, y up, the shorter side from -1 to 1
    focal, centre = fields["focal_length"] / scale[..., None], fields["principal_point"]
    x_ndc = focal[..., 0] * x / z - (centre[..., 0] - width / 2) / scale
    y_ndc = focal[..., 1] * y / z - (centre[..., 1] - height / 2) / scale
    screen = torch.stack([width / 2 - scale * x_ndc, height / 2 - scale * y_ndc], dim=-1)
    torch.testing.assert_close(screen, pixels)
    fields.pop("in_ndc")
    assert_same(PinholeCameras.from_pytorch3d(**fields), given)


@pytest.mark.parametrize("leading", [(), (3,), (2, 3)])
def test_opengl_and_nerfstudio_see_the_same_pixels(leading: tuple[int, ...]):
    given = cameras(*leading)
    world, pixels = points_of(given)
    fields = given.to_nerfstudio()
    pose = given.to_opengl()
    assert torch.equal(pose[..., :3, :], fields["camera_to_worlds"])
    in_camera = torch.linalg.solve(pose, torch.cat([world, torch.ones_like(world[..., :1])], dim=-1))
    x, y, z = in_camera[..., :3].split(1, dim=-1)
    u, v = fields["fx"] * x / -z + fields["cx"], fields["cy"] - fields["fy"] * y / -z  # y up, and -z is forward
    torch.testing.assert_close(torch.cat([u, v], dim=-1) - 0.5, pixels)
    assert_same(PinholeCameras.from_nerfstudio(**fields), given)
    assert_same(PinholeCameras.from_opengl(pose, given.intrinsics, given.image_size), given)


def test_nothing_is_lost_silently():
    given = cameras(3)
    without = PinholeCameras(given.rotations, given.translations, given.intrinsics)
    for convert in (without.to_kornia, without.to_pytorch3d, without.to_nerfstudio):
        with pytest.raises(CalibrationError, match="image_size"):
            convert()
    skewed = given.intrinsics.clone()
    skewed[..., 0, 1] = 2.0
    oblique = PinholeCameras(given.rotations, given.translations, skewed, given.image_size)
    for convert in (oblique.to_pytorch3d, oblique.to_nerfstudio):
        with pytest.raises(CalibrationError, match="skew"):
            convert()
    torch.testing.assert_close(PinholeCameras.from_kornia(oblique.to_kornia()).intrinsics, skewed)


def test_of_a_result_with_gradients_and_without_distortion():
    observations, _ = golf_session(cameras=3, frames=6)
    keypoints = torch.stack([observations.keypoints, observations.keypoints + 1.0]).float().requires_grad_()
    layer, matrix = CalibrationLayer(observations.sticks), observations.intrinsics
    found = PinholeCameras.of(layer(keypoints, matrix), image_size=(1920, 1080))
    camera = found.to_kornia()
    assert camera.extrinsics.shape == (6, 4, 4)
    assert camera.extrinsics.dtype == torch.float32
    (gradient,) = torch.autograd.grad(found.to_opengl()[:, 1:].sum(), keypoints)
    assert float(gradient.nan_to_num().abs().max()) > 0
    with pytest.raises(CalibrationError, match="distortion"):
        PinholeCameras.of(layer(keypoints, Intrinsics(matrix.expand(3, 3, 3), torch.full((3, 5), 0.01))))
