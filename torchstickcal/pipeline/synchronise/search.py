"""Search for large time offsets between cameras, from the motion in the images.

All pairs of cameras are compared at all lags between their frames. The offsets are those with the best total score over all
pairs. A parabola through the residual of each pair then gives the fraction of a frame. The geometry is that of fundamental
matrices: neither extrinsics nor camera matrices are needed, only the distortion.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import combinations

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchstickcal.geometry.singular import solve_information
from torchstickcal.model.measurements import Measurements
from torchstickcal.model.trajectories import shifted_in_time
from torchstickcal.pipeline.synchronise.epipolar import EpipolarFit, Tracks

_ROUNDS = 3
"""Number of searches. After each search but the last, keypoints that fit no other camera are removed."""
_MAX_SWEEPS = 10
_MAX_FRAMES = 2000
_CUT = 3.0
"""Distance over its usual size beyond which a keypoint is removed."""
_NEAR_FRAMES, _AROUND_FRAMES = 2, 5
"""Half widths of the windows of the Hampel filter, in frames: for the median position and for the usual distance from it."""
_MIN_SCORE = 0.5
"""Score over the square root of the number of common points, below which there is too little motion."""
_RIVAL_SHARE = 0.75
"""Score of another offset, relative to the best, from which the offset is ambiguous."""
_PEAK_SHARE, _MAX_PEAK_FRAMES = 0.95, 4
"""Offsets with a score above this share of the best form its peak. The peak must not be wider than this, in frames."""
_PAIR_SCALE_FRAMES = 0.5
"""Scale of the Cauchy kernel on the lag of a pair."""
_RIDGE = 1e-9
_COMMON_SHARE = 0.25
"""Number of common points, relative to that at lag 0, from which another lag is compared with lag 0."""
_MIN_LOG_DIFFERENCE = 0.3
"""Difference of :func:`_log_unexplained` above which another lag is better. It is below 0.05 for synchronised cameras and
above 1 for cameras that are whole frames apart."""

_CLEARLY_LESS = math.log(2.0)
"""Difference of :func:`_log_unexplained` by which most pairs of cameras have to fit better at other offsets: half as much is
left unexplained. A camera with poor keypoints fits a little better at some of many lags by chance, but not with most others."""

Fits = dict[tuple[int, int], EpipolarFit]
"""Epipolar residuals of all pairs of cameras."""


@dataclass(frozen=True)
class ClockEstimate:
    """Time offsets of the cameras from camera 0."""

    offsets_frames: Tensor
    """(C,), float64: frame f of camera c shows the same moment as frame f + offset of camera 0; 0 if undetermined"""
    likeliest_frames: Tensor
    """(C,), float64: the same, but with the most likely offset if undetermined"""
    determined: tuple[bool, ...]
    """whether the motion determines the offset of a camera; True for camera 0"""
    reasons: tuple[str, ...]
    """why a camera's offset is undetermined; empty if it is determined"""
    alternatives: tuple[Tensor, ...]
    """those of the time offsets above, (C,), at which most pairs of cameras fit together clearly better than at those given"""


def search_offsets(measurements: Measurements, max_offset_frames: float, noise_px: float = 2.0) -> ClockEstimate:
    """Find the time offsets of the cameras, to a fraction of a frame.

    Of a long session, only the part with most motion is used.

    Args:
        measurements: one session.
        max_offset_frames: largest time offset from camera 0, positive or negative.
        noise_px: approximate standard deviation of the keypoints.
    """
    max_offset = int(min(max_offset_frames + 1, measurements.frames - 1))
    pixels, weights = _image_tracks(measurements, max_offset, noise_px)
    tracks = Tracks(pixels, weights, min(2 * max_offset, pixels.shape[2] - 1))
    fits, scores, offsets = _search(tracks, max_offset, noise_px)
    of_all_keypoints = fits
    for _ in range(_ROUNDS - 1):
        tracks = Tracks(pixels, tracks.weights * _epipolar_inliers(tracks, offsets, noise_px), int(tracks.lags[-1]))
        fits, scores, offsets = _search(tracks, max_offset, noise_px)
    reasons = _reasons_for_doubt(fits, scores, offsets, max_offset)
    determined = tuple(not reason for reason in reasons)
    refined = _subframe_offsets(fits, offsets, determined)
    likeliest = refined.where(torch.tensor(determined), offsets.double())
    candidates = [likeliest, *([] if all(determined) else [refined])]
    alternatives = tuple(offsets for offsets in candidates if _fit_clearly_better(of_all_keypoints, offsets.round(), noise_px))
    return ClockEstimate(refined, likeliest, determined, reasons, alternatives)


