"""Frames in which a camera shows somebody else: all its keypoints contradict those of cameras that agree with one another."""

from __future__ import annotations

import itertools
import math

import torch
from torch import Tensor

from torchstickcal.pipeline.relabel.views import RayViews

_AGREEING_SIGMAS = 3.0
"""In deviations of a :class:`RayViews`."""
_ATHLETE_SHARE, _OTHER_SHARE = 0.5, 0.25
"""Share of the keypoints that agree with the points of others, from which on a camera shows the same person, or another."""
_CLEAR_RATIO = 0.8
_MIN_KEYPOINTS = 4
_BY_CHANCE = 1e-3
"""Chance, up to which that so few keypoints of the right person agree is ruled out."""


def other_persons(views: RayViews, right_share: Tensor) -> Tensor:
    """The cameras (C, n) that show another person than those that agree with one another, in each frame.

    Each pair of cameras proposes the points in which their rays meet, and the pair whose points most keypoints agree with is
    believed. Where a pair with a camera that disagrees is about as good, nothing is said, nor where so few keypoints agree by
    chance, because many of the camera's keypoints are wrong in any frame.

    Args:
        views: all points in n frames in which some camera contradicts the others as a whole.
        right_share: (C,), share of each camera's keypoints that are right in other frames.
    """
    seen = views.weights > 0
    count = seen.sum(-1)
    pairs = list(itertools.combinations(range(len(count)), 2))
    found = [_agreeing(views, seen, pair) for pair in pairs]
    agreeing, met, comparable = (torch.stack(of) for of in zip(*found, strict=True))  # (pairs, C, n)
    total = agreeing.sum(1)
    best = total.argmax(0).expand(1, *count.shape)
    share = agreeing.gather(0, best)[0] / count.clamp_min(1)
    athlete = (share >= _ATHLETE_SHARE) & (count >= _MIN_KEYPOINTS)
    compared = comparable.gather(0, best)[0]
    right = met.gather(0, best)[0]
    other = (right <= _OTHER_SHARE * compared) & (compared >= _MIN_KEYPOINTS) & (athlete.sum(0) >= 2)
    other &= _chance_of_few(right, compared, right_share[:, None]) < _BY_CHANCE
    with_camera = torch.tensor([[camera in pair for pair in pairs] for camera in range(len(count))], device=total.device)
    rival = torch.where(with_camera[..., None], total, 0).amax(1)  # (C, n)
    return other & (rival < _CLEAR_RATIO * total.amax(0))


def _chance_of_few(right: Tensor, compared: Tensor, share: Tensor) -> Tensor:
    """Chance that at most so many of some keypoints are right, if each is with a probability: the binomial distribution."""
    count, total = compared.double(), torch.zeros_like(compared, dtype=torch.float64)
    for number in range(int(right.max()) + 1):
        ways = (count + 1).lgamma() - (count - number + 1).clamp_min(1).lgamma() - math.lgamma(number + 1)
        chance = (ways + number * share.log() + (count - number) * (1 - share).log()).exp()
        total += chance.where((number <= right) & (number <= compared), 0.0)
    return total


def _agreeing(views: RayViews, seen: Tensor, pair: tuple[int, int]) -> tuple[Tensor, Tensor, Tensor]:
    """How many keypoints of each camera (C, n) agree with the points of a pair; the same of the points in which the rays of the
    pair meet; and how many keypoints there are of these. Where the rays do not meet, one of them is wrong, not a third camera.
    """
    agree = (views.squared_distances(views.points(list(pair))) < _AGREEING_SIGMAS**2) & seen
    meet = agree[list(pair)].all(0)
    return agree.sum(-1), (agree & meet).sum(-1), (seen & meet).sum(-1)
