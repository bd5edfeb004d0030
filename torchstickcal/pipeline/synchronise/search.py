"""When each camera's clock is off by more than a fine adjustment can mend: offsets from the motion itself.

Pairs of cameras are compared at every lag between their frames; the offsets are those at which all pairs together agree best,
and a parabola through each pair's agreement gives the fraction of a frame. Neither a common start nor extrinsics are needed,
and of the intrinsics the distortion alone: the geometry is that of fundamental matrices.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import combinations

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchstickcal.model.measurements import Measurements
from torchstickcal.model.trajectories import around
from torchstickcal.pipeline.synchronise.epipolar import Agreement, Tracks

_ROUNDS = 3
_MAX_SWEEPS = 10
_MAX_FRAMES = 2000
_CUT = 3.0
_NEAR_FRAMES, _AROUND_FRAMES = 2, 5
_LEAST_GAIN = 0.5
_RIVAL_SHARE = 0.75
_PEAK_SHARE, _WIDEST_PEAK_FRAMES = 0.95, 4
_PAIR_SCALE_FRAMES = 0.5
_STIFFNESS = 1e-9
_COMMON_SHARE = 0.25
_CLEARLY = 0.3
"""Difference in :func:`_unexplained`: cameras in step stay below 0.05, whole frames apart they are above 1."""

Pairs = dict[tuple[int, int], Agreement]


@dataclass(frozen=True)
class ClockEstimate:
    """When the cameras' frames were exposed, relative to camera 0."""

    offsets_frames: Tensor
    """(C,), float64: camera c's frame f shows what camera 0 shows at its frame ``f + offsets_frames[c]``; 0 where not known"""
    likeliest_frames: Tensor
    """(C,), float64: the same, with the likeliest where not known"""
    determined: tuple[bool, ...]
    """whether the motion tells a camera's offset; True for camera 0"""
    reasons: tuple[str, ...]
    """why not, for cameras that are not determined, else empty"""


def search_offsets(measurements: Measurements, max_offset_frames: float, noise_px: float = 2.0) -> ClockEstimate:
    """Find the cameras' offsets, to a fraction of a frame.

    Of a long session the stretch with most motion is looked at.

    Args:
        measurements: one session.
        max_offset_frames: largest offset of a camera from camera 0, late or early.
        noise_px: standard deviation of keypoints, roughly.
    """
    reach = min(int(max_offset_frames) + 1, measurements.frames - 1)
    places, weights = _tracked(measurements, reach, noise_px)
    tracks = Tracks(places, weights, min(2 * reach, places.shape[2] - 1))
    pairs, gains, offsets = _joint_offsets(tracks, reach, noise_px)
    for _ in range(_ROUNDS - 1):
        tracks = Tracks(places, tracks.weights * _in_agreement(tracks, offsets, noise_px), int(tracks.lags[-1]))
        pairs, gains, offsets = _joint_offsets(tracks, reach, noise_px)
    reasons = _doubts(pairs, gains, offsets, reach)
    determined = tuple(not reason for reason in reasons)
    refined = _refined(pairs, offsets, determined)
    return ClockEstimate(refined, refined.where(torch.tensor(determined), offsets.double()), determined, reasons)


def unsynchronised(measurements: Measurements, max_offset_frames: float, noise_px: float = 2.0) -> bool:
    """Whether some camera agrees with the first one clearly better at other frames than at those beside each other.

    Much quicker than the search; arguments as of :func:`search_offsets`.
    """
    reach = min(int(max_offset_frames) + 1, measurements.frames - 1)
    places, weights = _tracked(measurements, reach, noise_px)
    tracks = Tracks(places, weights, min(reach, places.shape[2] - 1))
    near, beside = tracks.lags.abs() <= 1, tracks.lags == 0
    for camera in range(1, len(weights)):
        pair = tracks.agreement(0, camera)
        unexplained = _unexplained(pair, noise_px).nan_to_num(nan=torch.inf)
        elsewhere = unexplained[~near & (pair.points > _COMMON_SHARE * pair.points[beside])]
        if len(elsewhere) and bool(elsewhere.min() < unexplained[near].min() - _CLEARLY):
            return True
    return False


def _tracked(measurements: Measurements, reach: int, noise_px: float) -> tuple[Tensor, Tensor]:
    """Undistorted pixels (C, 2, F, P) of the stretch with most motion, and their weights (C, F, P)."""
    places, weights = _most_motion(*_undistorted(measurements), max(_MAX_FRAMES, 8 * reach))
    return places, weights * _steady(places, weights, noise_px)


