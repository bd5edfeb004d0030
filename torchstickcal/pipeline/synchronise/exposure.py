"""Keypoints moved to the common frames: each by as much as its point moves in the image between its exposure and the frame.

The motion is taken from the trajectories of the estimated points, not from the keypoints, whose noise would look like motion.
So clocks are estimated like lenses, by columns of the camera system, and the trajectories are renewed after each adjustment.
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
    """How well the points of B sessions are known."""

    variance: Tensor
    """(B, N), of a point along an axis, square metres; infinite where it is not known"""
    views: Tensor
    """(B, N), number of cameras that see a point"""
    sigma_px: Tensor
    """(B, P), noise of each point's keypoints, pixels"""

    @staticmethod
    def of(measurements: Measurements, state: State, sigma_px: Tensor) -> Support:
        """From the measurements that took part, at a state, with the noise (B, P) of each point's keypoints."""
        return Support(point_variances(measurements, state, sigma_px), measurements.visible.sum(1), sigma_px)

    def replaced(self, where: Tensor, other: Support) -> Support:
        """The same with some sessions (B,), True where, taken from another."""
        return Support(*(torch.where(where[:, None], new, old) for old, new in zip(self, other, strict=True)))


@dataclass(frozen=True)
class Exposures:
    """When the keypoints of B sessions were exposed.

    Args:
        delays: (B, C, N), given time from the common frame to the exposure, in frames.
        rows: (B, C, N), distance below the middle row as a fraction of the image height; zero where the size is not known.
    """

    delays: Tensor
    rows: Tensor

    @staticmethod
    def of(frames: CommonFrames, window: slice = slice(None)) -> Exposures:
        """Exposures of a session on its common frames, or on some of them, by its timestamps and read-out time."""
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
        """Exposures of several sessions as one batch."""
        return Exposures(torch.cat([s.delays for s in sessions]), torch.cat([s.rows for s in sessions]))

    def unmoved(self, measurements: Measurements) -> Measurements:
        """Measurements with unknown clocks, as if nothing moved: as long as there are no trajectories."""
        still = torch.zeros_like(measurements.pixels)
        return replace(measurements, motion=self._motion(still, measurements.unknowns.given))

    def on_common_frames(self, measurements: Measurements, state: State, support: Support) -> Measurements:
        """Measurements with the keypoints moved to the common frames, and less weight where the motion in between is not known.

        Args:
            measurements: the keypoints as detected.
            state: cameras, points and unknowns that say where the keypoints move.
            support: how well the points are known.
        """
        m = measurements
        delays = self.delays + m.unknowns.delays(self.rows, state.unknowns)
        every_camera = m.cameras_at(state).to(torch.float64)
        pixels, velocity, confidence = m.pixels.clone(), torch.empty_like(m.pixels), m.confidence.clone()
        for session in range(m.sessions):
            tracks = (m.by_frame(of_points[session]) for of_points in (state.points, support.variance, support.views))
            trajectories = Trajectories(*tracks)
            cameras, pose = every_camera[session], (state.rotations[session], state.translations[session])
            for columns, frames in zip(m.chunks(), m.frame_slices(), strict=True):
                pieces, delay = trajectories.pieces(frames), delays[session, :, columns]
                exposed, depth, moving = _seen(cameras, pose, pieces.positions(delay), pieces.velocities(delay))
                x, y, z = _in_cameras(pose, pieces.positions(torch.zeros_like(delay))).unbind(1)
                moved = exposed - torch.stack(cameras.project_components(x, y, z), dim=1)
                pixels[session, ..., columns] -= moved.where(((depth > 0) & (z > 0))[:, None], 0.0).to(pixels.dtype)
                velocity[session, ..., columns] = moving.where((depth > 0)[:, None], 0.0).to(pixels.dtype)
                deviation = pieces.deviations_m(delay) * cameras.focal_px[:, None] * depth
                variance_ratio = (deviation / support.sigma_px[session].repeat(frames.stop - frames.start)).square()
                weights = confidence[session, :, columns]
                weights /= 1 + weights * variance_ratio.to(pixels.dtype)
        return replace(m, pixels=pixels, confidence=confidence, motion=self._motion(velocity, state.unknowns))

    def _motion(self, velocity: Tensor, reference: Tensor) -> ImageMotion:
        return ImageMotion(velocity, self.rows.to(velocity), reference)


def _seen(
    cameras: Intrinsics, pose: tuple[Tensor, Tensor], points: Tensor, velocities: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Pixels (C, 2, n) of points (C, 3, n) that have velocities, their inverse depths (C, n), and velocities in the image."""
    x, y, z = _in_cameras(pose, points).unbind(1)
    inverse_depth = inverse_depths(z)
    u, v = x * inverse_depth, y * inverse_depth
    m = cameras.pixels_with_jacobian(u, v)
    moving = torch.stack(m.moved(u, v, inverse_depth, pose[0] @ velocities), dim=1)
    return torch.stack([m.x, m.y], dim=1), inverse_depth, moving


def _in_cameras(pose: tuple[Tensor, Tensor], points: Tensor) -> Tensor:
    """Points (C, 3, n) of the world, each camera's own, in the cameras' frames."""
    rotations, translations = pose
    return rotations @ points + translations[..., None]
