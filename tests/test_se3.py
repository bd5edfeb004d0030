"""Lie algebra: our plain matrices against torch.matrix_exp and kornia, and kornia's gradients where they once failed."""

from __future__ import annotations

import pytest
import torch
from kornia.geometry.liegroup import Se3, So3
from torch import Tensor

from torchstickcal.geometry import se3

SCALES = [0.0, 1e-9, 1e-5, 1e-3, 0.5, 2.0, 3.1]


def tangents(scale: float) -> Tensor:
    return scale * torch.nn.functional.normalize(torch.randn(7, 6, dtype=torch.float64), dim=-1)


@pytest.mark.parametrize("scale", SCALES)
def test_exponential_is_that_of_matrices(scale: float):
    v = tangents(scale)
    generator = torch.zeros(7, 4, 4, dtype=torch.float64)
    generator[:, :3, :3], generator[:, :3, 3] = se3.hat(v[:, 3:]), v[:, :3]
    expected = torch.matrix_exp(generator)
    rotation, translation = se3.exp(v)
    torch.testing.assert_close(rotation, expected[:, :3, :3], rtol=0, atol=1e-14)
    torch.testing.assert_close(translation, expected[:, :3, 3], rtol=0, atol=1e-14)


@pytest.mark.parametrize("scale", SCALES)
def test_exponential_is_kornias(scale: float):
    v = tangents(scale)
    rotation, translation = se3.exp(v)
    theirs = Se3.exp(v).matrix()
    torch.testing.assert_close(rotation, theirs[:, :3, :3], rtol=0, atol=1e-10)
    torch.testing.assert_close(translation, theirs[:, :3, 3], rtol=0, atol=1e-10)


@pytest.mark.parametrize("scale", [0.0, 1e-5, 0.5])
def test_kornias_derivatives_are_right_near_identity(scale: float):
    """kornia before 0.9 gave NaN or zeros at the identity."""
    v = tangents(scale)[:2].requires_grad_()
    assert torch.autograd.gradcheck(lambda x: Se3.exp(x).matrix(), v)
    assert torch.autograd.gradgradcheck(lambda x: Se3.exp(x).matrix(), v, atol=1e-4)
    w = v.detach()[:, 3:].clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda x: So3.exp(x).matrix(), w)


def test_retraction_moves_on_the_worlds_side():
    rotation, translation = se3.exp(tangents(1.0))
    step = tangents(0.3)
    moved_rotation, moved_translation = se3.retract(rotation, translation, step)
    point = torch.randn(3, dtype=torch.float64)
    step_rotation, step_translation = se3.exp(step)
    expected = (rotation @ (step_rotation @ point + step_translation)[..., None])[..., 0] + translation
    torch.testing.assert_close((moved_rotation @ point) + moved_translation, expected)


def test_centre_is_the_cameras_origin():
    rotation, translation = se3.exp(tangents(1.0))
    centre = se3.camera_centres(rotation, translation)
    assert ((rotation @ centre[..., None])[..., 0] + translation).abs().max() < 1e-14
