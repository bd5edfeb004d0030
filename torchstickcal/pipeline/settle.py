"""Cameras and noise that agree: the cameras are the minimum for the noise that is found there."""

from __future__ import annotations

import time
from dataclasses import replace

import torch

from torchstickcal.losses import Quadratic, TrackLoss
from torchstickcal.model.noise import NEAR_SIGMAS, near_keypoints
from torchstickcal.pipeline.adjust import Adjustment
from torchstickcal.pipeline.noise import Chosen, HeldNoise
from torchstickcal.pipeline.run import Run
from torchstickcal.pipeline.scale import rulers, scale_factors

_SETTLE = "settle"


@torch.no_grad()
def settle_noise(adjustment: Adjustment, run: Run) -> Adjustment:
    """Sessions after their last camera stage, with the noise as it is found where that stage has ended.

    A stage reckons with the noise that was found where it began. That is a little different from the noise where it ends. So
    both are brought to agree, with the keypoints that take part and all other decisions held. Nothing is done where the stage
    takes nothing from the data, or where the Hessian is not known exactly.

    Args:
        adjustment: where the sessions have ended.
        run: what all steps share.
    """
    began, last = time.perf_counter(), adjustment.last_camera_stage
    noise = run.noise_of(last.stage)
    tracks = [loss for loss in last.losses.values() if isinstance(loss, TrackLoss)]
    if last.stage.cameras == "held" or not noise.estimated or not all(isinstance(loss.kernel, Quadratic) for loss in tracks):
        return adjustment
    measurements, kept, at = adjustment.measurements, adjustment.kept, last.minimum
    squared = measurements.squared_residuals(at)
    near = Chosen(near_keypoints(measurements, squared), NEAR_SIGMAS)
    *_, gates = noise.decided(kept, at, squared, noise.chosen(kept, near))
    held = HeldNoise(noise, gates, last.inliers)
    minimum = held.minimum_near(measurements, at)
    state = minimum.state
    if last.stage.rescale:
        factors, _ = scale_factors(kept, state.points, rulers(kept, run.config))
        state = state.scaled(factors)
    levels = held.levels(measurements, minimum.state)
    settled = last._replace(state=state, minimum=minimum.state, losses=minimum.objective.losses, noise=levels, gates=gates)
    run.took(_SETTLE, time.perf_counter() - began)
    failed = torch.tensor([any(record.stop.failed for record in records) for records in adjustment.records])
    settled = settled.replaced(failed.to(state.points.device), last._replace(gates=gates))
    return replace(adjustment, state=settled.state, results=(settled,))
