"""Unknown clock offset."""

from __future__ import annotations

import torch
from torch import Tensor

from torchstickcal.model.unknowns.base import ClockUnknown, InUnits, RigEstimate, Sharing
from torchstickcal.model.unknowns.registered import register_unknown


@register_unknown
class TimeOffset(ClockUnknown):
    """Time by which a camera's frames begin after those of the first camera.

    The deviation is counted at the middle row of the image, in frames.
    """

    name = "time_offset"
    label = "time offset"
    components = ("time_offset",)
    variants = {"time_offset": Sharing.RELATIVE}
    prior_frames = 0.5
    noticeable_prior_share = 0.04

    def factor(self, row: Tensor) -> Tensor:
        return torch.ones_like(row)

    def in_units(self, estimate: RigEstimate) -> InUnits:
        readout = self.seconds(estimate.deviations["readout"], estimate)
        middle = self.seconds(estimate.frame_offsets[:, None] + estimate.deviations[self.name], estimate)
        period = torch.full_like(middle, estimate.frame_period_s)
        return InUnits(middle - (readout - readout[:1]) / 2, torch.zeros_like(middle), period)
