"""Intrinsics against OpenCV, kornia and autograd."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch

from torchstickcal import Intrinsics, ObservationError
from torchstickcal.geometry import projection

MATRIX = torch.tensor([[1400.0, 2.0, 960.0], [0.0, 1390.0, 540.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
LENSES = {
    "perfect": (None, False),
    "four": ([-0.3, 0.1, 0.001, -0.002], False),
    "five": ([-0.33, 0.15, -0.0013, 0.003, -0.03], False),
    "eight": ([-0.2, 0.05, 0.001, -0.001, 0.01, 0.1, -0.02, 0.003], False),
    "thin prism": ([-0.2, 0.05, 0.001, -0.001, 0.01, 0.1, -0.02, 0.003, 0.002, -0.001, 0.0015, 0.0005], False),
    "tilted": ([-0.2, 0.05, 0.001, -0.001, 0.01, 0.1, -0.02, 0.003, 0.002, -0.001, 0.0015, 0.0005, 0.03, -0.02], False),
    "fisheye": ([-0.02, 0.01, -0.004, 0.001], True),
}


def cameras(lens: str) -> Intrinsics:
    coefficients, fisheye = LENSES[lens]
    distortion = None if coefficients is None else torch.tensor([coefficients], dtype=torch.float64).expand(2, -1)
    return Intrinsics(MATRIX.expand(2, 3, 3), distortion, fisheye)


def points(count: int = 50) -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    xy = torch.rand(2, count, 2, generator=generator, dtype=torch.float64) - 0.5
    return torch.cat([xy * 3, 3 + torch.rand(2, count, 1, generator=generator, dtype=torch.float64)], dim=-1)


@pytest.mark.parametrize("lens", LENSES)
def test_projection_is_opencvs(lens: str):
    coefficients, fisheye = LENSES[lens]
    matrix = MATRIX.numpy()
    for camera, seen in zip(cameras(lens).project(points()), points().numpy(), strict=True):
        if fisheye:
            normalised = np.ascontiguousarray(seen[:, None, :2] / seen[:, None, 2:])
            distorted = cv2.fisheye.distortPoints(normalised, np.eye(3), np.array(coefficients))[:, 0]
            expected = np.c_[distorted, np.ones(len(distorted))] @ matrix[:2].T
        else:
            distorted, _ = cv2.projectPoints(seen, np.zeros(3), np.zeros(3), np.eye(3), np.array(coefficients or [0.0] * 5))
            expected = np.c_[distorted[:, 0], np.ones(len(distorted))] @ matrix[:2].T
        np.testing.assert_allclose(camera.numpy(), expected, atol=1e-9)


@pytest.mark.parametrize("lens", LENSES)
def test_projection_is_kornias(lens: str):
    torch.testing.assert_close(projection.project(points(), cameras(lens)), cameras(lens).project(points()), rtol=0, atol=1e-11)


def test_projection_by_kornia_has_a_gradient_by_the_skew():
    matrix = torch.eye(3, dtype=torch.float64)[None].requires_grad_()
    projection.project(points()[:1], Intrinsics(matrix)).sum().backward()
    assert matrix.grad is not None
    expected = (points()[:1, :, 1] / points()[:1, :, 2]).sum()
    assert float(matrix.grad[0, 0, 1]) == pytest.approx(float(expected))


def test_conversion_to_and_from_kornias_camera():
    size, rotations = torch.tensor([1920, 1080]), torch.linalg.qr(points()[:, :3])[0]
    perfect = Intrinsics(MATRIX.expand(2, 3, 3) * (1 - torch.tensor([[0.0, 1, 0], [0, 0, 0], [0, 0, 0]])))
    camera = perfect.to_kornia(size, rotations, points()[:, 0])
    seen = projection.to_cameras(points()[:1], rotations, points()[:, 0])[:, 0]
    torch.testing.assert_close(camera.project(points()[:1].expand(2, -1, -1)), perfect.project(seen), rtol=0, atol=1e-9)
    assert (camera.width.tolist(), camera.height.tolist()) == ([1920, 1920], [1080, 1080])
    torch.testing.assert_close(Intrinsics.from_kornia(camera).matrix, perfect.matrix)
    with pytest.raises(ObservationError, match=r"distorted lens does not fit.*Undistort the keypoints"):
        cameras("four").to_kornia(size)


@pytest.mark.parametrize("lens", LENSES)
def test_jacobian_is_autograds(lens: str):
    u, v = (c.requires_grad_() for c in (0.5 * points()[..., :2]).unbind(-1))
    found = cameras(lens).pixels_with_jacobian(u, v)
    for pixel, slopes in ((found.x, (found.dx_du, found.dx_dv)), (found.y, (found.dy_du, found.dy_dv))):
        for coordinate, slope in zip((u, v), slopes, strict=True):
            (expected,) = torch.autograd.grad(
                pixel.sum(), coordinate, retain_graph=True, allow_unused=True, materialize_grads=True
            )
            torch.testing.assert_close(slope.detach().expand_as(expected), expected, rtol=1e-10, atol=1e-8)
    torch.testing.assert_close((found.x, found.y), cameras(lens).project_components(u, v, torch.ones_like(u)))


@pytest.mark.parametrize("lens", LENSES)
def test_curvature_is_autograds(lens: str):
    u, v = (0.5 * points()[..., :2]).unbind(-1)
    along_x, along_y = points()[..., 1], points()[..., 2]
    found = cameras(lens).pixel_curvature(u, v, along_x, along_y)
    u, v = u.requires_grad_(), v.requires_grad_()
    x, y = cameras(lens).pixels(u, v)
    first = torch.autograd.grad((along_x * x + along_y * y).sum(), (u, v), create_graph=True)
    if lens == "perfect":
        assert not any(bool(second.any()) for second in found)
        return
    uu, uv = torch.autograd.grad(first[0].sum(), (u, v), retain_graph=True)
    (vv,) = torch.autograd.grad(first[1].sum(), v)
    torch.testing.assert_close(found, (uu, uv, vv), rtol=1e-9, atol=1e-8)


@pytest.mark.parametrize("lens", LENSES)
def test_undistortion_inverts_projection(lens: str):
    x = points()
    rays = cameras(lens).undistort(cameras(lens).project(x))
    torch.testing.assert_close(rays, x[..., :2] / x[..., 2:], rtol=0, atol=1e-11)


def test_pixels_beyond_the_fold_of_the_lens_are_refused():
    """r (1 - 0.3 r^2) has its greatest value 0.703 at r = 1.054: no point is seen beyond it."""
    lens = Intrinsics(torch.eye(3, dtype=torch.float64)[None], torch.tensor([[-0.3, 0.0, 0.0, 0.0]], dtype=torch.float64))
    rays = lens.undistort(torch.tensor([[[0.69, 0.0], [0.71, 0.0], [1.5, 0.0], [float("nan"), 0.0]]], dtype=torch.float64))[0]
    assert rays[0].isfinite().all()
    assert abs(rays[0, 0] * (1 - 0.3 * rays[0, 0] ** 2) - 0.69) < 1e-12
    assert rays[0, 0] < 1.055
    assert rays[1:].isnan().all()
