"""The keypoints of one session, linearised at a solution and reduced to the cameras, frame by frame.

The points are eliminated exactly, and neither sticks nor smoothness take part. What is left of a frame is how strongly, and in
which direction, its keypoints pull at the pose of each camera, when every point may follow.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchstickcal.geometry.singular import covariance_root
from torchstickcal.geometry.symmetric import IDENTITY, cholesky, forward
from torchstickcal.geometry.vectors import times_vectors
from torchstickcal.losses import ReprojectionLoss
from torchstickcal.losses.robust import GemanMcClure
from torchstickcal.model.measurements import Measurements
from torchstickcal.model.objective import Objective
from torchstickcal.model.state import State
from torchstickcal.solvers.elimination.cross_blocks import cross_rows

_MOST_PARTS = 400
"""Parts of a session of which the information is kept apart. Longer sessions have several frames in a part."""
_KERNEL_SIGMAS = 4.0
"""Scale of the robust kernel: wrong keypoints must not look like a motion, and those of a camera that moved should pull."""


@dataclass(frozen=True)
class FramePulls:
    """How the keypoints of each frame pull at the cameras.

    Poses are perturbed on the world's side, ``T <- T Exp(tangent)``: tangents are (translation, rotation), metres and radians.
    """

    gradient: Tensor
    """(F, C, 6), half the gradient of the squared whitened residuals by the tangents"""
    information: Tensor
    """(K, 6 C, 6 C), information about the tangents in each part of the session"""
    part: Tensor
    """(F,), the part that each frame is in"""

    @staticmethod
    def of(measurements: Measurements, state: State, sigma_px: Tensor) -> FramePulls:
        """Of one session.

        Args:
            measurements: all keypoints, inliers and outliers.
            state: the solution.
            sigma_px: noise of each point's keypoints, (1, P), pixels.
        """
        m, cameras = measurements, measurements.num_cameras
        loss = ReprojectionLoss(sigma_px[:, None, None], kernel=GemanMcClure(_KERNEL_SIGMAS))
        objective = Objective(m, {"reprojection": loss})
        count = min(m.frames, _MOST_PARTS)
        part = torch.arange(m.frames, device=state.points.device) * count // m.frames
        gradient = state.points.new_zeros(m.frames, cameras, 6)
        information = state.points.new_zeros(count, 6 * cameras, 6 * cameras)
        for columns, frames in zip(m.chunks(), m.frame_slices(), strict=True):
            terms = objective.linearise_chunk(state, columns, by_unknowns=False)["reprojection"]
            points, seen = state.points[0][:, columns], m.active[0, columns]
            pulls, blocks = _reduced(terms.gradient[0].double(), terms.hessian[0].double(), points, seen, m.points_per_frame)
            gradient[frames] = pulls
            information.index_add_(0, part[frames], blocks)
        return FramePulls(gradient, information, part)

    @property
    def parts(self) -> int:
        """K"""
        return len(self.information)

    @property
    def gradient_by_part(self) -> Tensor:
        """(K, C, 6)"""
        return self.gradient.new_zeros(self.parts, *self.gradient.shape[1:]).index_add_(0, self.part, self.gradient)

    def first_frame(self, part: int) -> int:
        """The first frame of a part."""
        return int((self.part == part).nonzero()[0])


def variance_of_sums(pull: Tensor, own: Tensor, blocks: Sequence[int]) -> Tensor:
    """Variance (...) of sums of pulls (..., K, 6), over that of independent keypoints with the noise that was found for them.

    It is the largest of that of single parts, and of sums over each number of blocks of parts.

    Args:
        pull: of one camera, or of each of several.
        own: information about it, (..., K, 6, 6).
        blocks: numbers of blocks.
    """
    white = pull @ covariance_root(own.mean(-3))
    parts, found = white.shape[-2], list[Tensor]()
    for length in {1, *(max(1, parts // count) for count in blocks)}:
        sums = white[..., : parts // length * length, :].unflatten(-2, (-1, length)).sum(-2) / length**0.5
        found.append(sums.square().mean((-2, -1)))
    return torch.stack(found).amax(0)


def _reduced(gradients: Tensor, blocks: Tensor, points: Tensor, seen: Tensor, per_frame: int) -> tuple[Tensor, Tensor]:
    """Pulls (f, C, 6) and information (f, 6 C, 6 C) of the frames of a chunk.

    Args:
        gradients: (C, 3, n), by the points.
        blocks: (C, 6, n), Hessians by the points.
        points: (3, n).
        seen: (n,), whether two cameras or more see a point.
        per_frame: P.
    """
    lower = cholesky(blocks.sum(0).where(seen, blocks.new_tensor(IDENTITY)[:, None]))
    rows = cross_rows(blocks[None], points[None])[0]

    def by_frame(values: Tensor) -> Tensor:
        """(..., a, n) as (f, ..., a P)."""
        return values.unflatten(-1, (-1, per_frame)).movedim(-2, 0).flatten(-2)

    half, solved = by_frame(forward(lower, rows)).flatten(1, 2), by_frame(forward(lower, gradients.sum(0)))
    homogeneous = torch.cat([torch.ones_like(points[:1]), points]).unflatten(-1, (-1, per_frame)).permute(1, 2, 0)
    forces = torch.cat([gradients[:, None], rows], dim=1).unflatten(-1, (-1, per_frame)).movedim(-2, 0)
    force, moments = (forces.flatten(1, 3) @ homogeneous).view(*forces.shape[:-1], 4).split((1, 3), dim=-1)
    torque = torch.stack([moments[..., j, i] - moments[..., i, j] for i, j in ((1, 2), (2, 0), (0, 1))], dim=-1)
    direct = torch.cat([force[..., 0], torque], dim=-1)
    pulls = direct[:, :, 0] - times_vectors(half, solved).view(len(half), -1, 6)
    information = -half @ half.mT
    own = information.view(len(half), len(blocks), 6, len(blocks), 6).diagonal(dim1=1, dim2=3)
    own += direct[:, :, 1:].permute(0, 2, 3, 1)
    return pulls, information