def _undistorted(measurements: Measurements) -> tuple[Tensor, Tensor]:
    """Undistorted pixels about the principal point, (C, 2, F, P), and whether they are seen, (C, F, P)."""
    rays = measurements.cameras[0].undistort(measurements.pixels[0].double().movedim(1, -1)).movedim(-1, 1)
    seen = measurements.visible[0] & rays.isfinite().all(1)
    places = rays.nan_to_num() * measurements.cameras.focal_px[0][:, None, None]
    return measurements.by_frame(places).cpu(), measurements.by_frame(seen.double()).cpu()


def _most_motion(places: Tensor, weights: Tensor, frames: int) -> tuple[Tensor, Tensor]:
    """The stretch of at most so many frames in which the points move most."""
    if places.shape[2] <= frames:
        return places, weights
    speed = places.diff(dim=2).square().sum(1).sqrt() * weights[:, 1:] * weights[:, :-1]
    gone = pad(speed.sum((0, 2)).cumsum(0), (1, 0))
    start = int((gone[frames - 1 :] - gone[: -(frames - 1)]).argmax())
    return places[:, :, start : start + frames], weights[:, start : start + frames]


def _steady(places: Tensor, weights: Tensor, noise_px: float) -> Tensor:
    """Whether a keypoint is near the median of its neighbours in time, for its pace (Hampel's filter), (C, F, P)."""
    seen = places.where(weights[:, None] > 0, torch.nan)
    near = around(seen, [k for k in range(-_NEAR_FRAMES, _NEAR_FRAMES + 1) if k]).nanmedian(0).values
    away = (seen - near).square().sum(1).sqrt()
    usual = around(away, range(-_AROUND_FRAMES, _AROUND_FRAMES + 1)).nanmedian(0).values
    return away <= _CUT * (usual + noise_px)


def _joint_offsets(tracks: Tracks, reach: int, noise_px: float) -> tuple[Pairs, Tensor, Tensor]:
    """Agreement of all pairs, what each gains at every lag (C, C, L), and the whole offsets (C,) at which all gain most.

    A pair's gain is the logarithm of how little of the motion epipolar lines leave unexplained, over that at the median lag,
    times the square root of the number of common points: as sure as it is large against its scatter at wrong lags.
    """
    cameras = len(tracks.weights)
    pairs = {pair: tracks.agreement(*pair) for pair in combinations(range(cameras), 2)}
    gains = torch.zeros(cameras, cameras, len(tracks.lags), dtype=torch.float64)
    for (i, j), pair in pairs.items():
        unexplained = _unexplained(pair, noise_px)
        gains[i, j] = (pair.points.sqrt() * (unexplained.nanmedian() - unexplained)).nan_to_num(nan=0.0)
        gains[j, i] = gains[i, j].flip(0)
    return pairs, gains, _joined(gains, reach)


def _unexplained(pair: Agreement, noise_px: float) -> Tensor:
    """Logarithm of the share of the motion that epipolar lines leave unexplained at every lag, (L,)."""
    return ((pair.residual_px2 + (noise_px / 4) ** 2) / (pair.motion_px2 + noise_px**2)).log()


def _common_points(pairs: Pairs, cameras: int) -> Tensor:
    """Square root of the number of points two cameras have in common at every lag, (C, C, L)."""
    first = next(iter(pairs.values())).points
    counts = first.new_zeros(cameras, cameras, len(first))
    for (i, j), pair in pairs.items():
        counts[i, j], counts[j, i] = pair.points.sqrt(), pair.points.flip(0).sqrt()
    return counts


def _joined(gains: Tensor, reach: int) -> Tensor:
    """Cameras joined one by one, the surest first, then each adjusted to all others until none moves."""
    everyone, longest = range(len(gains)), gains.shape[-1] // 2
    offsets = torch.zeros(len(gains), dtype=torch.long)
    placed = [int(gains.amax((1, 2)).argmax())]
    while len(placed) < len(gains):
        curves = {camera: _support(gains, offsets, camera, placed, longest) for camera in everyone if camera not in placed}
        camera = max(curves, key=lambda camera: float(curves[camera].max()))
        offsets[camera] = curves[camera].argmax() - longest
        placed.append(camera)
    offsets = (offsets - offsets[0]).clamp(-reach, reach)
    for _ in range(_MAX_SWEEPS):
        before = offsets.clone()
        for camera in everyone[1:]:
            offsets[camera] = _support(gains, offsets, camera, everyone, reach).argmax() - reach
        if torch.equal(before, offsets):
            break
    return offsets


