"""ExtraCalib (Paetzold et al., "Online marker-free extrinsic camera calibration using person keypoint detections", GCPR 2022).

It starts from approximate poses of the cameras. Batches of frames are triangulated and adjusted one after another, each with
the present estimate as a prior, so that the pose of each camera is filtered over time. In the published method the approximate
poses are measured by hand; here they are those of the library's initialisation, scaled by the height.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from torchstickcal.benchmark.baselines.base import Estimate, Inputs, Listing, PublishedErrors, baseline
from torchstickcal.benchmark.baselines.frame_adjustment import CameraPrior, adjust
from torchstickcal.benchmark.baselines.joints import joint_measurements, scaled_by_height, triangulated
from torchstickcal.benchmark.baselines.reasons import CONVERGED, HEIGHT
from torchstickcal.config import InitialiseSettings
from torchstickcal.losses import Huber, ReprojectionLoss
from torchstickcal.model.measurements import Measurements
from torchstickcal.pipeline.initialise import initialise

_BATCH_FRAMES, _STRIDE_FRAMES = 10, 5
_PRIOR_SIGMA_M, _PRIOR_SIGMA_RAD = 0.25, 0.1
_FORGETTING = 0.9


@baseline(
    "extra_calib",
    Listing("ExtraCalib", {"sota": PublishedErrors(0.239, 0.044)}, (HEIGHT, CONVERGED), position=22),
    needs=("height_m",),
    title_in_motion="ExtraCalib, true mean height in motion",
)
def extra_calib(inputs: Inputs) -> Estimate:
    """Bundle adjustment of overlapping batches of frames with pose priors, then the scale from the height.

    The confidence of a keypoint is the weight of its residual. After each batch the marginal information of each camera,
    multiplied by a forgetting factor, is its prior in the next batch; as in the published filter, correlations between
    cameras are neglected.

    Args:
        inputs: needs ``height_m``.

    Raises:
        RigError: if the cameras cannot be initialised.
    """
    observations = inputs.observations
    measurements = joint_measurements(observations)
    labels = [observations.camera_label(camera) for camera in range(observations.num_cameras)]
    state = scaled_by_height(inputs, measurements, initialise(measurements, InitialiseSettings(), labels))
    sigmas = torch.tensor(3 * [_PRIOR_SIGMA_M] + 3 * [_PRIOR_SIGMA_RAD], dtype=torch.float64)
    information = sigmas.square().reciprocal().diag().expand(len(labels) - 1, 6, 6)
    not_converged = 0
    for first in range(0, max(1, measurements.frames - _BATCH_FRAMES + _STRIDE_FRAMES), _STRIDE_FRAMES):
        batch = _frames(measurements, first, first + _BATCH_FRAMES)
        prior = CameraPrior(state.rotations, state.translations, information)
        start = triangulated(batch, state.rotations, state.translations)
        adjusted = adjust(batch, start, ReprojectionLoss(kernel=Huber()), prior=prior)
        state, information = adjusted.state, _FORGETTING * _marginal_information(adjusted.reduced)
        not_converged += not adjusted.converged
    state = triangulated(measurements, state.rotations, state.translations)
    state = scaled_by_height(inputs, measurements, state)
    status = f"the adjustment of {not_converged} batches stopped before it had converged" if not_converged else "converged"
    return Estimate.of_state(state, status)


def _frames(measurements: Measurements, first: int, last: int) -> Measurements:
    """The measurements of the frames from ``first`` up to, but without, ``last``."""
    pixels, confidence = measurements.by_frame(measurements.pixels), measurements.by_frame(measurements.confidence)
    return replace(
        measurements,
        pixels=pixels[..., first:last, :].flatten(-2),
        confidence=confidence[..., first:last, :].flatten(-2),
        frames=pixels[..., first:last, :].shape[-2],
    )


def _marginal_information(reduced: Tensor) -> Tensor:
    """Marginal information of each camera, (C - 1, 6, 6): the inverse of its block of the joint covariance.

    Args:
        reduced: joint information of all cameras but the first, (6 (C - 1), 6 (C - 1)).
    """
    cameras = len(reduced) // 6
    covariance = torch.linalg.inv(reduced).view(cameras, 6, cameras, 6)
    return torch.linalg.inv(covariance.diagonal(dim1=0, dim2=2).movedim(-1, 0))
