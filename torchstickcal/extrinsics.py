"""Camera extrinsics as a module whose parameters are Lie-algebra tangents."""

from __future__ import annotations

import torch
from kornia.geometry.liegroup import Se3
from torch import Tensor, nn

from torchstickcal.errors import ObservationError


class Extrinsics(nn.Module):
    """World-to-camera transforms ``T = T_anchor Exp(tangent)`` of C cameras; the first one is fixed.

    The tangents are ordered (translation, rotation) and live on the world's side of the transform. They start at zero, so
    any optimiser of torch.optim can drive them; :meth:`reanchor` folds them into the anchor when they have grown.

    Args:
        rotations: (C, 3, 3), world to camera.
        translations: (C, 3), metres.
    """

    anchor_rotations: Tensor
    anchor_translations: Tensor

    def __init__(self, rotations: Tensor, translations: Tensor) -> None:
        super().__init__()
        if rotations.ndim != 3 or rotations.shape[1:] != (3, 3) or translations.shape != rotations.shape[:2]:
            raise ObservationError(
                "poses have the wrong shape",
                where="Extrinsics",
                got=f"rotations {tuple(rotations.shape)}, translations {tuple(translations.shape)}",
                expected="(C, 3, 3) and (C, 3)",
            )
        self.register_buffer("anchor_rotations", rotations.detach().clone())
        self.register_buffer("anchor_translations", translations.detach().clone())
        self.tangents = nn.Parameter(torch.zeros(len(rotations), 6, dtype=rotations.dtype, device=rotations.device))

    def forward(self) -> tuple[Tensor, Tensor]:
        """Rotations (C, 3, 3) and translations (C, 3), differentiable by the tangents of all cameras but the first."""
        moved = self.compose(self.tangents[1:])
        rotations = torch.cat([self.anchor_rotations[:1], moved[0]])
        return rotations, torch.cat([self.anchor_translations[:1], moved[1]])

    def compose(self, tangents: Tensor) -> tuple[Tensor, Tensor]:
        """The poses of all cameras but the first at tangents (C - 1, 6) from the anchor."""
        step = Se3.exp(tangents).matrix()
        anchor = self.anchor_rotations[1:]
        rotations = anchor @ step[:, :3, :3]
        return rotations, (anchor @ step[:, :3, 3:])[..., 0] + self.anchor_translations[1:]

    @torch.no_grad()
    def reanchor(self) -> None:
        """Move the anchor to the present transforms and set the tangents to zero; the transforms stay the same."""
        rotations, translations = self()
        self.anchor_rotations.copy_(rotations)
        self.anchor_translations.copy_(translations)
        self.tangents.zero_()
