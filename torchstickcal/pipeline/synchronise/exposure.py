"""Keypoints moved to the common frames: each by the motion of its point in the image between the exposure and the frame.

The motion follows from the trajectories of the estimated points. The keypoints themselves are too noisy to estimate it. So
clocks can be estimated like lenses, as further unknowns of the camera system. The trajectories are updated after each
adjustment.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from torchstickcal.geometry.cameras import Intrinsics, inverse_depths
from torchstickcal.model.measurements import Measurements
from torchstickcal.model.state import State
from torchstickcal.model.trajectories import Trajectories
from torchstickcal.model.unknowns import ImageMotion
from torchstickcal.pipeline.synchronise.frames import CommonFrames
from torchstickcal.solvers.uncertainty import point_variances


class Support(NamedTuple):
    """The uncertainty of the points of B sessions."""

    variance: Tensor
    """(B, N), variance of a point along an axis, square metres; infinite for unknown points"""
    views: Tensor
    """(B, N), number of cameras that see a point"""
    sigma_px: Tensor
    """(B, P), noise of each point's keypoints, pixels"""

    @staticmethod
    def of(measurements: Measurements, state: State, sigma_px: Tensor) -> Support:
        """The uncertainty of the points, from the inliers, the state and the noise (B, P) of each point's keypoints."""
        return Support(point_variances(measurements, state, sigma_px), measurements.visible.sum(1), sigma_px)

    def replaced(self, where: Tensor, other: Support) -> Support:
        """A copy with the values of another for the sessions in which ``where`` (B,) is True."""
        return Support(*(torch.where(where[:, None], new, old) for old, new in zip(self, other, strict=True)))


@dataclass(frozen=True)
class Exposures:
    """The exposure times of the keypoints of B sessions.

    Args:
        delays: time from the common frame to the exposure, by timestamps and given read-out time, (B, C, N), frames.
        rows: distance below the middle row of the image as a fraction of the image height, (B, C, N); zero without image size.
    """

    delays: Tensor
    rows: Tensor

    @staticmethod
    def of(frames: CommonFrames, window: slice = slice(None)) -> Exposures:
        """The exposure times of one session.

        Args:
            frames: the session on its common frames.
            window: the common frames to use.
        """
        observations = frames.observations
        ordinates = observations.keypoints[:, window, :, 1].double()
        rows = torch.zeros_like(ordinates)
        if observations.image_size is not None:
            height = observations.image_size.expand(observations.num_cameras, 2)[:, 1].double()
            rows = (ordinates / height[:, None, None] - 0.5).nan_to_num().clamp(-0.5, 0.5)
        delays = frames.lags[:, window, None].expand_as(rows)
        if observations.readout_s is not None and frames.rate_hz is not None:
            delays = delays + observations.readout_s * frames.rate_hz * rows
        return Exposures(delays.flatten(1)[None], rows.flatten(1)[None])

    @staticmethod
    def stack(sessions: Sequence[Exposures]) -> Exposures:
        """The exposure times of several sessions as one batch."""
        return Exposures(torch.cat([s.delays for s in sessions]), torch.cat([s.rows for s in sessions]))

    def unmoved(self, measurements: Measurements) -> Measurements:
        """Measurements with unknown clocks and zero motion, for the time before there are trajectories."""
        velocity = torch.zeros_like(measurements.pixels)
        return replace(measurements, motion=self._motion(velocity, measurements.unknowns.given))

    def at_common_times(self, measurements: Measurements, state: State, support: Support) -> Measurements:
        """Measurements with the keypoints moved to the common frames.

        The error of the interpolation lowers the confidence of a keypoint.

        Args:
            measurements: the keypoints as detected.
            state: cameras, points and unknowns, which determine the motion of the keypoints.
            support: the uncertainty of the points.
        """
        m = measurements
        delays = self.delays + m.unknowns.delays(self.rows, state.unknowns)
        at_once = not bool(delays.any())
        intrinsics = m.cameras_at(state).to(torch.float64)
        pixels, velocity, confidence = m.pixels.clone(), torch.empty_like(m.pixels), m.confidence.clone()
        for session in range(m.sessions):
            tracks = (m.by_frame(of_points[session]) for of_points in (state.points, support.variance, support.views))
            trajectories = Trajectories(*tracks)
            cameras, poses = intrinsics[session], (state.rotations[session], state.translations[session])
            for columns, frames in zip(m.chunks(), m.frame_slices(), strict=True):
                polynomials, delay = trajectories.polynomials(frames), delays[session, :, columns]
                if at_once:
                    points, velocities = polynomials.coefficients[:2]
                else:
                    points, velocities = polynomials.positions(delay), polynomials.velocities(delay)
                at_exposure, inverse_depth, image_velocity = _project_moving(cameras, poses, points, velocities)
                in_front = inverse_depth > 0
                velocity[session, ..., columns] = image_velocity.where(in_front[:, None], 0.0).to(pixels.dtype)
                if at_once:  # all keypoints are where they would be
                    continue
                x, y, z = _to_cameras(poses, polynomials.positions(torch.zeros_like(delay))).unbind(1)
                shift = at_exposure - torch.stack(cameras.project_components(x, y, z), dim=1)
                pixels[session, ..., columns] -= shift.where((in_front & (z > 0))[:, None], 0.0).to(pixels.dtype)
                std_px = polynomials.interpolation_std_m(delay) * cameras.focal_px[:, None] * inverse_depth
                variance_ratio = (std_px / support.sigma_px[session].repeat(frames.stop - frames.start)).square()
                weights = confidence[session, :, columns]
                weights /= 1 + weights * variance_ratio.to(pixels.dtype)
        return replace(m, pixels=pixels, confidence=confidence, motion=self._motion(velocity, state.unknowns))

    def _motion(self, velocity: Tensor, reference: Tensor) -> ImageMotion:
        return ImageMotion(velocity, self.rows.to(velocity), reference)


def _project_moving(
    cameras: Intrinsics, poses: tuple[Tensor, Tensor], points: Tensor, velocities: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Projections of moving points.

    Args:
        cameras: C cameras.
        poses: rotations (C, 3, 3) and translations (C, 3), world to camera.
        points: each camera's own points in the world, (C, 3, n), or those of all, (3, n), metres.
        velocities: likewise, metres per frame.

    Returns:
        Pixels (C, 2, n), inverse depths (C, n), and velocities in the image (C, 2, n), pixels per frame.
    """
    x, y, z = _to_cameras(poses, points).unbind(1)
    inverse_depth = inverse_depths(z)
    u, v = x * inverse_depth, y * inverse_depth
    projection = cameras.pixels_with_jacobian(u, v)
    image_velocity = torch.stack(projection.moved(u, v, inverse_depth, poses[0] @ velocities), dim=1)
    return torch.stack([projection.x, projection.y], dim=1), inverse_depth, image_velocity


def _to_cameras(poses: tuple[Tensor, Tensor], points: Tensor) -> Tensor:
    """Each camera's own points (C, 3, n), or those of all (3, n), from the world to the camera: (C, 3, n)."""
    rotations, translations = poses
    return rotations @ points + translations[..., None]
