"""Intrinsics against OpenCV and against autograd."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch

from torchstickcal import Intrinsics

MATRIX = torch.tensor([[1400.0, 2.0, 960.0], [0.0, 1390.0, 540.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
LENSES = {
    "perfect": (None, False),
    "four": ([-0.3, 0.1, 0.001, -0.002], False),
    "five": ([-0.33, 0.15, -0.0013, 0.003, -0.03], False),
    "eight": ([-0.2, 0.05, 0.001, -0.001, 0.01, 0.1, -0.02, 0.003], False),
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
def test_jacobian_is_autograds(lens: str):
    x = points().movedim(-1, 1).contiguous().requires_grad_()
    pixel_x, pixel_y, jacobian = cameras(lens).project_with_jacobian(*x.unbind(1))
    for row, pixel in enumerate((pixel_x, pixel_y)):
        (expected,) = torch.autograd.grad(pixel.sum(), x, retain_graph=True)
        torch.testing.assert_close(jacobian[:, row].detach(), expected, rtol=1e-10, atol=1e-8)
    expected_x, expected_y = cameras(lens).project_components(*x.unbind(1))
    torch.testing.assert_close((pixel_x, pixel_y), (expected_x, expected_y))


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
