"""Where no focal length is given: of a range of focal lengths, the one with which the views agree best."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from torchstickcal.errors import RigError
from torchstickcal.geometry.cameras import Intrinsics
from torchstickcal.model.measurements import Measurements
from torchstickcal.model.state import State
from torchstickcal.model.unknowns import RigUnknowns
from torchstickcal.pipeline.initialise import initialise
from torchstickcal.pipeline.run import Run
from torchstickcal.pipeline.stage import run_stage

_RATIOS = (0.45, 0.55, 0.67, 0.82, 1.0, 1.22, 1.5, 1.83, 2.2)
"""Focal lengths tried, over the guessed ones."""


def search_focal(measurements: Measurements, labels: Sequence[str], run: Run) -> tuple[Measurements, State]:
    """Cameras near their focal lengths, and a first estimate of rig and points.

    From each of the ratios the first stage adjusts rig, points and a focal length common to each camera group; the median
    residual decides.

    Args:
        measurements: one session, with guessed cameras.
        labels: the cameras' names, for messages.
        run: what all steps share; nobody listens to the trials.

    Raises:
        RigError: if no focal length lets the cameras be placed in one rig.
    """
    config, quiet = run.config, Run(run.config)
    name, stage = next(iter(config.stages.items()))
    best = torch.inf
    found: tuple[Measurements, State] | None = None
    failure: RigError | None = None
    for ratio in _RATIOS:
        trial = replace(measurements, cameras=_scaled(measurements.cameras, ratio))
        trial = replace(trial, unknowns=RigUnknowns.of(("focal_shared",), trial.cameras, config.camera_groups))
        try:
            start = initialise(trial, config.initialise, labels)
        except RigError as error:
            failure = error
            continue
        start = replace(start, unknowns=trial.unknowns.given)
        state = run_stage(name, stage, trial, start, quiet).state
        residual = _median_residual(trial, state)
        if residual < best:
            best = residual
            cameras = trial.cameras_at(state).to(torch.float64)
            found = replace(measurements, cameras=cameras), state
    if found is None:
        assert failure is not None
        raise failure
    return found


def _scaled(cameras: Intrinsics, ratio: float) -> Intrinsics:
    factor = torch.ones_like(cameras.matrix)
    factor[..., :2, :2] = ratio
    return replace(cameras, matrix=cameras.matrix * factor)


def _median_residual(measurements: Measurements, state: State) -> float:
    squared: Tensor = measurements.squared_residuals(state)
    return float(squared[measurements.visible].median())