def clocks_unlike_given(measurements: Measurements, max_offset_frames: float, noise_px: float = 2.0) -> ClockEstimate | None:
    """The time offsets where the cameras' frames clearly do not belong together as given; None where they do.

    Where no camera fits camera 0 better at another lag, it takes much less time than :func:`search_offsets`. The arguments are
    the same.
    """
    if not _doubtful(measurements, max_offset_frames, noise_px):
        return None
    found = search_offsets(measurements, max_offset_frames, noise_px)
    return found if found.alternatives else None


def _doubtful(measurements: Measurements, max_offset_frames: float, noise_px: float) -> bool:
    """Whether some camera fits camera 0 better at another lag than at lag 0."""
    max_offset = int(min(max_offset_frames + 1, measurements.frames - 1))
    pixels, weights = _image_tracks(measurements, max_offset, noise_px)
    tracks = Tracks(pixels, weights, min(max_offset, pixels.shape[2] - 1))
    near_zero, zero = tracks.lags.abs() <= 1, tracks.lags == 0
    for camera in range(1, len(weights)):
        fit = tracks.fit(0, camera)
        unexplained = _log_unexplained(fit, noise_px).nan_to_num(nan=torch.inf)
        others = unexplained[~near_zero & (fit.points > _COMMON_SHARE * fit.points[zero])]
        if len(others) and bool(others.min() < unexplained[near_zero].min() - _MIN_LOG_DIFFERENCE):
            return True
    return False


def _image_tracks(measurements: Measurements, max_offset: int, noise_px: float) -> tuple[Tensor, Tensor]:
    """Undistorted pixels (C, 2, F, P) and weights (C, F, P) of the part with most motion, without isolated outliers."""
    pixels, weights = _most_motion(*_undistorted(measurements), max(_MAX_FRAMES, 8 * max_offset))
    return pixels, weights * _is_consistent(pixels, weights, noise_px)


def _undistorted(measurements: Measurements) -> tuple[Tensor, Tensor]:
    """Undistorted pixels relative to the principal point, (C, 2, F, P), and whether they are seen, (C, F, P)."""
    rays = measurements.cameras[0].undistort(measurements.pixels[0].double().movedim(1, -1)).movedim(-1, 1)
    seen = measurements.visible[0] & rays.isfinite().all(1)
    pixels = rays.nan_to_num() * measurements.cameras.focal_px[0][:, None, None]
    return measurements.by_frame(pixels).cpu(), measurements.by_frame(seen.double()).cpu()


def _most_motion(pixels: Tensor, weights: Tensor, frames: int) -> tuple[Tensor, Tensor]:
    """The part of at most so many consecutive frames in which the keypoints move most."""
    if pixels.shape[2] <= frames:
        return pixels, weights
    speed = pixels.diff(dim=2).square().sum(1).sqrt() * weights[:, 1:] * weights[:, :-1]
    path_length = pad(speed.sum((0, 2)).cumsum(0), (1, 0))
    start = int((path_length[frames - 1 :] - path_length[: -(frames - 1)]).argmax())
    return pixels[:, :, start : start + frames], weights[:, start : start + frames]


def _is_consistent(pixels: Tensor, weights: Tensor, noise_px: float) -> Tensor:
    """Hampel filter: whether a keypoint is near the median of its neighbours in time, for its usual distance, (C, F, P)."""
    seen = pixels.where(weights[:, None] > 0, torch.nan)
    median = shifted_in_time(seen, [k for k in range(-_NEAR_FRAMES, _NEAR_FRAMES + 1) if k]).nanmedian(0).values
    distance = (seen - median).square().sum(1).sqrt()
    usual = shifted_in_time(distance, range(-_AROUND_FRAMES, _AROUND_FRAMES + 1)).nanmedian(0).values
    return distance <= _CUT * (usual + noise_px)


