"""The acceptance test: lengths and keypoints predicted by calibrations that did not see them, in the form of VDI/VDE 2634.

The frames are divided into folds. The cameras without a fold follow from those with all frames by one step of the reduced
system, from which the fold's share is taken out. They triangulate the ends of the sticks in the frames of the fold from the
keypoints alone: neither the length of the stick nor the smoothness of the motion takes part. The scale comes from the other
frames.
"""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from torchstickcal.geometry.singular import solve_information
from torchstickcal.geometry.symmetric import IDENTITY, backward, cholesky, expand, forward, solve
from torchstickcal.geometry.vectors import lengths
from torchstickcal.losses import ReprojectionLoss
from torchstickcal.model.measurements import Measurements
from torchstickcal.model.objective import Objective
from torchstickcal.model.state import State
from torchstickcal.pipeline.adjustment import Adjustment
from torchstickcal.pipeline.folds import folds_of_frames
from torchstickcal.quality.verdict import Acceptance, LengthErrors
from torchstickcal.shapes import extended
from torchstickcal.solvers.elimination.cross_blocks import cross_rows
from torchstickcal.solvers.uncertainty import likelihood

_FOLDS = 5
_MOST_FRAMES = 1000
_LEAST_LENGTHS = 5
_TRIANGULATIONS = 2
_SIGMAS = 1.96
_WRONG_SIGMAS = 6.0
"""Error of a length, in its standard deviations, from which on a keypoint of its ends is simply wrong."""


def accepted(ended: Adjustment, noise: Tensor, ruler: Tensor, by_focal_m: float) -> Acceptance | None:
    """The acceptance test of one session; None where no camera was estimated or no point is known.

    Args:
        ended: the session. Of a long one the middle is tested.
        noise: covariance of the cameras' tangents and unknowns by the errors of the keypoints.
        ruler: the covariance that the errors of the sticks' given lengths add. It is no part of a length's deviation from the
            given one, but of that from the true one.
        by_focal_m: by how much cameras are misplaced where each given focal length is wrong by 1 %, metres; NaN where these
            were estimated.
    """
    part = ended.within(_MOST_FRAMES)
    kept = part.kept
    if ended.last_camera_stage.stage.cameras != "free" or not bool(kept.active.any()):
        return None
    sigma_px = part.last.sigma_px
    predictions = _predicted(part, kept, noise, ruler)
    residual = _Residuals.of(kept, part.state, sigma_px)
    lengths = [] if predictions is None else [p.errors(part) for p in predictions]
    metre, share = (torch.inf, 0.0) if predictions is None else _metre(predictions)
    return Acceptance(
        lengths=tuple(one for one in lengths if one is not None),
        metre_m=metre,
        calibration_share=share,
        reprojection_px=residual.rms_px,
        reprojection_mrad=residual.rms_mrad,
        ray_distance_m=residual.ray_distance_m,
        left_out_px=residual.left_out_px,
        by_focal_m=by_focal_m,
    )


class Prediction(NamedTuple):
    """The lengths of one stick, each predicted by cameras that did not see its frame, (F,); NaN where not known."""

    stick: int
    length_m: Tensor
    by_keypoints_m: Tensor
    """standard deviation by the keypoints"""
    by_cameras_m: Tensor
    """standard deviation by the cameras, without that of the stick's given length"""
    by_calibration_m: Tensor
    """standard deviation by the cameras, with it"""
    ends: Tensor
    """(2, 3, F), metres"""

    def errors(self, part: Adjustment) -> LengthErrors | None:
        """The errors as a table has them; None where there are too few lengths."""
        known = self.length_m.isfinite()
        if int(known.sum()) < _LEAST_LENGTHS:
            return None
        stick = part.measurements.sticks[self.stick].tolist()
        given = float(part.measurements.lengths_m[0, self.stick])
        errors = self.length_m[known] - given
        std = (self.by_keypoints_m.square() + self.by_cameras_m.square()).sqrt()[known]
        right = errors.abs() <= _WRONG_SIGMAS * std
        if int(right.sum()) < _LEAST_LENGTHS:
            right = torch.ones_like(right)
        inside = float((errors.abs() <= _SIGMAS * std).double().mean())
        places = self.ends[..., known].movedim(1, -1).flatten(0, 1)
        axes = torch.linalg.svd(places - places.mean(0), full_matrices=False).Vh
        along = (places - places.mean(0)) @ axes.mT
        x, y, z = (along.amax(0) - along.amin(0)).tolist()
        return LengthErrors(
            stick=" - ".join(map(part.observations[0].point_label, stick)),
            given_m=given,
            frames=len(errors),
            wrong=int((~right).sum()),
            largest_m=float(errors[right][errors[right].abs().argmax()]),
            mean_m=float(errors[right].mean()),
            std_m=float(errors[right].std()),
            inside=inside,
            volume_m=(x, y, z),
        )


