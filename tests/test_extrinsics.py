"""The module of camera poses."""

from __future__ import annotations

import pytest
import torch

from torchstickcal import Extrinsics, Intrinsics, ObservationError
from torchstickcal.geometry import se3
from torchstickcal.losses import ReprojectionLoss


def poses(count: int = 4):
    torch.manual_seed(1)
    return se3.exp(torch.randn(count, 6, dtype=torch.float64))


def test_starts_at_its_anchor_and_keeps_the_first_camera():
    rotations, translations = poses()
    extrinsics = Extrinsics(rotations, translations)
    extrinsics.tangents.data.normal_()
    moved_rotations, moved_translations = extrinsics()
    torch.testing.assert_close(moved_rotations[0], rotations[0])
    torch.testing.assert_close(moved_translations[0], translations[0])
    assert not torch.allclose(moved_rotations[1], rotations[1])


def test_gradients_are_right_and_none_reaches_the_first_camera():
    extrinsics = Extrinsics(*poses())

    def outputs(tangents: torch.Tensor):
        return torch.func.functional_call(extrinsics, {"tangents": tangents}, ())

    tangents = (0.1 * torch.randn(4, 6, dtype=torch.float64)).requires_grad_()
    assert torch.autograd.gradcheck(outputs, tangents)
    torch.stack([o.sum() for o in outputs(tangents)]).sum().backward()
    assert tangents.grad is not None
    assert (tangents.grad[0] == 0).all()
    assert (tangents.grad[1:] != 0).any(dim=1).all()


def test_reanchoring_keeps_the_poses():
    extrinsics = Extrinsics(*poses())
    extrinsics.tangents.data.normal_(std=0.3)
    before = extrinsics()
    extrinsics.reanchor()
    assert (extrinsics.tangents == 0).all()
    torch.testing.assert_close(extrinsics(), before)


def test_state_dict_round_trip():
    extrinsics = Extrinsics(*poses())
    extrinsics.tangents.data.normal_(std=0.3)
    other = Extrinsics(torch.eye(3, dtype=torch.float64).expand(4, 3, 3), torch.zeros(4, 3, dtype=torch.float64))
    other.load_state_dict(extrinsics.state_dict())
    torch.testing.assert_close(other(), extrinsics())


def test_conversion_to_and_from_kornias_transforms():
    extrinsics = Extrinsics(*poses())
    extrinsics.tangents.data.normal_(std=0.3)
    transforms = extrinsics.to_kornia()
    points = torch.randn(4, 3, dtype=torch.float64)
    rotations, translations = extrinsics()
    expected = (rotations @ points[..., None])[..., 0] + translations
    torch.testing.assert_close(transforms * points, expected)
    torch.testing.assert_close(Extrinsics.from_kornia(transforms)(), (rotations, translations))
    cameras = Intrinsics(torch.eye(3, dtype=torch.float64).expand(4, 3, 3)).to_kornia(torch.tensor([10, 10]), *extrinsics())
    torch.testing.assert_close(Extrinsics.from_kornia(cameras)(), (rotations, translations))


def test_an_optimiser_of_torch_finds_the_poses(perfect):
    observations, truth = perfect
    rotations, translations = se3.retract(
        truth.rotations, truth.translations, 0.02 * torch.ones(4, 6, dtype=torch.float64) * torch.tensor([[0], [1], [1], [1]])
    )
    extrinsics, loss = Extrinsics(rotations, translations), ReprojectionLoss()
    optimiser = torch.optim.Adam(extrinsics.parameters(), lr=2e-3)
    for _ in range(300):
        optimiser.zero_grad()
        value = loss(truth.points, *extrinsics(), observations.keypoints, observations.cameras)
        value.backward()
        optimiser.step()
    assert (extrinsics()[1] - truth.translations).abs().max() < 2e-3


def test_wrong_shapes_are_refused():
    with pytest.raises(ObservationError, match="expected \\(C, 3, 3\\) and \\(C, 3\\)"):
        Extrinsics(torch.eye(3), torch.zeros(3))


def test_arrays_and_lists_are_accepted_and_other_shapes_refused():
    rotations, translations = poses()
    found = Extrinsics(rotations.numpy(), translations.tolist())()
    assert torch.equal(found[0], Extrinsics(rotations, translations)()[0])
    assert Extrinsics(rotations.float().requires_grad_(), translations)()[1].dtype == torch.float64
    for wrong in ((rotations, translations[..., None]), (rotations[0], translations[0]), (rotations[:0], translations[:0])):
        with pytest.raises(ObservationError, match="poses have the wrong shape"):
            Extrinsics(*wrong)
    with pytest.raises(ObservationError, match=r"not an array of numbers \(translations\)"):
        Extrinsics(rotations, None)
