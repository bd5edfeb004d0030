"""The losses of the calibration, each also usable alone in a training loop.

Installed as ``torchstickcal.losses``.
"""

if __name__ == "losses":
    raise ImportError("This folder is torchstickcal.losses: write `import torchstickcal.losses`, not `import losses`.")

from torchstickcal.losses.base import Loss
from torchstickcal.losses.camera_point import CameraPointLoss
from torchstickcal.losses.frame import FrameLoss
from torchstickcal.losses.registry import LOSSES, LossContext, LossSettings, register_loss
from torchstickcal.losses.reprojection import ReprojectionLoss, ReprojectionSettings, reprojection_residuals
from torchstickcal.losses.robust import Cauchy, GemanMcClure, Huber, Quadratic, RobustKernel, robust_kernel
from torchstickcal.losses.smoothness import SmoothnessLoss, SmoothnessSettings, second_differences
from torchstickcal.losses.stick_length import StickLengthLoss, StickLengthSettings, stick_lengths
from torchstickcal.losses.track import TrackLoss

__all__ = [
    "LOSSES",
    "CameraPointLoss",
    "Cauchy",
    "FrameLoss",
    "GemanMcClure",
    "Huber",
    "Loss",
    "LossContext",
    "LossSettings",
    "Quadratic",
    "ReprojectionLoss",
    "ReprojectionSettings",
    "RobustKernel",
    "SmoothnessLoss",
    "SmoothnessSettings",
    "StickLengthLoss",
    "StickLengthSettings",
    "TrackLoss",
    "register_loss",
    "reprojection_residuals",
    "robust_kernel",
    "second_differences",
    "stick_lengths",
]
