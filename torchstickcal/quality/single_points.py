"""How much the errors of single points change slowly, by themselves, beside a change of a camera.

When a camera moves, all its points agree on the change. Errors that depend on the view or on the pose of the athlete change
too, each point by itself. Few points may happen to change as if their camera had moved. So a change of a camera is told from
them only if it is larger than what single points do at any time of the session. The fewer points there are, the less is known
of what they do, and the larger it has to be.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from torchstickcal.geometry import se3
from torchstickcal.geometry.symmetric import IDENTITY, solve
from torchstickcal.losses import ReprojectionLoss
from torchstickcal.model.measurements import Measurements
from torchstickcal.model.objective import Objective
from torchstickcal.model.state import State
from torchstickcal.quality.moved import Motion
from torchstickcal.quality.resection import resected

_MOST_PARTS = 400
"""Parts of a session of which the errors are kept apart. Longer sessions have several frames in a part."""
_LARGEST_EXPONENT = 50.0
_DAMPING = 1e-3
"""Of a point's step, over its information: keeps it near where it is along a direction in which its keypoints hardly change."""
_DIAGONAL = [0, 3, 5]
"""The entries xx, yy and zz of symmetric matrices."""
_LEAST_FRAMES = 4
"""Least number of frames before and after, for a change of a point to be known."""
_OF_A_TRACK = 2.5
"""Degrees of freedom of the squared changes of one track with independent errors, averaged over all frames: those of a Brownian
bridge, ``(sum 1 / k^2)^2 / (sum 1 / k^4)``."""


class SlowChanges(NamedTuple):
    """Slow changes of the errors of single points.

    A change is the difference between the mean errors of one point in one camera before and after some frame.
    """

    variance: float
    """mean over all points, cameras and frames, over that of independent errors"""
    freedom: float
    """degrees of freedom of this mean; few where there are few points, or where few of them change"""

    def least(self, sigmas: float) -> float:
        """Standard deviations by independent errors that are as unlikely as ``sigmas`` where errors change so slowly."""
        return (max(1.0, self.variance) * estimated(sigmas**2, self.freedom)) ** 0.5


def estimated(squared: float, freedom: float) -> float:
    """Squared length in estimated standard deviations that is as unlikely as ``squared`` in known ones, by likelihood ratio.

    Args:
        squared: length in standard deviations, squared.
        freedom: degrees of freedom of the estimate.
    """
    freedom = max(freedom, 1.0)
    return freedom * math.expm1(min(squared / freedom, _LARGEST_EXPONENT))


class Explanation(NamedTuple):
    """A session as it would be by what is doubted: a camera that moved, or another focal length."""

    measurements: Measurements
    """the inliers"""
    state: State
    share: Tensor
    """(F,), how much of it there is in each frame"""

    @staticmethod
    def by_motion(measurements: Measurements, state: State, motion: Motion) -> Explanation:
        """One camera moved."""
        rotations, translations = state.rotations.clone(), state.translations.clone()
        moved = se3.retract(rotations[0, motion.camera], translations[0, motion.camera], motion.tangent)
        rotations[0, motion.camera], translations[0, motion.camera] = moved
        moved_state = replace(state, rotations=rotations, translations=translations)
        return Explanation(measurements, moved_state, motion.share(measurements.frames).to(state.points))

    @staticmethod
    def by_focal(measurements: Measurements, state: State, sigma_px: Tensor, camera: int, factor: float) -> Explanation:
        """The focal length of one camera is larger by a factor; the camera is placed anew by the points."""
        m, matrix = measurements, measurements.cameras.matrix.clone()
        matrix[0, camera, :2, :2] *= factor
        cameras = replace(m.cameras, matrix=matrix)
        seen, pose = m.visible[0, camera], (state.rotations[0, camera], state.translations[0, camera])
        sigma = sigma_px.expand(m.frames, -1).flatten()[seen]
        placed = resected(
            state.points[0][:, seen], m.pixels[0, camera][:, seen].double(), sigma, cameras[0][camera : camera + 1], start=pose
        )
        rotations, translations = state.rotations.clone(), state.translations.clone()
        if placed is not None:
            rotations[0, camera], translations[0, camera] = placed.rotation, placed.translation
        other = replace(state, rotations=rotations, translations=translations)
        return Explanation(replace(m, cameras=cameras), other, state.points.new_ones(m.frames))


