"""The losses of the calibration, each also usable alone in a training loop.

Installed as ``torchstickcal.losses``.
"""

if __name__ == "losses":
    raise ImportError("This folder is torchstickcal.losses: write `import torchstickcal.losses`, not `import losses`.")

from torchstickcal.losses.base import CameraPointLoss, Loss, PairLoss, TrackLoss
from torchstickcal.losses.reprojection import ReprojectionLoss, reprojection_residuals
from torchstickcal.losses.robust import Cauchy, GemanMcClure, Huber, Quadratic, RobustKernel, robust_kernel
from torchstickcal.losses.smoothness import SmoothnessLoss, second_differences
from torchstickcal.losses.stick_length import StickLengthLoss, stick_lengths

__all__ = [
    "CameraPointLoss",
    "Cauchy",
    "GemanMcClure",
    "Huber",
    "Loss",
    "PairLoss",
    "Quadratic",
    "ReprojectionLoss",
    "RobustKernel",
    "SmoothnessLoss",
    "StickLengthLoss",
    "TrackLoss",
    "reprojection_residuals",
    "robust_kernel",
    "second_differences",
    "stick_lengths",
]
