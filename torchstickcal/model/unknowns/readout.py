"""Unknown read-out time of rolling shutters."""

from __future__ import annotations

import torch
from torch import Tensor

from torchstickcal.model.unknowns.base import ClockUnknown, InUnits, RigEstimate, Sharing
from torchstickcal.model.unknowns.registered import register_unknown


@register_unknown
class Readout(ClockUnknown):
    """Time from the first row of an image to the last; the deviation is its correction, in frames."""

    name = "readout"
    label = "read-out time"
    components = ("readout",)
    variants = {"readout": Sharing.GROUP}
    prior_frames = 2.0

    def factor(self, row: Tensor) -> Tensor:
        return row

    def in_units(self, estimate: RigEstimate) -> InUnits:
        correction = self.seconds(estimate.deviations[self.name], estimate)
        given = torch.full_like(correction, estimate.readout_s)
        return InUnits(given + correction, given, torch.full_like(correction, estimate.frame_period_s))