def slow_changes(
    measurements: Measurements, state: State, sigma_px: Tensor, times: Tensor, explanation: Explanation | None = None
) -> SlowChanges:
    """The slow changes of single points beside an explanation.

    Args:
        measurements: the inliers of one session.
        state: the solution.
        sigma_px: noise of each point's keypoints, (1, P), pixels.
        times: (P,), as many keypoints of each point are counted as one.
        explanation: is taken out, as much of it as leaves the least changes; None for none.
    """
    sums = _Sums.of(measurements, state, sigma_px, explanation)
    count = sums.seen
    total = count[:, :, -1:].clamp_min(1)
    errors, added = (own.cumsum(2) for own in (sums.errors, sums.added))
    errors, added = (own - own[:, :, -1:] * count / total for own in (errors, added))
    amount = -(errors * added).sum() / added.square().sum().clamp_min(1e-12)
    independent = count * (1 - count / total)
    told = (count >= _LEAST_FRAMES) & (total - count >= _LEAST_FRAMES)
    known = told.any(2).expand(-1, 2, -1)
    if not bool(known.any()):
        return SlowChanges(1.0, 0.0)
    squared = ((errors + amount * added).square() / independent.clamp_min(1)).where(told, 0.0)
    changes = (squared.sum(2) / told.sum(2).clamp_min(1))[known]
    variance = (sums.squares(float(amount)) / (total[:, :, 0] - 1).clamp_min(1))[known]
    alike = changes.sum().square() / changes.square().sum().clamp_min(1e-12)
    slow = (changes / times.expand_as(known)[known]).sum() / variance.sum().clamp_min(1e-12)
    return SlowChanges(float(slow), float((_OF_A_TRACK + 2) * alike * sums.left_by_points))


class _Sums(NamedTuple):
    """Sums of the errors of K parts of a session, in standard deviations."""

    errors: Tensor
    """(C, 2, K, P), for the points that fit the keypoints best"""
    added: Tensor
    """(C, 2, K, P), what the explanation adds to them"""
    seen: Tensor
    """(C, 1, K, P), number of keypoints until the end of each part"""
    products: Tensor
    """(3, C, 2, P), sums over all frames of the squared errors, of errors times what is added, and of this squared"""
    left_by_points: float
    """degrees of freedom of the keypoints when the points are fitted, as a share of all"""

    @staticmethod
    def of(m: Measurements, state: State, sigma_px: Tensor, explanation: Explanation | None) -> _Sums:
        """By chunks of frames."""
        parts = min(m.frames, _MOST_PARTS)
        part = torch.arange(m.frames, device=state.points.device) * parts // m.frames
        shape = m.num_cameras, 2, parts, m.points_per_frame
        errors, added, count = (state.points.new_zeros(*shape) for _ in range(3))
        products = state.points.new_zeros(3, *shape[:2], shape[3])
        for columns, frames in zip(m.chunks(), m.frame_slices(), strict=True):
            seen = m.by_frame(m.visible[0])[:, None, frames]
            own = _errors(m.within(frames), state, columns, sigma_px).where(seen, 0.0)
            change = torch.zeros_like(own)
            if explanation is not None:
                other = _errors(explanation.measurements.within(frames), explanation.state, columns, sigma_px)
                change = explanation.share[frames, None] * (other.where(seen, 0.0) - own)
            errors.index_add_(2, part[frames], own)
            added.index_add_(2, part[frames], change)
            count.index_add_(2, part[frames], seen.to(count).expand_as(own))
            products += torch.stack([(one * two).sum(2) for one, two in ((own, own), (own, change), (change, change))])
        views = m.visible[0].sum(0).double()
        left = float((2 * views - 3).clamp_min(0).sum() / (2 * views).sum().clamp_min(1))
        return _Sums(errors, added, count[:, :1].cumsum(2), products, left)

    def squares(self, amount: float) -> Tensor:
        """(C, 2, P), sums of squares of what varies of the errors, when an amount of the explanation is added."""
        whole = self.products[0] + 2 * amount * self.products[1] + amount**2 * self.products[2]
        mean = (self.errors + amount * self.added).sum(2)
        return whole - mean.square() / self.seen[:, :, -1].clamp_min(1)


def _errors(chunk: Measurements, state: State, columns: slice, sigma_px: Tensor) -> Tensor:
    """Residuals (C, 2, f, P) of a chunk in standard deviations, for the points that fit its keypoints best, near the state."""
    own = replace(state, points=state.points[..., columns])
    objective = Objective(chunk, {"reprojection": ReprojectionLoss(sigma_px[:, None, None])})
    terms = objective.linearise_chunk(own, slice(0, chunk.num_columns), by_unknowns=False)["reprojection"]
    information, gradient = terms.hessian[0].double().sum(0), terms.gradient[0].double().sum(0)
    information = information + _DAMPING * information[_DIAGONAL].sum(0) * information.new_tensor(IDENTITY)[:, None]
    step = solve(information.where(chunk.active[0], information.new_tensor(IDENTITY)[:, None]), gradient)
    fitted = replace(own, points=(own.points[0] - step.where(chunk.active[0], 0.0))[None])
    residuals = torch.cat([residual[0] for _, residual, _ in chunk.residuals(fitted)], dim=-1).double()
    return residuals.unflatten(-1, (-1, chunk.points_per_frame)) / sigma_px
