"""eWand, a calibration with a wand (Gossard et al., ICRA 2024).

A wand with markers on a line at known distances is waved through the scene. This is the part of the published method for frame
cameras: relative poses of pairs, then a robust bundle adjustment of the markers with residuals of the reprojection, of the
length of the wand and of its straightness.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchstickcal.benchmark.baselines.base import Estimate, Inputs, Listing, MissingInputError, baseline
from torchstickcal.benchmark.baselines.frame_adjustment import FrameResiduals, adjust
from torchstickcal.benchmark.baselines.joints import scaled_by_rulers
from torchstickcal.config import InitialiseSettings
from torchstickcal.losses import Huber, ReprojectionLoss
from torchstickcal.model.measurements import Measurements
from torchstickcal.observations import Observations
from torchstickcal.pipeline.initialise import initialise
from torchstickcal.pipeline.scale import Ruler

MIDDLE = "stick_middle"
_SIGMA_M = 0.001


@baseline("ewand", Listing("eWand", {"sota": None}, position=24))
def ewand(inputs: Inputs) -> Estimate:
    """Relative poses of pairs of cameras from the ends of the stick, then bundle adjustment with its length.

    The residual of straightness is used only if the session has a third point on its stick, named ``stick_middle``.

    Args:
        inputs: needs a stick in the observations.

    Raises:
        MissingInputError: if the observations have no stick.
        RigError: if the ends of the stick are not enough to initialise the cameras.
    """
    observations = inputs.observations
    if not observations.sticks:
        raise MissingInputError("no stick to use as a wand", where="Inputs.observations", got="no stick", expected="a stick")
    middle = _middle(observations)
    ends = {end for stick in observations.sticks for end in stick.ends}
    measurements = Measurements.of(observations, ends | set(middle))
    labels = [observations.camera_label(camera) for camera in range(observations.num_cameras)]
    state = initialise(measurements, InitialiseSettings(), labels)
    lengths_m = measurements.lengths_m.unbind(1)
    known = [Ruler(s.ends[:1], s.ends[1:], length_m, True) for s, length_m in zip(observations.sticks, lengths_m, strict=True)]
    state = scaled_by_rulers(measurements, state, known)
    adjusted = adjust(measurements, state, ReprojectionLoss(kernel=Huber()), _wand(measurements, middle))
    status = "converged" if adjusted.converged else "the bundle adjustment stopped before it had converged"
    return Estimate.of_state(adjusted.state, status)


def _middle(observations: Observations) -> list[int]:
    """Index of the third point of the first stick, if there is one."""
    return [point for point, name in enumerate(observations.point_names or ()) if name == MIDDLE]


def _wand(measurements: Measurements, middle: list[int]) -> FrameResiduals:
    """Residuals of the lengths of the sticks and of the distance of the middle point from the line through the ends."""
    starts, ends = measurements.sticks.unbind(1)
    complete, lengths_m = measurements.stick_active[0], measurements.lengths_m[0]
    with_middle = complete[:, :1] & measurements.by_frame(measurements.active[0])[:, middle]

    def residuals(points: Tensor) -> Tensor:
        along = (points[:, ends] - points[:, starts]).where(complete[..., None], 1.0)
        lengths = along.norm(dim=-1)
        aside = torch.linalg.cross(points[:, middle] - points[:, starts[:1]], along[:, :1] / lengths[:, :1, None], dim=-1)
        aside = (aside * with_middle[..., None]).flatten(1)
        return torch.cat([(lengths - lengths_m) * complete, aside], dim=1) / _SIGMA_M

    return residuals
