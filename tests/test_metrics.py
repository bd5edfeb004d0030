"""The paper's measure, on cases worked out by hand."""

from __future__ import annotations

import math

import pytest
import torch

from torchstickcal import ObservationError
from torchstickcal.geometry import se3
from torchstickcal.metrics import PoseErrorMetric, align, pose_errors, rotation_angle


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


def ring(count: int = 4) -> tuple[torch.Tensor, torch.Tensor]:
    """Cameras around a circle: their centres are spread alike in two directions."""
    angles = 2 * math.pi * torch.arange(count, dtype=torch.float64) / count
    rotations, _ = se3.exp(torch.stack([0 * angles] * 4 + [angles, 0 * angles], dim=-1))
    return rotations, torch.tensor([0.0, 0.0, 4.0], dtype=torch.float64).expand(count, 3).clone()


@pytest.mark.parametrize("alignment", ["rigid", "similarity", "first_camera", "none"])
@pytest.mark.parametrize("poses", [rig, ring, lambda: rig(2)], ids=["rig", "ring", "two cameras"])
def test_errors_have_the_gradients_of_differences(poses, alignment):
    rotations, translations = poses()
    moved = se3.retract(rotations, translations, 0.05 * torch.randn(len(rotations), 6, dtype=torch.float64))
    true = torch.stack([rotations, rotations]), torch.stack([translations, translations + 0.1])

    def total(rotations, translations):
        errors = pose_errors(torch.stack([rotations] * 2), torch.stack([translations] * 2), *true, alignment)
        return errors.rotation_deg.sum() + errors.translation_m.square().sum()

    leaves = [value.clone().requires_grad_() for value in moved]
    found = torch.autograd.grad(total(*leaves), leaves)
    for number, value in enumerate(moved):
        direction = torch.randn_like(value)
        if number == 0:  # along rotations
            direction = value @ se3.hat(torch.randn(len(value), 3, dtype=torch.float64))
        ahead, behind = (
            total(*(v + sign * 1e-6 * direction if n == number else v for n, v in enumerate(moved))) for sign in (1, -1)
        )
        expected = float(ahead - behind) / 2e-6
        assert float((found[number] * direction).sum()) == pytest.approx(expected, rel=1e-4, abs=1e-5)


@pytest.mark.parametrize("alignment", ["rigid", "similarity", "first_camera", "none"])
@pytest.mark.parametrize("poses", [rig, ring, lambda: rig(2)], ids=["rig", "ring", "two cameras"])
def test_gradients_are_finite_where_the_error_is_zero(poses, alignment):
    true = poses()
    leaves = [value.clone().requires_grad_() for value in true]
    errors = pose_errors(*leaves, *true, alignment)
    (errors.rotation_deg.sum() + errors.translation_m.sum()).backward()
    assert errors.translation_m.max() < 1e-12
    assert all(leaf.grad.isfinite().all() for leaf in leaves)


def test_each_alignment_undoes_what_it_says():
    rotations, translations = rig()
    turn, shift = se3.exp(torch.randn(6, dtype=torch.float64))
    world = rotations @ turn, rotations @ shift + translations
    scaled = rotations, 1.3 * translations
    error = {name: pose_errors(*world, rotations, translations, name).translation_m.max() for name in ("none", "first_camera")}
    assert error["none"] > 0.1
    assert error["first_camera"] < 1e-12
    assert pose_errors(*scaled, rotations, translations, "rigid").translation_m.max() > 0.1
    assert pose_errors(*scaled, rotations, translations, "similarity").translation_m.max() < 1e-12
    with pytest.raises(ObservationError, match="alignment"):
        pose_errors(*scaled, rotations, translations, "affine")


def test_a_metric_accumulates_over_sessions_and_counts_failures():
    rotations, translations = rig()
    moved = torch.stack([translations * factor for factor in (1.1, 1.2, 1.3, 9.0)])
    poses = rotations.expand(4, -1, -1, -1), moved
    converged = torch.tensor([True, True, True, False])
    metric = PoseErrorMetric()
    assert all(value.isnan() for value in metric.compute().values())
    batch = metric(poses[0][:1], poses[1][:1], rotations, translations, converged[:1])
    metric.update(poses[0][1:], poses[1][1:], rotations, translations, converged[1:])
    means = [pose_errors(rotations, moved[k], rotations, translations).mean_translation_m for k in range(3)]
    found = metric.compute()
    assert float(batch["translation_m"]) == pytest.approx(means[0])
    assert float(found["translation_m"]) == pytest.approx(sum(means) / 3)
    assert float(found["translation_median_m"]) == pytest.approx(means[1])
    assert float(found["calibrated"]) == 0.75
    metric.reset()
    assert metric.compute()["calibrated"].isnan()
