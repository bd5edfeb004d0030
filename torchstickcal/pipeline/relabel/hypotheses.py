"""In which cameras and frames an exchange of points took place: decided by the other views, and by time."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from torchstickcal.pipeline.relabel.views import RayViews

_SUBSET = 4
"""Cameras of which every combination of labels is tried."""
_MOST_LABELLINGS = 8
_RARITY = 2.0
"""What an exchange in one camera and frame must bring, since it is rarer than none."""
_MOST_KEYPOINTS = 4_000_000
_LEAST_AGREEING, _AGREEING_SHARE = 3, 2 / 3
"""Keypoints of a point, and share of those seen, that must agree with it for the labels of a frame to be beyond doubt."""
_MOTION_WEIGHT = 1.5
_MOTION_LENIENCE = 1.5


def exchanged_where(views: RayViews, pixels: Tensor, frames: Tensor, margin: float) -> Tensor:
    """In which cameras and frames the points of some pairs are exchanged.

    For each frame the likeliest labellings of the cameras are collected: of those in which the rays meet best. Between them and
    their mirror images, in which all other cameras are exchanged, decides the path through all frames (Viterbi's algorithm)
    along which the keypoints move least in the images, with the fewest exchanges. What has no clear margin is left as given.

    Args:
        views: the points of the pairs, those of the first sides first, in n frames in which something is suspicious.
        pixels: the same points in all F frames, (C, 2, F, 2 k), NaN where not seen.
        frames: the numbers of the n frames, (n,).
        margin: least evidence of what is exchanged, the logarithm of a ratio of likelihoods.

    Returns:
        (C, F)
    """
    cameras, points = views.weights.shape[0], views.weights.shape[2]
    partner = torch.arange(points, device=pixels.device).roll(points // 2)
    doubtful = torch.cat([_doubtful(views.at_frames(part), partner) for part in _parts(views)])
    if not doubtful.any():
        return pixels.new_zeros(cameras, pixels.shape[2]).bool()
    frames, views = frames[doubtful], views.at_frames(doubtful)
    found = [_labellings(views.at_frames(part), partner) for part in _parts(views)]
    labellings = pixels.new_zeros(len(found[0][0]), cameras, pixels.shape[2]).bool()
    within = pixels.new_zeros(len(labellings), pixels.shape[2])
    labellings[..., frames], within[..., frames] = (torch.cat(parts, dim=-1) for parts in zip(*found, strict=True))
    labellings = torch.cat([labellings, ~labellings])
    motion = _motion_evidence(pixels, partner)
    chosen = _path(labellings, within.repeat(2, 1) - _RARITY * labellings.sum(1), motion)
    return _with_margin(chosen, views, partner, frames, motion, margin)


def _doubtful(views: RayViews, partner: Tensor) -> Tensor:
    """Whether the given labels of a frame may be wrong, (n,).

    They are right where the rays of most cameras meet in each of the points, and no camera agrees better with these points if
    its keypoints are exchanged.
    """
    points, everywhere = views.points(), torch.ones_like(views.weights[..., 0], dtype=torch.bool)
    given, other = (v.evidence(points) for v in (views, views.exchanged(everywhere, partner)))
    agreeing, seen = (given > 0).sum(0), (views.weights > 0).sum(0)
    supported = (agreeing >= _LEAST_AGREEING) & (agreeing > _AGREEING_SHARE * seen)
    return (other.sum(-1) > given.sum(-1)).any(0) | ~(supported | (seen < 2)).all(-1)


def _labellings(views: RayViews, partner: Tensor) -> tuple[Tensor, Tensor]:
    """The likeliest labellings of the cameras in each frame, (K, C, n), True where exchanged, and their evidence, (K, n).

    Of a few cameras all combinations are tried. The other cameras then follow from the points in which these meet.
    """
    count, frames = views.weights.shape[:2]
    everywhere = torch.ones(count, frames, dtype=torch.bool, device=partner.device)
    subsets = [[(first + step * count // _SUBSET) % count for step in range(_SUBSET)] for first in range(count)]
    if count <= _SUBSET:
        subsets = [list(range(count))]
    size = len(subsets[0])
    combinations = torch.tensor([(False, *rest) for rest in itertools.product((False, True), repeat=size - 1)])
    combinations = combinations.to(partner.device)[..., None].expand(-1, -1, frames)
    labels, totals = [torch.zeros_like(everywhere)[None]], [views.total_evidence()[None]]
    for subset in subsets:
        tried = everywhere.logical_not().repeat(len(combinations), 1, 1)
        tried[:, subset] = combinations
        if count <= _SUBSET:
            labels, totals = [*labels, tried], [*totals, views.exchanged(tried, partner).total_evidence()]
            continue
        points = views.exchanged(tried, partner).points(subset)
        given, other = (v.evidence(points).sum(-1) for v in (views, views.exchanged(everywhere, partner)))
        labels.append((other > given).movedim(0, 1))
        totals.append(torch.maximum(given, other).sum(0))
    every, total = torch.cat(labels), torch.cat(totals)
    best = total.topk(min(_MOST_LABELLINGS, len(total)), dim=0).indices
    found = every.gather(0, best[:, None].expand(-1, count, -1))
    if count > _SUBSET:
        found = torch.cat([labels[0], found])
        return found, views.exchanged(found, partner).total_evidence()
    return found, total.gather(0, best)


def _motion_evidence(pixels: Tensor, partner: Tensor) -> Tensor:
    """How much the images speak against an exchange between one frame and the next, (C, F - 1): points move little."""
    before, after = pixels[..., :-1, :], pixels[..., 1:, :]
    same, other = ((before - later).square().sum(1) for later in (after, after[..., partner]))
    scale = torch.fmin(same, other).flatten(0, 1).nanmedian(0).values.clamp_min(1.0) * _MOTION_LENIENCE**2
    same, other = (1 / (1 + squared.nan_to_num(nan=torch.inf) / scale) for squared in (same, other))
    return _MOTION_WEIGHT * (same - other).nan_to_num().sum(-1)


def _path(labellings: Tensor, within: Tensor, motion: Tensor) -> Tensor:
    """The likeliest labelling (C, F) of all frames.

    Args:
        labellings: (K, C, F), True where exchanged.
        within: (K, F), how well the views of a frame agree with each.
        motion: (C, F - 1), evidence against an exchange between frames.
    """
    signs = np.where(labellings.cpu().numpy(), -0.5, 0.5)
    links, score = 2 * motion.cpu().numpy(), within.cpu().numpy()
    frames = score.shape[1]
    best, origins = score[:, 0], np.zeros((frames, len(score)), dtype=np.int64)
    for frame in range(1, frames):
        through = best[:, None] + (signs[:, :, frame - 1] * links[:, frame - 1]) @ signs[:, :, frame].T
        origins[frame] = through.argmax(0)
        best = through.max(0) + score[:, frame]
    states = np.zeros(frames, dtype=np.int64)
    states[-1] = best.argmax()
    for frame in range(frames - 1, 0, -1):
        states[frame - 1] = origins[frame, states[frame]]
    chosen = torch.from_numpy(states).to(labellings.device)
    return labellings.gather(0, chosen.expand(1, *labellings.shape[1:]))[0]


def _with_margin(chosen: Tensor, views: RayViews, partner: Tensor, frames: Tensor, motion: Tensor, margin: float) -> Tensor:
    """The exchanges (C, F) of which the evidence is clear.

    In a suspicious frame each camera's own exchange must be, and its keypoints must then agree with the others. In the other
    frames, of which the views agree as they are, all cameras are exchanged, and the motion of all must be against its being so
    in the frames before and after.
    """
    signs = torch.where(chosen, -1.0, 1.0).to(motion)
    agreement = motion * signs[:, :-1] * signs[:, 1:]
    moving = torch.nn.functional.pad(agreement, (1, 0)) + torch.nn.functional.pad(agreement, (0, 1))
    clear = chosen & (moving.sum(0) - _RARITY * len(chosen) > margin)
    labels = chosen[:, frames]
    own = torch.eye(len(labels), dtype=torch.bool, device=labels.device)[..., None]
    alternatives = torch.cat([labels[None], labels ^ own, torch.zeros_like(labels)[None]])
    evidence = torch.cat(
        [views.at_frames(part).exchanged(alternatives[..., part], partner).total_evidence() for part in _parts(views)], dim=-1
    )
    contribution = torch.cat(
        [_contributions(views.at_frames(part).exchanged(labels[:, part], partner)) for part in _parts(views)], dim=-1
    )
    whole = evidence[0] - evidence[-1] + moving[:, frames].sum(0) > margin
    each = evidence[0] - evidence[1:-1] + moving[:, frames] > margin
    clear[:, frames] = labels & each & whole & (contribution > 0)
    return clear


def _contributions(views: RayViews) -> Tensor:
    """What the keypoints of each camera add to the evidence of all, (C, n)."""
    others = ~torch.eye(len(views.weights), dtype=torch.bool, device=views.weights.device)[..., None, None]
    cameras = (slice(None), slice(None), None)
    rays, weights = views.rays[cameras].expand(-1, -1, len(others), -1, -1), views.weights[:, None] * others
    return views.total_evidence() - replace(views, rays=rays, weights=weights).total_evidence()


def _parts(views: RayViews) -> list[slice]:
    """The frames, a few at a time, of which all hypotheses fit into little memory."""
    cameras, frames, points = views.weights.shape
    hypotheses = cameras * 2 ** (_SUBSET - 1)
    step = max(1, _MOST_KEYPOINTS // (cameras * points * hypotheses))
    return [slice(first, min(first + step, frames)) for first in range(0, frames, step)]
