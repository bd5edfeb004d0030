"""The parts of the experiments in examples/: rendering, triangulation, oracle and training do what they say."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
import torch

sys.path.insert(0, str(Path(__file__).parents[1] / "examples"))

import learnt_confidence
from joint_training_parts import scenes
from joint_training_parts.calibration import layer_of_given_noise, position_errors_mm, rig_loss
from joint_training_parts.comparison import oracle
from joint_training_parts.confidence import Head, learn_end_to_end, learn_likelihood
from joint_training_parts.detections import Detections, reprojections
from joint_training_parts.detector import Detector, detections


@pytest.fixture(scope="module")
def found() -> Detections:
    return learnt_confidence.sessions(range(4), ("golf", "baseball"))


def test_true_keypoints_are_their_own_reprojections(found: Detections):
    exact = Detections(found.true, *list(vars(found).values())[1:])
    seen = found.true.isfinite().all(-1)
    assert (reprojections(exact) - found.true).norm(dim=-1)[seen].max() < 1e-4
    assert (reprojections(found) - found.true).norm(dim=-1)[seen].median() < (found.keypoints - found.true).norm(dim=-1)[
        seen
    ].median()


def test_only_cheap_cameras_are_early_or_late(found: Detections):
    shift = (found.labels - found.true).norm(dim=-1).nan_to_num().amax((2, 3))
    grain = found.seen[..., 1].mean((2, 3))
    assert ((shift > 1e-6) == (grain > 0.5)).all()


def test_likelihood_learns_the_size_of_errors(found: Detections):
    head = Head(found)
    learn_likelihood(head, found, found.labels, 1.0, steps=60)
    error = (found.keypoints - found.labels).norm(dim=-1)
    trusted = head(found.seen) > head(found.seen).median()
    seen = error.isfinite()
    assert error[trusted & seen].median() < 0.7 * error[~trusted & seen].median()


def test_end_to_end_descends_and_the_oracle_is_better_than_none(found: Detections):
    layer, losses = layer_of_given_noise(learnt_confidence.STICK, learnt_confidence.SIGMA_PX), []
    head = Head(found)
    learn_end_to_end(head, found, layer, 6, 0, lambda step, loss, batch, confidence, result: losses.append(loss.item()))
    assert losses[-1] < losses[0]

    def error(confidence: torch.Tensor) -> float:
        result = layer(found.keypoints, found.intrinsics, found.stick_m, confidence)
        return float(position_errors_mm(result, found.rotations, found.translations).mean())

    with torch.no_grad():
        assert error(oracle(found, 1.0)) < 0.8 * error(torch.full_like(found.score, 0.1))


def test_rig_loss_is_least_at_the_true_rig(found: Detections):
    layer = layer_of_given_noise(learnt_confidence.STICK, 1.0)
    result = layer(found.true[:1], found.intrinsics[:1], found.stick_m[:1])
    assert rig_loss(result, found.rotations[:1], found.translations[:1]) < -8
    moved = found.translations[:1] + 0.1 * torch.eye(5, 3, dtype=torch.float64)
    assert rig_loss(result, found.rotations[:1], moved) > -5


def test_images_show_the_athlete_where_the_labels_are():
    drawn = scenes.sessions(range(2), ("golf", "kendo"), ("ring",))
    crops = drawn.in_crops(drawn.labels)
    assert drawn.images.shape == (2, scenes.CAMERAS, scenes.FRAMES, 3, scenes.SIZE, scenes.SIZE)
    assert ((crops > 0) & (crops < scenes.SIZE - 1)).all()
    torch.testing.assert_close(drawn.in_images(crops), drawn.labels, rtol=0, atol=1e-2)
    for session in range(2):  # the red head is seen in most images
        at = crops[session, :, :, 0].round().long()
        camera, frame = np.indices(at.shape[:2])
        red, green, _ = drawn.images[session, camera, frame, :, at[..., 1], at[..., 0]].float().unbind(-1)
        assert (red > 2 * green).float().mean() > 0.6


def test_a_detector_gives_keypoints_in_its_crops():
    drawn = scenes.sessions(range(1), ("golf",), ("ring",))
    result = detections(Detector(), drawn)
    crops = drawn.in_crops(result.keypoints.float())
    assert ((crops > -1) & (crops < scenes.SIZE + 1)).all()
    assert result.seen.isfinite().all()
    assert ((result.score > 0) & (result.score <= 1)).all()
