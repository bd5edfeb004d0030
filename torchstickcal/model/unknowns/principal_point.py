"""Unknown principal point."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from torchstickcal.geometry.cameras import Intrinsics
from torchstickcal.model.unknowns.base import LensUnknown, Sharing, View
from torchstickcal.model.unknowns.registered import register_unknown

_PRIOR_FOCAL_LENGTHS = 0.02


@register_unknown
class PrincipalPoint(LensUnknown):
    """Principal point; the deviations are its shift along x and y, pixels."""

    name = "principal_point"
    label = "principal point"
    unit = "px"
    components = ("centre_x", "centre_y")
    variants = {"principal_point": Sharing.OWN}
    usual_prior_share = 0.25  # to about 0.5 % of the focal length

    def prior(self, cameras: Intrinsics) -> Tensor:
        return (_PRIOR_FOCAL_LENGTHS * cameras.focal_px).unsqueeze(-1).expand(*cameras.focal_px.shape, 2)

    def applied(self, cameras: Intrinsics, deviations: Tensor) -> Intrinsics:
        shift = torch.nn.functional.pad(deviations.unsqueeze(-1), (2, 0, 0, 1))
        return replace(cameras, matrix=cameras.matrix + shift)

    def projection_derivatives(self, view: View) -> tuple[Tensor, Tensor]:
        one, zero = torch.ones_like(view.cameras.matrix[..., :1, :1]), torch.zeros_like(view.cameras.matrix[..., :1, :1])
        return torch.cat([one, zero], dim=-2), torch.cat([zero, one], dim=-2)

    def values(self, cameras: Intrinsics) -> Tensor:
        return cameras.matrix[..., :2, 2]

    def value_derivatives(self, cameras: Intrinsics) -> Tensor:
        return torch.ones_like(self.values(cameras))
