"""Keypoints brought to the common frames: each moved in the image by what its point moved between its exposure and the frame.

The movement is that of the points' own trajectories, as far as the cameras have found them, and not of the keypoints, whose
noise would pass for motion. So clocks are adjusted like lenses, by columns of the camera system, and the trajectories are
taken anew from each adjustment.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchstickcal.camera_unknowns import ImageMotion
from torchstickcal.cameras import Intrinsics, inverse_depths
from torchstickcal.problem import Measurements, State
from torchstickcal.synchronise.frames import CommonFrames
from torchstickcal.trajectories import Trajectories


@dataclass(frozen=True)
class Exposures:
    """When the keypoints of one session were exposed.

    Args:
        delays: (C, N), frames after the common frame that they stand at, as far as that was told.
        rows: (C, N), how far below the middle row they are, as shares of the image's height; zero where that is not known.
    """

    delays: Tensor
    rows: Tensor

    @staticmethod
    def of(frames: CommonFrames, window: slice = slice(None)) -> Exposures:
        """Those of a session on its common frames, or on some of them."""
        observations = frames.observations
        size, ordinates = observations.image_size, observations.keypoints[:, window, :, 1].double()
        rows = torch.zeros_like(ordinates)
        if size is not None:
            height = size.expand(observations.num_cameras, 2)[:, 1].double()
            rows = (ordinates / height[:, None, None] - 0.5).nan_to_num().clamp(-0.5, 0.5)
        delays = frames.lags[:, window, None].expand(-1, -1, observations.num_points)
        if observations.readout_s is not None and frames.rate_hz is not None:
            delays = delays + observations.readout_s * frames.rate_hz * rows
        return Exposures(delays.flatten(1), rows.flatten(1))

    def resting(self, measurements: Measurements) -> Measurements:
        """Measurements with clocks among their unknowns as if nothing moved: where trajectories are not known yet."""
        assert measurements.unknowns is not None
        reckoned = torch.zeros_like(measurements.unknowns.prior_sigma)
        return replace(measurements, motion=self._motion(torch.zeros_like(measurements.pixels), reckoned))

    def placed(
        self, measurements: Measurements, state: State, variance: Tensor, views: Tensor, sigma_px: Tensor
    ) -> Measurements:
        """Measurements with their keypoints moved to the common frames, and less weight where the motion between is not known.

        Args:
            measurements: one session as seen.
            state: the cameras, points and unknowns at which to place them.
            variance: of the points along an axis, (1, N), square metres; infinite where a point is not known.
            views: how many cameras hold a point, (1, N).
            sigma_px: noise of each point's keypoints, (1, P).
        """
        m, unknowns = measurements, measurements.unknowns
        delays = self.delays
        if unknowns is not None and state.unknowns is not None:
            delays = delays + unknowns.delays(self.rows[None], state.unknowns)[0]
        trajectories = Trajectories(*(m.by_frame(of_points)[0] for of_points in (state.points, variance, views)))
        cameras = m.cameras_at(state).to(torch.float64)[0]
        pose = state.rotations[0], state.translations[0]
        pixels, velocity, confidence = m.pixels.clone(), torch.empty_like(m.pixels), m.confidence.clone()
        for columns, frames in zip(m.chunks(), m.frame_slices(), strict=True):
            pieces, delay = trajectories.pieces(frames), delays[:, columns]
            late, depth, moving = _seen(cameras, pose, pieces.positions(delay), pieces.velocities(delay))
            x, y, z = _in_cameras(pose, pieces.positions(torch.zeros_like(delay))).unbind(1)
            moved = late - torch.stack(cameras.project_components(x, y, z), dim=1)
            pixels[0, ..., columns] -= moved.where(((depth > 0) & (z > 0))[:, None], 0.0).to(pixels.dtype)
            velocity[0, ..., columns] = moving.where((depth > 0)[:, None], 0.0).to(pixels.dtype)
            deviation = pieces.deviations_m(delay) * cameras.focal_px[:, None] * depth
            variance_ratio = (deviation / sigma_px[0].repeat(frames.stop - frames.start)).square()
            confidence[0, :, columns] /= 1 + confidence[0, :, columns] * variance_ratio.to(pixels.dtype)
        reckoned = torch.zeros(1, 0).to(state.points) if state.unknowns is None else state.unknowns
        return replace(m, pixels=pixels, confidence=confidence, motion=self._motion(velocity, reckoned))

    def _motion(self, velocity: Tensor, reckoned: Tensor) -> ImageMotion:
        return ImageMotion(velocity, self.rows[None].to(velocity), reckoned)


def _seen(
    cameras: Intrinsics, pose: tuple[Tensor, Tensor], points: Tensor, velocities: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Pixels (C, 2, n) of points (C, 3, n) that have velocities, their inverse depths (C, n), and velocities in the image."""
    x, y, z = _in_cameras(pose, points).unbind(1)
    inverse_depth = inverse_depths(z)
    u, v = x * inverse_depth, y * inverse_depth
    m = cameras.pixels_with_jacobian(u, v)
    dx, dy, dz = (pose[0] @ velocities).unbind(1)
    du, dv = (dx - u * dz) * inverse_depth, (dy - v * dz) * inverse_depth
    moving = torch.stack([m.dx_du * du + m.dx_dv * dv, m.dy_du * du + m.dy_dv * dv], dim=1)
    return torch.stack([m.x, m.y], dim=1), inverse_depth, moving


def _in_cameras(pose: tuple[Tensor, Tensor], points: Tensor) -> Tensor:
    """Points (C, 3, n) of the world, each camera's own, in the cameras' frames."""
    rotations, translations = pose
    return rotations @ points + translations[..., None]