def _support(gains: Tensor, offsets: Tensor, camera: int, others: Iterable[int], reach: int) -> Tensor:
    """What other cameras gain from each offset of a camera up to ``reach``, (2 reach + 1,)."""
    longest = gains.shape[-1] // 2
    candidates = torch.arange(-reach, reach + 1)
    support = torch.zeros(len(candidates), dtype=torch.float64)
    for other in others:
        lags = offsets[other] - candidates
        inside = lags.abs() <= longest
        support[inside] += gains[other, camera, lags[inside] + longest]
    return support


def _in_agreement(tracks: Tracks, offsets: Tensor, noise_px: float) -> Tensor:
    """Whether some camera agrees with a keypoint, within a frame of the offsets, (C, F, P); True where no other sees it."""
    seen, agreed = torch.zeros_like(tracks.weights, dtype=torch.bool), torch.zeros_like(tracks.weights, dtype=torch.bool)
    for i, j in combinations(range(len(offsets)), 2):
        lag = int(offsets[i] - offsets[j])
        for near in range(lag - 1, lag + 2):
            found = tracks.distances_px(i, j, near)
            if found is None:
                continue
            distances, of_first, of_second = found
            common = distances.isfinite()
            close = distances <= _CUT * (distances[common].median() + noise_px)
            for camera, frames in ((i, of_first), (j, of_second)):
                seen[camera, frames] |= common
                agreed[camera, frames] |= close
    return agreed | ~seen


def _doubts(pairs: Pairs, gains: Tensor, offsets: Tensor, reach: int) -> tuple[str, ...]:
    """Why a camera's offset is not determined, each; empty where it is."""
    everyone, counts = range(len(offsets)), _common_points(pairs, len(offsets))
    doubts = []
    for camera in everyone:
        support, points = (_support(values, offsets, camera, everyone, reach) for values in (gains, counts))
        best = int(offsets[camera]) + reach
        away = (torch.arange(len(support)) - best).abs()
        rivals = support[away > max(_WIDEST_PEAK_FRAMES, reach // 10)]
        width = int(away[support >= _PEAK_SHARE * support[best]].max())
        if points[best] == 0:
            doubts.append("too few points in common with other cameras")
        elif support[best] < _LEAST_GAIN * points[best]:
            doubts.append("too little motion to tell one offset from another")
        elif bool((rivals > _RIVAL_SHARE * support[best]).any()):
            doubts.append("the motion fits another offset nearly as well")
        elif width > _WIDEST_PEAK_FRAMES:
            doubts.append(f"the motion is too slow: it fits any offset within {width} frames")
        else:
            doubts.append("")
    if doubts[0]:
        return ("", *[f"camera 0, the reference: {doubts[0]}"] * (len(doubts) - 1))
    return tuple(doubts)


def _refined(pairs: Pairs, offsets: Tensor, determined: tuple[bool, ...]) -> Tensor:
    """Offsets by robust least squares on the fractional lags of all pairs of determined cameras."""
    rows, lags, information = [], [], []
    for (i, j), pair in pairs.items():
        near = _fraction(pair, int(offsets[i] - offsets[j])) if determined[i] and determined[j] else None
        if near is not None:
            row = torch.zeros(len(offsets), dtype=torch.float64)
            row[i], row[j] = 1.0, -1.0
            rows.append(row)
            lags.append(near[0])
            information.append(near[1])
    found = offsets.double().where(torch.tensor(determined), 0.0)
    if not rows:
        return found
    design, target = torch.stack(rows)[:, 1:], torch.tensor(lags, dtype=torch.float64)
    weights = torch.tensor(information, dtype=torch.float64)
    whole = found[1:]
    for _ in range(_MAX_SWEEPS):
        robust = weights / (1 + ((target - design @ found[1:]) / _PAIR_SCALE_FRAMES).square())
        stiff = _STIFFNESS * weights.max() * torch.eye(len(whole), dtype=torch.float64)
        normal = design.mT @ (robust[:, None] * design) + stiff
        step = torch.linalg.solve(normal, design.mT @ (robust * (target - design @ whole)))
        found = torch.cat([found[:1], whole + step])
    return found


def _fraction(pair: Agreement, lag: int) -> tuple[float, float] | None:
    """Lag of the least residual within about a frame of a whole one, by a parabola, and its information; None without one."""
    at = lag + len(pair.points) // 2
    if not 2 <= at < len(pair.points) - 2 or not bool(pair.residual_px2[at - 2 : at + 3].isfinite().all()):
        return None
    least = at - 1 + int(pair.residual_px2[at - 1 : at + 2].argmin())
    before, residual, after = pair.residual_px2[least - 1 : least + 2].tolist()
    curvature = before - 2 * residual + after
    if curvature <= 0:
        return None
    step = max(-1.0, min(1.0, (before - after) / (2 * curvature)))
    return lag + least - at + step, float(pair.points[least]) * curvature / (residual + 1.0)
