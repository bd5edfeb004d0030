"""Unknown focal length."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from torchstickcal.geometry.cameras import Intrinsics
from torchstickcal.model.unknowns.base import LensUnknown, Sharing, View
from torchstickcal.model.unknowns.registered import register_unknown

_PRIOR = 0.1


@register_unknown
class Focal(LensUnknown):
    """Focal length; the deviation is the logarithm of the true focal length over the given one."""

    name = "focal"
    label = "focal length"
    unit = "px"
    components = ("focal",)
    variants = {"focal": Sharing.OWN, "focal_shared": Sharing.GROUP}
    noticeable_prior_share = 0.05
    usual_prior_share = 0.07  # a calibration is right to about 0.7 %

    def prior(self, cameras: Intrinsics) -> Tensor:
        return torch.full_like(cameras.focal_px, _PRIOR).unsqueeze(-1)

    def applied(self, cameras: Intrinsics, deviations: Tensor) -> Intrinsics:
        others = cameras.matrix.new_tensor([[0.0, 0.0, 1.0], [0.0, 0.0, 1.0], [1.0, 1.0, 1.0]])
        factor = others + (1 - others) * deviations.exp()[..., None]
        return replace(cameras, matrix=cameras.matrix * factor)

    def projection_derivatives(self, view: View) -> tuple[Tensor, Tensor]:
        centre = view.cameras.matrix[..., :2, 2:]
        x, y = view.pixel.x - centre[..., 0, :], view.pixel.y - centre[..., 1, :]
        return x.unsqueeze(-2), y.unsqueeze(-2)

    def values(self, cameras: Intrinsics) -> Tensor:
        return cameras.focal_px.unsqueeze(-1)

    def value_derivatives(self, cameras: Intrinsics) -> Tensor:
        return self.values(cameras)