def _predicted(part: Adjustment, kept: Measurements, noise: Tensor, ruler: Tensor) -> list[Prediction] | None:
    """The lengths of each stick; None without sticks among the points that take part."""
    if not len(kept.sticks) or not bool(kept.stick_active.any()):
        return None
    chosen = kept.sticks.flatten().unique()
    ends, state = _only(kept, part.state, chosen)
    objective = Objective(ends, {"reprojection": ReprojectionLoss(part.last.sigma_px[:, None, None, chosen])})
    seen = Triangulated.of(objective, state)
    points = seen.points
    for _ in range(_TRIANGULATIONS - 1):
        points = Triangulated.of(objective, replace(state, points=points[None])).points
    tangents = _shifts_without_folds(part, kept).repeat_interleave(len(chosen), 0)
    points = points + seen.moved(tangents.mT[:, None])
    lower, rows, points, active = map(ends.by_frame, (seen.lower, seen.rows, points, ends.active[0]))
    found: list[Prediction] = []
    for number, (start, end) in enumerate(ends.sticks.tolist()):
        known = active[:, start] & active[:, end]
        along = points[..., end] - points[..., start]
        length = lengths(along)
        unit = along / length.clamp_min(1e-12)
        of_start, of_end = (forward(lower[..., point], unit) for point in (start, end))
        keypoints = (of_start.square() + of_end.square()).sum(0)
        by_tangent = torch.einsum("kaf,af->fk", rows[..., start], of_start) - torch.einsum("kaf,af->fk", rows[..., end], of_end)
        by_noise, by_ruler = (((by_tangent @ c) * by_tangent).sum(1).clamp_min(0.0) for c in (noise, ruler))
        found.append(
            Prediction(
                number,
                length.where(known, torch.nan),
                keypoints.sqrt(),
                by_noise.sqrt(),
                (by_noise + by_ruler).sqrt(),
                torch.stack([points[..., start], points[..., end]]),
            )
        )
    return found


class Triangulated(NamedTuple):
    """Points by themselves, as the keypoints of one session have them near a state: to first order, for cameras as they are."""

    points: Tensor
    """(3, N), metres"""
    lower: Tensor
    """(6, N), the Cholesky factors L of the points' information"""
    rows: Tensor
    """(K, 3, N), ``W^T = (L^-1 H_xc)^T``"""

    @staticmethod
    def of(objective: Objective, state: State) -> Triangulated:
        """By an objective of reprojection alone."""
        m = objective.measurements
        terms = objective.linearise_chunk(state, slice(0, m.num_columns))["reprojection"]
        known, gradient = m.active[0], terms.gradient[0].double().sum(0)
        information = terms.hessian[0].double().sum(0).where(known, gradient.new_tensor(IDENTITY)[:, None])
        lower = cholesky(information)
        rows = cross_rows(terms.hessian[:, 1:].double(), state.points)[0].flatten(0, 1)
        if terms.unknown is not None:
            coupling = terms.unknown.coupling[0].double().flatten(2).flatten(0, 1)
            own = m.unknowns.share.flatten(0, 1).mT @ coupling
            rows = torch.cat([rows, own.unflatten(1, (3, -1))])
        points = state.points[0] - backward(lower, forward(lower, gradient))
        return Triangulated(points, lower, forward(lower, rows))

    def moved(self, tangents: Tensor) -> Tensor:
        """How far the points move (3, N) where the cameras' tangents and unknowns are elsewhere: ``-L^-T W t``.

        Args:
            tangents: (K,), or for each point its own, (K, 1, N).
        """
        return -backward(self.lower, (self.rows * extended(tangents, 3)).sum(0))