def _search(tracks: Tracks, max_offset: int, noise_px: float) -> tuple[Fits, Tensor, Tensor]:
    """Residuals of all pairs, scores at every lag (C, C, L), and the offsets (C,) with the best total score, in whole frames.

    The score of a pair at a lag is ``sqrt(n) (median(u) - u)``, with the number n of common points and u of
    :func:`_log_unexplained`. Its scatter at wrong lags is about the same for all pairs.
    """
    cameras = len(tracks.weights)
    fits = {pair: tracks.fit(*pair) for pair in combinations(range(cameras), 2)}
    scores = torch.zeros(cameras, cameras, len(tracks.lags), dtype=torch.float64)
    for (i, j), fit in fits.items():
        unexplained = _log_unexplained(fit, noise_px)
        scores[i, j] = (fit.points.sqrt() * (unexplained.nanmedian() - unexplained)).nan_to_num(nan=0.0)
        scores[j, i] = scores[i, j].flip(0)
    return fits, scores, _best_offsets(scores, max_offset)


def _log_unexplained(fit: EpipolarFit, noise_px: float) -> Tensor:
    """Logarithm of the share of the motion that epipolar lines do not explain, at every lag, (L,)."""
    return ((fit.residual_px2 + (noise_px / 4) ** 2) / (fit.motion_px2 + noise_px**2)).log()


def _root_common_points(fits: Fits, cameras: int) -> Tensor:
    """Square root of the number of common points of each pair at every lag, (C, C, L)."""
    first = next(iter(fits.values())).points
    roots = first.new_zeros(cameras, cameras, len(first))
    for (i, j), fit in fits.items():
        roots[i, j], roots[j, i] = fit.points.sqrt(), fit.points.flip(0).sqrt()
    return roots


def _best_offsets(scores: Tensor, max_offset: int) -> Tensor:
    """Offsets (C,) with the best total score, whole frames.

    The cameras are placed one by one, the one with the highest score first. Then each is moved to its best offset from all
    others, until none moves.
    """
    cameras, max_lag = range(len(scores)), scores.shape[-1] // 2
    offsets = torch.zeros(len(scores), dtype=torch.long)
    placed = [int(scores.amax((1, 2)).argmax())]
    while len(placed) < len(scores):
        totals = {c: _total_score(scores, offsets, c, placed, max_lag) for c in cameras if c not in placed}
        camera = max(totals, key=lambda camera: float(totals[camera].max()))
        offsets[camera] = totals[camera].argmax() - max_lag
        placed.append(camera)
    offsets = (offsets - offsets[0]).clamp(-max_offset, max_offset)
    for _ in range(_MAX_SWEEPS):
        before = offsets.clone()
        for camera in cameras[1:]:
            offsets[camera] = _total_score(scores, offsets, camera, cameras, max_offset).argmax() - max_offset
        if torch.equal(before, offsets):
            break
    return offsets


def _total_score(values: Tensor, offsets: Tensor, camera: int, others: Iterable[int], max_offset: int) -> Tensor:
    """Sum of the pairs' values (C, C, L) over other cameras, for each offset of a camera, (2 max_offset + 1,)."""
    max_lag = values.shape[-1] // 2
    candidates = torch.arange(-max_offset, max_offset + 1)
    total = torch.zeros(len(candidates), dtype=torch.float64)
    for other in others:
        lags = offsets[other] - candidates
        inside = lags.abs() <= max_lag
        total[inside] += values[other, camera, lags[inside] + max_lag]
    return total


def _epipolar_inliers(tracks: Tracks, offsets: Tensor, noise_px: float) -> Tensor:
    """Whether a keypoint fits another camera, within one frame of the offsets, (C, F, P). True if no other camera sees it."""
    compared, agrees = torch.zeros_like(tracks.weights, dtype=torch.bool), torch.zeros_like(tracks.weights, dtype=torch.bool)
    for i, j in combinations(range(len(offsets)), 2):
        best_lag = int(offsets[i] - offsets[j])
        for lag in range(best_lag - 1, best_lag + 2):
            at_lag = tracks.distances_px(i, j, lag)
            if at_lag is None:
                continue
            distances, of_first, of_second = at_lag
            common = distances.isfinite()
            close = distances <= _CUT * (distances[common].median() + noise_px)
            for camera, frames in ((i, of_first), (j, of_second)):
                compared[camera, frames] |= common
                agrees[camera, frames] |= close
    return agrees | ~compared


