"""The paper's measure, on cases worked out by hand."""

from __future__ import annotations

import math

import pytest
import torch

from torchstickcal import ObservationError
from torchstickcal.geometry import se3
from torchstickcal.metrics import align, pose_errors, rotation_angle


def rig(count: int = 5, seed: int = 0):
    torch.manual_seed(seed)
    return se3.exp(2 * torch.randn(count, 6, dtype=torch.float64))


@pytest.mark.parametrize("count", [2, 3, 6])
def test_a_moved_world_is_no_error(count: int):
    rotations, translations = rig(count)
    world_rotation, world_translation = se3.exp(torch.randn(6, dtype=torch.float64))
    moved = rotations @ world_rotation, rotations @ world_translation + translations
    errors = pose_errors(*moved, rotations, translations)
    assert errors.rotation_deg.max() < 1e-12
    assert errors.translation_m.max() < 1e-13


def test_scale_is_an_error():
    rotations, translations = rig()
    errors = pose_errors(rotations, 1.1 * translations, rotations, translations)
    centres = se3.camera_centres(rotations, translations)
    expected = 0.1 * (centres - centres.mean(0)).norm(dim=1)
    torch.testing.assert_close(errors.translation_m, expected)


def test_two_cameras_are_aligned_by_the_first():
    rotations, translations = rig(2)
    turned = rotations.clone()
    turned[1] = se3.exp(torch.tensor([0, 0, 0, 0.01, 0, 0], dtype=torch.float64))[0] @ rotations[1]
    errors = pose_errors(turned, translations, rotations, translations)
    assert errors.rotation_deg[0] < 1e-12
    assert errors.rotation_deg[1].item() == pytest.approx(math.degrees(0.01))


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-9, 1e-4, 1.0, 3.1, math.pi])
def test_angles_keep_their_digits(angle: float):
    axis = torch.nn.functional.normalize(torch.tensor([1.0, -2.0, 0.5], dtype=torch.float64), dim=0)
    rotation, _ = se3.exp(torch.cat([torch.zeros(3, dtype=torch.float64), angle * axis]))
    assert rotation_angle(rotation).item() == pytest.approx(angle, rel=1e-6, abs=1e-15)


def test_alignment_never_mirrors():
    torch.manual_seed(0)
    points = torch.randn(10, 3, dtype=torch.float64)
    rotation, _ = align(points, points * torch.tensor([-1.0, 1, 1]))
    assert torch.det(rotation).item() == pytest.approx(1.0)


def test_arrays_and_lists_are_measured_and_other_shapes_refused():
    rotations, translations = rig(3)
    expected = pose_errors(rotations, 1.1 * translations, rotations, translations).translation_m
    found = pose_errors(
        rotations.numpy(), (1.1 * translations).tolist(), rotations.numpy(), translations.tolist()
    ).translation_m
    assert torch.equal(found, expected)
    for wrong in (translations[0], translations[:2], translations[..., None], translations[None], None, "x"):
        with pytest.raises(ObservationError, match="translations"):
            pose_errors(rotations, wrong, rotations, translations)
        with pytest.raises(ObservationError, match="translations"):
            pose_errors(rotations, translations, rotations, wrong)