def _shifts_without_folds(part: Adjustment, kept: Measurements) -> Tensor:
    """How far the cameras' tangents and unknowns would be elsewhere without the fold that each frame is in, (F, K)."""
    objective, state = likelihood(kept, part.last_camera_stage.losses, part.last.sigma_px), part.state
    bounds = [kept.frames * number // _FOLDS for number in range(_FOLDS + 1)]
    windows = [slice(start, stop) for start, stop in itertools.pairwise(bounds) if stop > start]
    folds = folds_of_frames(objective, state, windows)
    _, prior_gradient, prior = objective.linearise_prior(state)
    poses = len(folds[0].gradient) - prior.shape[1]
    information = torch.stack([fold.information for fold in folds]).sum(0)
    information.diagonal()[poses:] += prior[0]
    gradient = torch.stack([fold.gradient for fold in folds]).sum(0)
    gradient[poses:] += prior_gradient[0]
    everything = solve_information(information, gradient)
    without = [solve_information(information - fold.information, gradient - fold.gradient) for fold in folds]
    lengths = torch.tensor([window.stop - window.start for window in windows], device=everything.device)
    return (everything - torch.stack(without)).repeat_interleave(lengths, 0)


def _only(kept: Measurements, state: State, points: Tensor) -> tuple[Measurements, State]:
    """The measurements and the state of some points alone, among which all ends of sticks are."""
    first = torch.arange(0, kept.num_columns, kept.points_per_frame, device=points.device)
    columns = (first[:, None] + points).flatten()
    chosen = replace(
        kept,
        pixels=kept.pixels[..., columns],
        confidence=kept.confidence[..., columns],
        sticks=torch.searchsorted(points, kept.sticks),
        motion=kept.motion and kept.motion.at(columns),
        point_names=kept.point_names and tuple(kept.point_names[point] for point in points.tolist()),
    )
    return chosen, replace(state, points=state.points[..., columns])


def _metre(predictions: list[Prediction]) -> tuple[float, float]:
    """Half the width of the 95 % interval of a length of 1 m where the sticks were, and the calibration's share of it.

    The error by the cameras is taken to grow with the length, as that of the scale does.
    """
    known = [one.length_m.isfinite() for one in predictions]
    keypoints = torch.cat([one.by_keypoints_m[k].square() for one, k in zip(predictions, known, strict=True)]).mean()
    relative = [(one.by_calibration_m / one.length_m)[k].square() for one, k in zip(predictions, known, strict=True)]
    calibration = torch.cat(relative).mean()
    total = keypoints + calibration
    return _SIGMAS * float(total.sqrt()), float(calibration / total.clamp_min(1e-300))


class _Residuals(NamedTuple):
    """How far keypoints are from projections."""

    rms_px: float
    rms_mrad: float
    ray_distance_m: float
    left_out_px: tuple[float, ...]

    @staticmethod
    def of(kept: Measurements, state: State, sigma_px: Tensor) -> _Residuals:
        """Of the keypoints that took part, and of each camera's keypoints to the points of all other cameras."""
        objective = Objective(kept, {"reprojection": ReprojectionLoss(sigma_px[:, None, None])})
        focal = kept.cameras.focal_px[0]
        information = objective.information_of("reprojection")[0]
        squares, left_squares, left_counts = [], torch.zeros_like(focal), torch.zeros_like(focal)
        angles, distances = [], []
        for columns, residuals, depth in kept.residuals(state):
            seen = kept.visible[0][:, columns]
            squared = residuals[0].double().square().sum(1)
            distance = squared.sqrt() / focal[:, None]
            squares.append(squared[seen])
            angles.append(distance[seen])
            distances.append((distance * depth[0])[seen])
            terms = objective.linearise_chunk(state, columns, by_unknowns=False)["reprojection"]
            weight = (kept.confidence[0][:, columns] * information[:, columns]).double()
            predicted = _left_out(terms.gradient[0].double(), terms.hessian[0].double(), squared * weight)
            usable = seen & (seen.sum(0) >= 3)
            left_squares += (predicted / weight.clamp_min(1e-300)).where(usable, 0.0).sum(1)
            left_counts += usable.sum(1)
        rms_px, rms_mrad = (float(torch.cat(values).square().mean().sqrt()) for values in ([s.sqrt() for s in squares], angles))
        left = (left_squares / left_counts).sqrt()
        return _Residuals(rms_px, 1000 * rms_mrad, float(torch.cat(distances).median()), tuple(left.tolist()))


def _left_out(gradients: Tensor, blocks: Tensor, squared: Tensor) -> Tensor:
    """Squared whitened residuals (C, n) of keypoints, from points that were triangulated without them.

    Args:
        gradients: (C, 3, n), by the points.
        blocks: (C, 6, n), Hessians by the points.
        squared: (C, n), squared whitened residuals.
    """
    others = blocks.sum(0) - blocks
    step = -solve(others, gradients.sum(0) - gradients)
    bent = torch.einsum("cijn,cjn->cin", expand(blocks), step)
    return (squared + 2 * (step * gradients).sum(1) + (step * bent).sum(1)).clamp_min(0.0)
