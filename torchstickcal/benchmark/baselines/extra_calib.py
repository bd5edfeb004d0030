"""ExtraCalib (Paetzold et al., "Online marker-free extrinsic camera calibration using person keypoint detections", GCPR 2022).

From a rough first pose of every camera, batch after batch of person keypoints is triangulated and adjusted with the present
estimate as a prior, and each camera's own result is filtered over time. The published method knows a rough pose from a
tape measure; here it comes from the library's initialisation, scaled by the height.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from torchstickcal.benchmark.baselines.base import (
    Estimate,
    Inputs,
    joint_measurements,
    required,
    scaled_by_height,
    triangulated,
)
from torchstickcal.benchmark.baselines.frame_adjustment import CameraPrior, adjust
from torchstickcal.config import InitialiseSettings
from torchstickcal.losses import Huber, ReprojectionLoss
from torchstickcal.model.measurements import Measurements
from torchstickcal.pipeline.initialise import initialise

_BATCH_FRAMES, _STRIDE_FRAMES = 10, 5
_PRIOR_SIGMA_M, _PRIOR_SIGMA_RAD = 0.25, 0.1
_FORGETTING = 0.9


def extra_calib(inputs: Inputs) -> Estimate:
    """Adjustment of sliding batches of frames with pose priors, then the scale from the height.

    A keypoint's noise follows its confidence. After a batch each camera's marginal covariance, widened by a forgetting
    factor, is its prior in the next one; how the cameras depend on each other is dropped, as in the published filter.

    Args:
        inputs: needs ``height_m``.

    Raises:
        MissingInputError: if the height is not given.
        RigError: if the cameras cannot be placed for the first estimate.
    """
    observations = inputs.observations
    required(inputs, "height_m")
    measurements = joint_measurements(observations)
    labels = [observations.camera_label(camera) for camera in range(observations.num_cameras)]
    state = scaled_by_height(inputs, measurements, initialise(measurements, InitialiseSettings(), labels))
    sigmas = torch.tensor(3 * [_PRIOR_SIGMA_M] + 3 * [_PRIOR_SIGMA_RAD], dtype=torch.float64)
    information = sigmas.square().reciprocal().diag().expand(len(labels) - 1, 6, 6)
    unfinished = 0
    for first in range(0, max(1, measurements.frames - _BATCH_FRAMES + _STRIDE_FRAMES), _STRIDE_FRAMES):
        batch = _frames(measurements, first, first + _BATCH_FRAMES)
        prior = CameraPrior(state.rotations, state.translations, information)
        start = triangulated(batch, state.rotations, state.translations)
        adjusted = adjust(batch, start, ReprojectionLoss(kernel=Huber()), prior=prior)
        state, information = adjusted.state, _FORGETTING * _marginal_information(adjusted.reduced)
        unfinished += not adjusted.converged
    state = triangulated(measurements, state.rotations, state.translations)
    state = scaled_by_height(inputs, measurements, state)
    status = f"the adjustment of {unfinished} batches stopped before it had converged" if unfinished else "converged"
    return Estimate.of(state, status)


def _frames(measurements: Measurements, first: int, last: int) -> Measurements:
    """The measurements of some frames."""
    pixels, confidence = measurements.by_frame(measurements.pixels), measurements.by_frame(measurements.confidence)
    return replace(
        measurements,
        pixels=pixels[..., first:last, :].flatten(-2),
        confidence=confidence[..., first:last, :].flatten(-2),
        frames=pixels[..., first:last, :].shape[-2],
    )


def _marginal_information(reduced: Tensor) -> Tensor:
    """Inverses of the cameras' own covariances, (C - 1, 6, 6), of the information of all together."""
    cameras = len(reduced) // 6
    covariance = torch.linalg.inv(reduced).view(cameras, 6, cameras, 6)
    return torch.linalg.inv(covariance.diagonal(dim1=0, dim2=2).movedim(-1, 0))
