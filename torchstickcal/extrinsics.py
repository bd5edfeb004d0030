"""Camera extrinsics as a module whose parameters are Lie-algebra tangents."""

from __future__ import annotations

from typing import Any

import torch
from kornia.geometry.camera import PinholeCamera
from kornia.geometry.liegroup import Se3
from torch import Tensor, nn

from torchstickcal.arrays import tensor_of
from torchstickcal.errors import ObservationError
from torchstickcal.precision import full_precision, in_common_precision


class Extrinsics(nn.Module):
    """World-to-camera transforms ``T = T_anchor Exp(tangent)`` of C cameras; the first one is fixed.

    The tangents are ordered (translation, rotation) and act on the world's side of the transform. They start at zero, and any
    optimiser of torch.optim can change them. :meth:`reanchor` moves the anchor to the present transforms when they have grown.
    Transforms are in float32 or float64 and are computed so, also in an autocast region.

    Args:
        rotations: (C, 3, 3), world to camera, as a tensor, array or list; so are the translations.
        translations: (C, 3), world to camera, metres.

    Raises:
        ObservationError: if they are not numbers, or their shapes do not fit.

    Example:
        >>> import torch
        >>> extrinsics = Extrinsics(torch.eye(3).repeat(2, 1, 1), torch.zeros(2, 3))
        >>> optimiser = torch.optim.SGD(extrinsics.parameters(), lr=0.1)
        >>> rotations, translations = extrinsics()
        >>> (translations[1] - torch.tensor([1.0, 0.0, 0.0])).square().sum().backward()
        >>> optimiser.step()
        >>> extrinsics()[1][1].detach()
        tensor([0.2000, 0.0000, 0.0000])
    """

    anchor_rotations: Tensor
    anchor_translations: Tensor

    def __init__(self, rotations: Any, translations: Any) -> None:
        super().__init__()
        rotations = tensor_of(rotations, "rotations")
        translations = tensor_of(translations, "translations", device=rotations.device)
        fitting = rotations.ndim == 3 and rotations.shape[1:] == (3, 3) and translations.shape == rotations.shape[:2]
        if not fitting or not len(rotations):
            raise ObservationError(
                "poses have the wrong shape",
                where="Extrinsics",
                got=f"rotations {tuple(rotations.shape)}, translations {tuple(translations.shape)}",
                expected="(C, 3, 3) and (C, 3)",
            )
        rotations, translations = in_common_precision(rotations, translations)
        self.register_buffer("anchor_rotations", rotations.clone())
        self.register_buffer("anchor_translations", translations.clone())
        self.tangents = nn.Parameter(torch.zeros(len(rotations), 6, dtype=rotations.dtype, device=rotations.device))

    def forward(self) -> tuple[Tensor, Tensor]:
        """Rotations (C, 3, 3) and translations (C, 3), differentiable by the tangents of all cameras but the first."""
        moved = self.compose(self.tangents[1:])
        rotations = torch.cat([self.anchor_rotations[:1].to(moved[0]), moved[0]])
        return rotations, torch.cat([self.anchor_translations[:1].to(moved[1]), moved[1]])

    def to_kornia(self) -> Se3:
        """The C transforms, world to camera, as kornia's."""
        rotations, translations = self()
        pose = torch.cat([rotations, translations[..., None]], dim=-1)
        last_row = torch.tensor([[0.0, 0.0, 0.0, 1.0]]).to(pose).expand(len(pose), 1, 4)
        return Se3.from_matrix(torch.cat([pose, last_row], dim=1))

    @staticmethod
    def from_kornia(transforms: Se3 | PinholeCamera) -> Extrinsics:
        """Transforms, world to camera, from kornia's, or from the poses of its cameras."""
        matrix = transforms.extrinsics if isinstance(transforms, PinholeCamera) else transforms.matrix()
        return Extrinsics(matrix[:, :3, :3], matrix[:, :3, 3])

    def compose(self, tangents: Tensor) -> tuple[Tensor, Tensor]:
        """The poses of all cameras but the first at tangents (C - 1, 6) from the anchor."""
        with full_precision(tangents.device):
            tangents, anchor, translations = in_common_precision(
                tangents, self.anchor_rotations[1:], self.anchor_translations[1:]
            )
            step = Se3.exp(tangents).matrix()
            return anchor @ step[:, :3, :3], (anchor @ step[:, :3, 3:])[..., 0] + translations

    @torch.no_grad()
    def reanchor(self) -> None:
        """Move the anchor to the present transforms and set the tangents to zero; the transforms stay the same."""
        rotations, translations = self()
        self.anchor_rotations.copy_(rotations)
        self.anchor_translations.copy_(translations)
        self.tangents.zero_()
