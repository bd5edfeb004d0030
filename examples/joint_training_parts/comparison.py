"""The comparison that both experiments make: one head, trained in different ways, and the errors of the cameras that follow."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from joint_training_parts.calibration import layer_of_given_noise, position_errors_mm
from joint_training_parts.confidence import Head, learn_end_to_end, learn_likelihood
from joint_training_parts.detections import Detections, reprojections
from torchstickcal import CalibrationLayer, LayerResult, Stick

Watch = Callable[[str, int, Tensor, Detections, Tensor, LayerResult], None]
"""Gets the method, the step, the loss, the sessions of the step, their confidences and the result."""


def compare(
    training: Detections,
    test: Detections,
    stick: Stick,
    sigma_px: float,
    steps: int,
    seed: int,
    watch: Watch | None = None,
) -> tuple[dict[str, Tensor], dict[str, Head]]:
    """Errors of the camera positions in each test session in millimetres, and the trained heads, by method.

    Args:
        training: sessions of known rigs.
        test: others.
        stick: which points are its ends.
        sigma_px: noise of a keypoint of confidence 1.
        steps: of the training end to end.
        seed: of the order of the sessions.
        watch: what sees each step of a training end to end.
    """
    default, given = CalibrationLayer(stick), layer_of_given_noise(stick, sigma_px)
    heads = {method: Head(training) for method in ("labels", "reprojections", "end to end", "labels and end to end")}
    learn_likelihood(heads["labels"], training, training.labels, sigma_px)
    learn_likelihood(heads["reprojections"], training, reprojections(training), sigma_px)
    heads["labels and end to end"].load_state_dict(heads["labels"].state_dict())
    for method, labels_sigma_px in (("end to end", None), ("labels and end to end", sigma_px)):
        seen_by = partial(watch, method) if watch else None
        learn_end_to_end(heads[method], training, given, steps, seed, seen_by, labels_sigma_px)

    def errors(layer: CalibrationLayer, confidence: Tensor | None) -> Tensor:
        result = layer(test.keypoints, test.intrinsics, test.stick_m, confidence)
        return position_errors_mm(result, test.rotations, test.translations)

    with torch.no_grad():
        found = {"no confidence": errors(default, None), "the detector's score": errors(default, test.score)}
        found |= {method: errors(given, head(test.seen)) for method, head in heads.items()}
        found["oracle: the true errors"] = errors(given, oracle(test, sigma_px))
    return found, heads


def oracle(found: Detections, sigma_px: float) -> Tensor:
    """Confidences of who knows the errors themselves: each keypoint's variance is its squared error, and ``sigma_px**2``."""
    squared = (found.keypoints - found.true).square().mean(-1).nan_to_num()
    return 1 / (1 + squared / sigma_px**2)