def _fit_clearly_better(fits: Fits, offsets: Tensor, noise_px: float) -> bool:
    """Whether most pairs of cameras whose frames meet others at some offsets (C,), whole frames, fit clearly better there."""
    decreases = []
    for (i, j), fit in fits.items():
        lag, zero = int(offsets[i] - offsets[j]), len(fit.points) // 2
        if lag and 0 <= zero + lag < len(fit.points):
            unexplained = _log_unexplained(fit, noise_px)
            decreases.append(float(unexplained[zero].nan_to_num(nan=torch.inf) - unexplained[zero + lag]))
    known = sorted(decrease for decrease in decreases if not math.isnan(decrease))
    return bool(known) and known[(len(known) - 1) // 2] > _CLEARLY_LESS


def _reasons_for_doubt(fits: Fits, scores: Tensor, offsets: Tensor, max_offset: int) -> tuple[str, ...]:
    """Why the offset of each camera is undetermined; empty if it is determined."""
    cameras, roots = range(len(offsets)), _root_common_points(fits, len(offsets))
    reasons = []
    for camera in cameras:
        score, points = (_total_score(values, offsets, camera, cameras, max_offset) for values in (scores, roots))
        best = int(offsets[camera]) + max_offset
        distance = (torch.arange(len(score)) - best).abs()
        rivals = score[distance > max(_MAX_PEAK_FRAMES, max_offset // 10)]
        width = int(distance.where(score >= _PEAK_SHARE * score[best], 0).max())
        if points[best] == 0:
            reasons.append("it has too few common points with the other cameras")
        elif score[best] < _MIN_SCORE * points[best]:
            reasons.append("there is too little motion to distinguish between offsets")
        elif bool((rivals > _RIVAL_SHARE * score[best]).any()):
            reasons.append("another offset fits the motion almost as well")
        elif width > _MAX_PEAK_FRAMES:
            reasons.append(f"the motion is too slow: all offsets within {width} frames fit almost as well")
        else:
            reasons.append("")
    if reasons[0]:
        of_others = f"because that of camera 0, the reference, is uncertain: {reasons[0]}"
        return ("", *[of_others] * (len(reasons) - 1))
    return tuple(f"because {reason}" if reason else "" for reason in reasons)


def _subframe_offsets(fits: Fits, offsets: Tensor, determined: tuple[bool, ...]) -> Tensor:
    """Offsets (C,) with fractions of a frame, by robust least squares on the lags of all pairs of determined cameras."""
    rows, lags, information = [], [], []
    for (i, j), fit in fits.items():
        minimum = _subframe_lag(fit, int(offsets[i] - offsets[j])) if determined[i] and determined[j] else None
        if minimum is not None:
            row = torch.zeros(len(offsets), dtype=torch.float64)
            row[i], row[j] = 1.0, -1.0
            rows.append(row)
            lags.append(minimum[0])
            information.append(minimum[1])
    refined = offsets.double().where(torch.tensor(determined), 0.0)
    if not rows:
        return refined
    design, target = torch.stack(rows)[:, 1:], torch.tensor(lags, dtype=torch.float64)
    weights = torch.tensor(information, dtype=torch.float64)
    whole = refined[1:]
    for _ in range(_MAX_SWEEPS):
        robust = weights / (1 + ((target - design @ refined[1:]) / _PAIR_SCALE_FRAMES).square())
        ridge = _RIDGE * weights.max() * torch.eye(len(whole), dtype=torch.float64)
        normal = design.mT @ (robust[:, None] * design) + ridge
        step = solve_information(normal, design.mT @ (robust * (target - design @ whole)))
        refined = torch.cat([refined[:1], whole + step])
    return refined


def _subframe_lag(fit: EpipolarFit, lag: int) -> tuple[float, float] | None:
    """The lag with the smallest residual near a whole lag, by a parabola, and its information. None if there is no minimum."""
    at = lag + len(fit.points) // 2
    if not 2 <= at < len(fit.points) - 2 or not bool(fit.residual_px2[at - 2 : at + 3].isfinite().all()):
        return None
    smallest = at - 1 + int(fit.residual_px2[at - 1 : at + 2].argmin())
    before, residual, after = fit.residual_px2[smallest - 1 : smallest + 2].tolist()
    curvature = before - 2 * residual + after
    if curvature <= 0:
        return None
    step = max(-1.0, min(1.0, (before - after) / (2 * curvature)))
    return lag + smallest - at + step, float(fit.points[smallest]) * curvature / (residual + 1.0)
