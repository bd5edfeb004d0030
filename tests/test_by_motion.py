"""The motion of a point shows which keypoints are wrong although they agree by chance, and which are right."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from torchstickcal import Observations, calibrate, metrics
from torchstickcal.config import InitialiseSettings, load_config
from torchstickcal.io import Truth
from torchstickcal.model.by_motion import found_by_motion
from torchstickcal.model.measurements import Measurements
from torchstickcal.model.state import State
from torchstickcal.pipeline.adjust import begin
from torchstickcal.pipeline.initialise import triangulated
from torchstickcal.pipeline.run import Run
from torchstickcal.simulate import Noise, golf_session

SIGMA_PX, IMAGE_PX = 1.5, (1920.0, 1080.0)


def wronged(cameras: int, share: float, kind: str, seed: int, frames: int = 40) -> tuple[Observations, Truth, Tensor]:
    """A session of which a share of the keypoints is wrong, its truth, and which keypoints are right, (C, F, P)."""
    observations, truth = golf_session(cameras=cameras, frames=frames, noise=Noise(SIGMA_PX, missing=0.2), seed=seed)
    generator = torch.Generator().manual_seed(seed)
    given = observations.keypoints
    elsewhere = torch.rand(given.shape, generator=generator, dtype=given.dtype) * torch.tensor(IMAGE_PX)
    near = given + 60 * torch.randn(given.shape, generator=generator, dtype=given.dtype)
    wrong = torch.rand(given.shape[:-1], generator=generator, dtype=given.dtype) < share
    keypoints = given.where(~wrong[..., None], {"anywhere": elsewhere, "near": near}[kind])
    return replace(observations, keypoints=keypoints.where(given.isfinite(), given)), truth, ~wrong & observations.visible


def at_truth(observations: Observations, truth: Truth) -> tuple[Measurements, State, Tensor, Tensor]:
    """The session with its true cameras and triangulated points, the keypoints that agree, and up to which residuals."""
    m = Measurements.of(observations)
    rotations, translations = truth.rotations[None], truth.translations[None]
    state = State.of(rotations, translations, triangulated(m, rotations, translations, InitialiseSettings()))
    limits = torch.full((1, m.points_per_frame), (4.5 * SIGMA_PX) ** 2, dtype=torch.float64)
    return m, state, (m.by_frame(m.squared_residuals(state)) <= limits[:, None, None]).flatten(2) & m.visible, limits


def kept(agreeing: Tensor) -> Tensor:
    return agreeing & (agreeing.sum(1, keepdim=True) >= 2)


@pytest.mark.parametrize(("cameras", "share"), [(2, 0.15), (3, 0.3), (6, 0.5)])
@pytest.mark.parametrize(("kind", "left"), [("anywhere", 0.3), ("near", 0.75)])
def test_fewer_wrong_keypoints_are_left_and_the_right_ones_stay(cameras: int, share: float, kind: str, left: float):
    observations, truth, right = wronged(cameras, share, kind, seed=0)
    m, state, agreeing, limits = at_truth(observations, truth)
    _, found = found_by_motion(m, state, agreeing, limits)
    right, before, after = right.flatten(1)[None], kept(agreeing), kept(found)
    assert (after & ~right).sum() / after.sum() < left * (before & ~right).sum() / before.sum()
    assert (after & right).sum() > 0.9 * (before & right).sum()


def test_nothing_changes_where_few_keypoints_are_wrong():
    m, state, agreeing, limits = at_truth(*wronged(3, 0.01, "anywhere", seed=0)[:2])
    assert all(
        found is given for found, given in zip(found_by_motion(m, state, agreeing, limits), (state, agreeing), strict=True)
    )


def test_nothing_is_said_where_frames_have_no_neighbours():
    observations, truth, _ = wronged(3, 0.3, "anywhere", seed=1, frames=1)
    m, state, agreeing, limits = at_truth(observations, truth)
    assert torch.equal(found_by_motion(m, state, agreeing, limits)[1], agreeing)


def test_sessions_of_a_batch_do_not_see_each_other():
    parts = [at_truth(*wronged(3, share, "anywhere", seed=2)[:2]) for share in (0.3, 0.0)]
    m, state = Measurements.stack([part[0] for part in parts]), State.stack([part[1] for part in parts])
    agreeing, limits = torch.cat([part[2] for part in parts]), torch.cat([part[3] for part in parts])
    together = found_by_motion(m, state, agreeing, limits)
    for session, part in enumerate(parts):
        one, alone = slice(session, session + 1), found_by_motion(*part)
        assert torch.equal(together[1][one], alone[1])
        torch.testing.assert_close(together[0].points[one], alone[0].points)


@pytest.mark.parametrize("kind", ["anywhere", "near"])
def test_a_calibration_with_many_wrong_keypoints_keeps_hardly_any(kind: str):
    observations, truth, right = wronged(3, 0.3, kind, seed=3, frames=60)
    calibration = calibrate(observations)
    wrong_share = (calibration.inliers & ~right).sum() / calibration.inliers.sum()
    assert wrong_share < {"anywhere": 0.005, "near": 0.035}[kind]
    errors = metrics.pose_errors(calibration.rotations, calibration.translations, truth.rotations, truth.translations)
    assert errors.mean_translation_m < 0.04


@pytest.mark.parametrize(("cameras", "share", "seed"), [(3, 0.3, 0), (3, 0.3, 1), (3, 0.4, 2), (4, 0.45, 3)])
def test_the_start_is_near_where_many_keypoints_are_anywhere(cameras: int, share: float, seed: int):
    observations, truth, _ = wronged(cameras, share, "anywhere", seed, frames=60)
    begun = begin(observations, Run(load_config("default")))
    relative = truth.rotations @ truth.rotations[0].mT
    assert metrics.rotation_angle(begun.state.rotations[0] @ relative.mT).rad2deg().max() < 25
