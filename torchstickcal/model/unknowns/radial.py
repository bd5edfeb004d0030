"""Unknown radial distortion."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from torchstickcal.geometry.cameras import Intrinsics
from torchstickcal.model.unknowns.base import LensUnknown, Sharing, View
from torchstickcal.model.unknowns.registered import register_unknown

_PRIOR = 0.3


@register_unknown
class Radial(LensUnknown):
    """Radial distortion; the deviations are corrections of the coefficients k1 and k2."""

    name = "radial"
    label = "radial distortion"
    unit = ""
    components = ("k1", "k2")
    variants = {"radial": Sharing.OWN}
    usual_prior_share = 0.1  # to about 0.03

    def prior(self, cameras: Intrinsics) -> Tensor:
        return torch.full_like(cameras.matrix[..., :2, 0], _PRIOR)

    def applied(self, cameras: Intrinsics, deviations: Tensor) -> Intrinsics:
        given = cameras.distortion
        if given is None:
            given = cameras.matrix.new_zeros(*cameras.matrix.shape[:-2], 4)
        return replace(cameras, distortion=given + torch.nn.functional.pad(deviations, (0, given.shape[-1] - 2)))

    def projection_derivatives(self, view: View) -> tuple[Tensor, Tensor]:
        if view.cameras.is_tilted:
            return super().projection_derivatives(view)
        first, second = (view.cameras.pixels_by_radial(view.u, view.v, order) for order in (1, 2))
        x, y = (torch.stack(axis, dim=-2) for axis in zip(first, second, strict=True))
        return x, y

    def values(self, cameras: Intrinsics) -> Tensor:
        if cameras.distortion is None:
            return torch.zeros_like(cameras.matrix[..., :2, 0])
        return cameras.distortion[..., :2]

    def value_derivatives(self, cameras: Intrinsics) -> Tensor:
        return torch.ones_like(self.values(cameras))
