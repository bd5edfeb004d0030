"""What was triangulated of a recording with cameras that were calibrated before."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchstickcal.stick import Stick
from torchstickcal.world import World


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """The points of a recording, in metres, in the frame of the calibration.

    Floating-point tensors have the dtype and device of the keypoints.

    Example:
        >>> from torchstickcal import calibrate, triangulate
        >>> from torchstickcal.simulate import golf_session
        >>> calibration = calibrate(golf_session(cameras=3, frames=30)[0])
        >>> reconstruction = triangulate(golf_session(cameras=3, frames=20)[0], calibration)
        >>> reconstruction.points.shape, reconstruction.inliers.shape
        (torch.Size([20, 21, 3]), torch.Size([3, 20, 21]))
    """

    points: Tensor
    """(G, P, 3), metres, at the common frames; NaN where fewer than two cameras saw the point. The common frames are the F
    frames of the recording, unless time offsets were estimated or timestamps were given."""
    points_std_m: Tensor
    """(G, P), standard deviation of each point from its true position, metres: of its keypoints and, where the calibration says
    it, of the cameras; without what smoothness adds"""
    residuals_px: Tensor
    """(C, F, P, 2), projection minus keypoint, pixels, of inliers and outliers; NaN where not seen or the point is not known"""
    inliers: Tensor
    """(C, F, P), True where a keypoint was used: a second camera sees the point too, and it was not rejected"""
    sigma_px: Tensor
    """(P,), estimated noise of each point's keypoints along an axis, pixels"""
    stick_lengths_m: Tensor
    """(G, S), reconstructed lengths, which were not used: an independent check of the calibration; NaN where not known"""
    frame_index: Tensor
    """(C, F), the common frame (of G) nearest to each frame of a camera, -1 where the frame was left out"""
    keypoint_index: Tensor
    """(C, F, P), the point whose given keypoint each point uses: its own, except where label errors were undone"""
    other_person: Tensor
    """(C, F), True where all keypoints of a camera's frame were set aside: they fit together, but show another person"""
    times: Tensor | None
    """(G,), float64, seconds on the clock of the first camera; None without a frame rate"""
    time_offsets: Tensor
    """(C,), time by which each camera's frames begin after those of the first camera, seconds; zero where not estimated"""
    time_offsets_std: Tensor
    """(C,), its standard deviation; NaN where not estimated"""
    rotations: Tensor
    """(C, 3, 3), world to camera, of the calibration; as the next five, for the cameras of the recording in their order"""
    translations: Tensor
    """(C, 3), world to camera, metres"""
    intrinsics: Tensor
    """(C, 3, 3), camera matrices, for the images of the recording"""
    distortion: Tensor | None
    """(C, D), OpenCV's order; None for perfect lenses"""
    fisheye: bool
    """whether ``distortion`` is of OpenCV's fisheye model"""
    covariance: Tensor
    """(6 (C - 1), 6 (C - 1)), as of a :class:`Calibration`; zero where the calibration says nothing of it"""
    sticks: tuple[Stick, ...]
    fps: float | None
    point_names: tuple[str, ...] | None
    camera_names: tuple[str, ...]
    world: World
    """the frame of the points, that of the calibration"""
    warnings: tuple[str, ...]
    """what a careful user should know"""

    @property
    def reprojection_median_px(self) -> Tensor:
        """(C,), median over the inliers of each camera of the residuals' lengths, pixels; NaN for a camera without any."""
        return self.residuals_px.norm(dim=-1).where(self.inliers, torch.nan).flatten(1).nanmedian(1).values
