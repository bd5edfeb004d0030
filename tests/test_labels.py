"""Label errors: found by the other views and by time, undone, and said."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from torchstickcal import Calibration, CalibrationLayer, Observations, calibrate
from torchstickcal.metrics import pose_errors
from torchstickcal.pipeline.relabel.exchanges import exchanges, mirrored_pairs
from torchstickcal.show.report import summary
from torchstickcal.simulate import Noise, golf_session


def session(cameras: int = 4, frames: int = 40, sigma_px: float = 1.5):
    return golf_session(cameras=cameras, frames=frames, noise=Noise(sigma_px))


def chosen(observations: Observations, share: float, seed: int = 0) -> Tensor:
    """Some frames of every camera, (C, F)."""
    return torch.from_numpy(np.random.default_rng(seed).random(observations.keypoints.shape[:2]) < share)


def relabelled(observations: Observations, where: Tensor, pairs: list[tuple[int, int]]) -> Observations:
    order = torch.arange(observations.num_points)
    for first, second in pairs:
        order[[first, second]] = order[[second, first]]
    keypoints = observations.keypoints
    return replace(observations, keypoints=torch.where(where[..., None, None], keypoints[:, :, order], keypoints))


def body(observations: Observations) -> list[tuple[int, int]]:
    return list(mirrored_pairs(observations.point_names or ()))


def error_m(calibration: Calibration, truth) -> float:
    return float(
        pose_errors(calibration.rotations, calibration.translations, truth.rotations, truth.translations).mean_translation_m
    )


@pytest.mark.parametrize(
    "names",
    [
        ("left_hip", "right_hip"),
        ("LHip", "RHip"),
        ("l_hip", "r_hip"),
        ("hip_L", "hip_R"),
        ("hip.l", "hip.r"),
        ("leftHip", "rightHip"),
        ("Left Hip", "Right Hip"),
        ("lefthip", "righthip"),
        ("LBigToe", "RBigToe"),
    ],
)
def test_names_say_what_is_mirrored(names: tuple[str, str]):
    assert mirrored_pairs(["nose", names[1], "lip", names[0], "ear"]) == ((3, 1),)


def test_without_names_only_the_ends_of_sticks_are_exchanged():
    assert [exchange.pairs for exchange in exchanges(None, [(3, 5)])] == [((3, 5),)]


def test_a_stick_that_sounds_like_a_limb_is_one_and_a_limb_that_stands_in_is_none():
    assert [exchange.pairs for exchange in exchanges(("shinai_butt", "shinai_tip"), [(0, 1)])] == [((0, 1),)]
    assert exchanges(("left_knee", "left_ankle"), [(0, 1)]) == []


def test_nothing_changes_where_nothing_is_wrong():
    observations, _ = session(sigma_px=2.0)
    with_search, without = calibrate(observations), calibrate(observations, {"extends": "default", "relabel": False})
    assert not with_search.relabelled.any()
    assert not with_search.other_person.any()
    assert torch.equal(with_search.rotations, without.rotations)
    assert torch.equal(with_search.points.nan_to_num(), without.points.nan_to_num())


@pytest.mark.parametrize(("cameras", "share"), [(3, 0.1), (3, 0.3), (4, 0.3), (6, 0.3)])
def test_exchanges_of_left_and_right_are_undone(cameras: int, share: float):
    observations, truth = session(cameras)
    where = chosen(observations, share)
    clean, found = calibrate(observations), calibrate(relabelled(observations, where, body(observations)))
    assert torch.equal(found.relabelled.any(-1), where)
    assert error_m(found, truth) < 1.02 * error_m(clean, truth) + 1e-5
    assert sum("left and right of the body were exchanged" in warning for warning in found.warnings) == cameras
    assert [camera["frames_relabelled"] for camera in summary(found)["cameras"]] == where.sum(1).tolist()


@pytest.mark.parametrize("settings", [{"extends": "default", "precision": "float32"}, {"extends": "lbfgs"}])
def test_exchanges_are_undone_in_every_precision_and_solver(settings: dict[str, str]):
    observations, _ = session(3, 20)
    where = chosen(observations, 0.2)
    assert torch.equal(calibrate(relabelled(observations, where, body(observations)), settings).relabelled.any(-1), where)


def test_exchanges_of_the_legs_alone_are_undone():
    observations, _ = session()
    legs = [pair for pair in body(observations) if "knee" in observations.point_label(pair[0])]
    legs += [pair for pair in body(observations) if observations.point_label(pair[0]) in {"left_shin", "left_ankle"}]
    where = chosen(observations, 0.1)
    found = calibrate(relabelled(observations, where, legs)).relabelled
    assert (found.any(-1) & where).sum() > 0.9 * where.sum()
    assert not (found.any(-1) & ~where).any()


@pytest.mark.parametrize("named", [True, False])
def test_exchanges_of_the_ends_of_a_stick_are_undone(named: bool):
    observations, truth = session()
    where, clean = chosen(observations, 0.2), calibrate(observations)
    swapped = relabelled(observations, where, [observations.sticks[0].ends])
    found = calibrate(swapped if named else replace(swapped, point_names=None))
    assert (found.relabelled.any(-1) == where).double().mean() > 0.97
    assert error_m(found, truth) < 1.1 * error_m(clean, truth) + 1e-4


def test_keypoints_that_are_often_wrong_are_no_other_person():
    """Few agree in some frames by chance, and the verdict says that many are wrong, not that a camera is."""
    observations, truth = session(cameras=5, frames=16)
    random = np.random.default_rng(3)
    anywhere = random.uniform(0, 1000, observations.keypoints.shape)
    wrong = random.random(observations.keypoints.shape[:3]) < 0.48
    keypoints = np.where(wrong[..., None] & observations.visible.numpy()[..., None], anywhere, observations.keypoints.numpy())
    found = calibrate(replace(observations, keypoints=torch.from_numpy(keypoints)))
    assert error_m(found, truth) < 0.05
    assert found.other_person.sum() <= 1
    assert found.quality.verdict.acceptable


def test_another_person_is_set_aside():
    observations, truth = session()
    where = chosen(observations, 0.2) & torch.tensor([True, False, False, False])[:, None]
    moved = observations.keypoints.roll(12, 1) + torch.tensor([250.0, 20.0])
    found = calibrate(replace(observations, keypoints=torch.where(where[..., None, None], moved, observations.keypoints)))
    assert torch.equal(found.other_person, where)
    assert not found.inliers[where].any()
    unseen = replace(observations, keypoints=observations.keypoints.masked_fill(where[..., None, None], torch.nan))
    assert error_m(found, truth) == pytest.approx(error_m(calibrate(unseen), truth), rel=0.02)
    assert any("another person" in warning for warning in found.warnings)


def test_labels_are_saved(tmp_path: Path):
    observations, _ = session(3)
    found = calibrate(relabelled(observations, chosen(observations, 0.2), body(observations)))
    found.save(tmp_path / "points.npz")
    back = Calibration.load(tmp_path / "points.npz")
    assert torch.equal(back.keypoint_index, found.keypoint_index)
    assert torch.equal(back.other_person, found.other_person)


def test_residuals_are_those_of_the_keypoints_used():
    observations, _ = session(3)
    found = calibrate(relabelled(observations, chosen(observations, 0.3), body(observations)))
    assert float(found.residuals_px[found.inliers].norm(dim=-1).quantile(0.99)) < 12
    assert found.inliers.double().mean() > 0.99


def test_the_published_method_does_not_relabel():
    observations, _ = session(3, 20)
    assert not calibrate(relabelled(observations, chosen(observations, 0.2), body(observations)), "paper").relabelled.any()


def test_gradients_of_the_layer_flow_to_the_keypoints_used():
    observations, _ = session(3, 12)
    flipped = relabelled(observations, chosen(observations, 0.2), body(observations))
    known = {"reprojection": {"sigma_px": 1.0, "correlation_frames": 1.0}, "reject_sigmas": False}
    settings = {"extends": "default", "stages": dict.fromkeys(("metric", "selected", "refined"), known)}
    settings["stages"] |= {"trajectories": known | {"smoothness": {"sigma_m": 0.1}}}
    layer = CalibrationLayer(observations.sticks, settings, point_names=observations.point_names)
    keypoints = flipped.keypoints.clone().requires_grad_()
    direction = torch.from_numpy(np.random.default_rng(1).normal(size=keypoints.shape))

    def value(keypoints: Tensor) -> Tensor:
        return layer(keypoints, observations.cameras).translations.square().sum()

    result = layer(keypoints, observations.cameras)
    assert torch.equal(result.keypoint_index, calibrate(flipped, settings).keypoint_index)
    assert (result.keypoint_index != torch.arange(observations.num_points)).any()
    slope = float((torch.autograd.grad(value(keypoints), keypoints)[0] * direction).sum())
    step = 1e-4
    with torch.no_grad():
        difference = float(value(keypoints + step * direction) - value(keypoints - step * direction)) / (2 * step)
    assert slope == pytest.approx(difference, rel=1e-2)


def test_a_warm_start_finds_the_labels_too():
    observations, _ = session(3, 20)
    flipped = relabelled(observations, chosen(observations, 0.2), body(observations))
    layer = CalibrationLayer(observations.sticks, point_names=observations.point_names)
    first = layer(flipped.keypoints, observations.cameras)
    again = layer(flipped.keypoints, observations.cameras, initial=first)
    assert torch.equal(again.keypoint_index, first.keypoint_index)
