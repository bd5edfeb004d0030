"""What both experiments do with keypoints: the layer, the loss on a known rig, and the errors of a calibration."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from torchstickcal import CalibrationLayer, Config, LayerResult, Stick, load_config
from torchstickcal.losses import ReprojectionSettings
from torchstickcal.metrics import pose_errors

_LEVER_M = 5.0


def layer_of_given_noise(stick: Stick, sigma_px: float) -> CalibrationLayer:
    """The first two stages of the default, for training: a keypoint of confidence w has the variance ``sigma_px**2 / w``.

    The noise is not estimated, because a factor on the confidences would then have no effect. No keypoint is rejected, so that
    the gradient reaches all of them.
    """
    default = load_config("default")

    def given(kernel_scale: float) -> ReprojectionSettings:
        return ReprojectionSettings(sigma_px=sigma_px, kernel="cauchy", kernel_scale=kernel_scale)

    first, second = default.stages["unscaled"], default.stages["metric"]
    stages = {
        "unscaled": replace(first, losses=first.losses | {"reprojection": given(3.0)}),
        "metric": replace(second, reject_sigmas=None, cost_tolerance=1e-7, losses=second.losses | {"reprojection": given(4.0)}),
    }
    return CalibrationLayer(stick, Config(stages))


def rig_loss(result: LayerResult, rotations: Tensor, translations: Tensor) -> Tensor:
    """How far cameras are from where they truly are: mean over the sessions of the logarithm of the error, in metres.

    The logarithm gives each session the same influence. An error of rotation counts as that of a position five metres away.
    Sessions that could not be calibrated count as nothing.

    Args:
        result: of B sessions.
        rotations: true ones, (B, C, 3, 3), world to camera, in any common frame. translations: (B, C, 3).
    """
    true_rotations, true_centres = _seen_from_first(rotations, translations)
    found_rotations, found_centres = _seen_from_first(result.rotations, result.translations)
    position = (found_centres - true_centres).square().sum(-1)[:, 1:].mean(1)
    rotation = (found_rotations - true_rotations).square().sum((-2, -1))[:, 1:].mean(1) / 2
    error = (position + _LEVER_M**2 * rotation + 1e-8).log() / 2
    return error.where(result.converged, 0.0).mean()


@torch.no_grad()
def position_errors_mm(result: LayerResult, rotations: Tensor, translations: Tensor) -> Tensor:
    """Mean error of the camera positions of each session, (B,); the rigs are aligned without scale first."""
    sessions = zip(result.rotations, result.translations, rotations, translations, strict=True)
    return torch.tensor([1000 * pose_errors(*session).mean_translation_m for session in sessions])


def _seen_from_first(rotations: Tensor, translations: Tensor) -> tuple[Tensor, Tensor]:
    """Rotations and centres of the cameras in the frame of the first one."""
    relative = rotations @ rotations[:, :1].mT
    moved = translations - (relative @ translations[:, :1, :, None])[..., 0]
    return relative, -(relative.mT @ moved[..., None])[..., 0]
