"""Parts of one session's keypoints: what each contributes to the reduced system of the cameras, worked out side by side."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchstickcal.model.measurements import Measurements
from torchstickcal.model.objective import Objective
from torchstickcal.model.state import State
from torchstickcal.solvers.elimination.normal_equations import NormalEquations


class Fold(NamedTuple):
    """A part of the keypoints: its share of the system of poses and all unknowns, without the prior."""

    information: Tensor
    """(K, K)"""
    gradient: Tensor
    """(K,)"""


def folds_of_frames(objective: Objective, state: State, windows: Sequence[slice]) -> list[Fold]:
    """The folds of frames that follow one another.

    Args:
        objective: of one session. What it says of frames of two folds together is no part of either.
        state: where it is linearised.
        windows: the frames of each fold; none is empty.
    """
    m, longest = objective.measurements, max(window.stop - window.start for window in windows)
    frame = torch.arange(m.frames, device=m.pixels.device).repeat_interleave(m.points_per_frame)
    parts: list[Measurements] = []
    points: list[Tensor] = []
    for window in windows:  # with frames around it that do not count, as long as the longest
        first = min(window.start, m.frames - longest)
        around = slice(first, first + longest)
        columns = m.columns_of(around)
        part = m.within(around)
        own = (frame[columns] >= window.start) & (frame[columns] < window.stop)
        parts.append(part if window == around else part.keeping(own))
        points.append(state.points[..., columns])
    return _folds(objective, state, parts, torch.cat(points))


def folds_of_points(objective: Objective, state: State, groups: Sequence[Tensor]) -> list[Fold]:
    """The folds of groups of columns (N,), True where a column is one of the group. No loss couples two groups."""
    parts = [objective.measurements.keeping(group) for group in groups]
    return _folds(objective, state, parts, state.points.expand(len(groups), -1, -1)) if parts else []


def _folds(objective: Objective, state: State, parts: Sequence[Measurements], points: Tensor) -> list[Fold]:
    """The folds of parts of the measurements and their points (n, 3, columns), as sessions side by side."""
    count = len(parts)
    alike = State(
        state.rotations.expand(count, -1, -1, -1),
        state.translations.expand(count, -1, -1),
        points,
        state.unknowns.expand(count, -1),
    )
    system = NormalEquations(Objective(Measurements.stack(parts), objective.losses), alike, cameras_free=True)
    _, prior_gradient, prior = objective.linearise_prior(state)
    information, gradient = system.reduced.clone(), system.reduced_gradient.clone()
    poses = gradient.shape[1] - prior.shape[1]
    information.diagonal(dim1=1, dim2=2)[:, poses:] -= prior
    gradient[:, poses:] -= prior_gradient
    return list(map(Fold, information, gradient))
