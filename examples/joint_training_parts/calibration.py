"""What both experiments do with keypoints: the layers, the loss on a known rig, and the errors of a calibration."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from torchstickcal import CalibrationLayer, LayerResult, Stick, load_config
from torchstickcal.metrics import pose_errors

_LEVER_M_PER_DEG, _TINY = 0.02, 1e-8


def layer_of_given_noise(stick: Stick, sigma_px: float) -> CalibrationLayer:
    """The default, but a keypoint of confidence w has the variance ``sigma_px**2 / w``.

    If the noise was estimated instead, a factor on all confidences of a point would have no effect. The last stage is left out:
    it does not change the cameras.
    """
    default = load_config("default")
    stages = {name: stage for name, stage in default.stages.items() if stage.cameras == "free"}
    return CalibrationLayer(stick, replace(default, stages=stages, sigma_px=sigma_px), noise="given")


def rig_loss(result: LayerResult, rotations: Tensor, translations: Tensor) -> Tensor:
    """How far cameras are from where they truly are: mean over the sessions of the logarithm of the error.

    The logarithm gives each session the same influence. An error of one degree counts as two centimetres. Sessions that could
    not be calibrated do not contribute.

    Args:
        result: of B sessions.
        rotations: true ones, (B, C, 3, 3), world to camera.
        translations: true ones, (B, C, 3), metres.
    """
    errors = pose_errors(result.rotations, result.translations, rotations, translations)
    squared = errors.translation_m.square().mean(-1) + (_LEVER_M_PER_DEG * errors.rotation_deg).square().mean(-1)
    return ((squared + _TINY).log() / 2).where(result.converged, 0.0).mean()


@torch.no_grad()
def position_errors_mm(result: LayerResult, rotations: Tensor, translations: Tensor) -> Tensor:
    """Mean error of the camera positions of each session, (B,)."""
    return 1000 * pose_errors(result.rotations, result.translations, rotations, translations).translation_m.mean(-1)
