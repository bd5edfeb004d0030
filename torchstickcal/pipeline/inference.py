"""Which sessions are calibrated and judged in torch's inference mode, where operations skip what gradients would need."""

from __future__ import annotations

from collections.abc import Iterable

import torch

from torchstickcal.config import Config
from torchstickcal.model.unknowns import all_unknowns
from torchstickcal.observations import Observations

_MOST_KEYPOINTS = 100_000
"""Larger sessions gain nothing, and their results would need memory twice when they are made ordinary."""


def inference_of(observations: Observations, config: Config, others: Iterable[object] = ()) -> torch.inference_mode:
    """Inference mode for one session, or ordinary mode where something may need gradients that it does not ask for itself.

    That is the solver by gradients, and whatever others have registered, for nobody knows what it does.

    Args:
        observations: the session.
        config: how it is calibrated.
        others: functions or classes that take part, beside losses and unknowns.
    """
    losses = (type(settings) for stage in config.stages.values() for settings in stage.losses.values())
    every = (*losses, *map(type, all_unknowns().values()), *others)
    return torch.inference_mode(
        mode=observations.keypoints.numel() // 2 <= _MOST_KEYPOINTS
        and config.solver == "gauss_newton"
        and all(part.__module__.startswith("torchstickcal.") for part in every)
    )
