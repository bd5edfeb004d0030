"""Keypoints brought to the common frames: each moved in the image by what its point moved between its exposure and the frame.

The movement is that of the points' own trajectories, as far as the cameras have found them, and not of the keypoints, whose
noise would pass for motion. So clocks are adjusted like lenses, by columns of the camera system, and the trajectories are
taken anew from each adjustment.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from torchstickcal.geometry.cameras import Intrinsics, inverse_depths
from torchstickcal.model.measurements import Measurements, State
from torchstickcal.model.trajectories import Trajectories
from torchstickcal.model.unknowns import ImageMotion
from torchstickcal.pipeline.synchronise.frames import CommonFrames
from torchstickcal.solvers.uncertainty import point_variances


class Support(NamedTuple):
    """What holds the points of B sessions where they are."""

    variance: Tensor
    """of a point along an axis, (B, N), square metres; infinite where it is not known"""
    views: Tensor
    """how many cameras hold a point, (B, N)"""
    sigma_px: Tensor
    """noise of each point's keypoints, (B, P)"""

    @staticmethod
    def of(measurements: Measurements, state: State, sigma_px: Tensor) -> Support:
        """That of the measurements that took part, at a state; the noise is that of each point's keypoints, (B, P)."""
        return Support(point_variances(measurements, state, sigma_px), measurements.visible.sum(1), sigma_px)

    def replaced(self, where: Tensor, other: Support) -> Support:
        """The same with some sessions (B,), True where, taken from another."""
        return Support(*(torch.where(where[:, None], new, old) for old, new in zip(self, other, strict=True)))


@dataclass(frozen=True)
class Exposures:
    """When the keypoints of B sessions were exposed.

    Args:
        delays: (B, C, N), frames after the common frame that they stand at, as far as that was told.
        rows: (B, C, N), how far below the middle row they are, as shares of the image's height; zero where that is not known.
    """

    delays: Tensor
    rows: Tensor

    @staticmethod
    def of(frames: CommonFrames, window: slice = slice(None)) -> Exposures:
        """Those of a session on its common frames, or on some of them."""
        observations = frames.observations
        told = Exposures.together(observations.keypoints[None, :, window], observations.image_size)
        delays = frames.lags[None, :, window, None].expand(-1, -1, -1, observations.num_points).flatten(2)
        if observations.readout_s is not None and frames.rate_hz is not None:
            delays = delays + observations.readout_s * frames.rate_hz * told.rows
        return replace(told, delays=delays)

    @staticmethod
    def together(keypoints: Tensor, image_size: Tensor | None) -> Exposures:
        """Those of keypoints whose middle rows were exposed at the common frames, as far as told.

        Args:
            keypoints: (B, C, F, P, 2), pixels, NaN where not seen.
            image_size: (2,), (C, 2) or (B, C, 2), width and height, pixels; None where that is not known.
        """
        ordinates = keypoints[..., 1].double()
        rows = torch.zeros_like(ordinates)
        if image_size is not None:
            height = image_size.expand(*keypoints.shape[:2], 2)[..., 1].double()
            rows = (ordinates / height[..., None, None] - 0.5).nan_to_num().clamp(-0.5, 0.5)
        return Exposures(torch.zeros_like(rows).flatten(2), rows.flatten(2))

    def resting(self, measurements: Measurements) -> Measurements:
        """Measurements with clocks among their unknowns as if nothing moved: where trajectories are not known yet."""
        assert measurements.unknowns is not None
        reckoned = torch.zeros_like(measurements.unknowns.prior_sigma)
        return replace(measurements, motion=self._motion(torch.zeros_like(measurements.pixels), reckoned))

    def placed(self, measurements: Measurements, state: State, support: Support) -> Measurements:
        """Measurements with their keypoints moved to the common frames, and less weight where the motion between is not known.

        Args:
            measurements: the sessions as seen.
            state: the cameras, points and unknowns at which to place them.
            support: what holds the points.
        """
        m, unknowns = measurements, measurements.unknowns
        delays = self.delays
        if unknowns is not None and state.unknowns is not None:
            delays = delays + unknowns.delays(self.rows, state.unknowns)
        every_camera = m.cameras_at(state).to(torch.float64)
        pixels, velocity, confidence = m.pixels.clone(), torch.empty_like(m.pixels), m.confidence.clone()
        for session in range(m.sessions):
            tracks = (m.by_frame(of_points[session]) for of_points in (state.points, support.variance, support.views))
            trajectories = Trajectories(*tracks)
            cameras, pose = every_camera[session], (state.rotations[session], state.translations[session])
            for columns, frames in zip(m.chunks(), m.frame_slices(), strict=True):
                pieces, delay = trajectories.pieces(frames), delays[session, :, columns]
                late, depth, moving = _seen(cameras, pose, pieces.positions(delay), pieces.velocities(delay))
                x, y, z = _in_cameras(pose, pieces.positions(torch.zeros_like(delay))).unbind(1)
                moved = late - torch.stack(cameras.project_components(x, y, z), dim=1)
                pixels[session, ..., columns] -= moved.where(((depth > 0) & (z > 0))[:, None], 0.0).to(pixels.dtype)
                velocity[session, ..., columns] = moving.where((depth > 0)[:, None], 0.0).to(pixels.dtype)
                deviation = pieces.deviations_m(delay) * cameras.focal_px[:, None] * depth
                variance_ratio = (deviation / support.sigma_px[session].repeat(frames.stop - frames.start)).square()
                weights = confidence[session, :, columns]
                weights /= 1 + weights * variance_ratio.to(pixels.dtype)
        reckoned = torch.zeros(m.sessions, 0).to(state.points) if state.unknowns is None else state.unknowns
        return replace(m, pixels=pixels, confidence=confidence, motion=self._motion(velocity, reckoned))

    def _motion(self, velocity: Tensor, reckoned: Tensor) -> ImageMotion:
        return ImageMotion(velocity, self.rows.to(velocity), reckoned)


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
