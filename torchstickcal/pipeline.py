"""The calibration, from keypoints to cameras in metres, as one story."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

import torch

from torchstickcal.assemble import assemble
from torchstickcal.config import Config, load_config
from torchstickcal.initialise import initialise
from torchstickcal.observations import Observations
from torchstickcal.problem import Measurements
from torchstickcal.result import Calibration
from torchstickcal.solvers import IterationRecord
from torchstickcal.stages import StageRecord, StageResult, rulers, run_stage


class Callback(Protocol):
    """What may listen to a calibration: a progress bar, TensorBoard, a test."""

    def on_iteration(self, record: IterationRecord) -> None:
        """After each iteration."""
        ...

    def on_end(self, calibration: Calibration) -> None:
        """Once, with the result."""
        ...


def calibrate(
    observations: Observations,
    config: str | Path | Mapping[str, Any] | Config = "default",
    callback: Callback | None = None,
) -> Calibration:
    """Find the extrinsics of all cameras and the 3D points, in metres, in the frame of the first camera.

    Args:
        observations: keypoints, intrinsics and sticks.
        config: a configuration's name, a TOML file, a mapping of its keys, or a :class:`Config`.
        callback: listens to the iterations and the result.

    Returns:
        The calibration. Its ``status`` says whether every stage converged; a stage that did not leaves the best state it
        reached.

    Raises:
        ConfigError: for an unusable configuration.
        RigError: if the cameras cannot be placed in one rig.
    """
    began = time.perf_counter()
    settings = load_config(config)
    known = rulers([observations], settings)
    precision = torch.float32 if settings.precision == "float32" else torch.float64
    measurements = Measurements.of(observations, points_used(observations, settings), precision)
    labels = [observations.camera_label(index) for index in range(observations.num_cameras)]

    state = initialise(measurements, settings.initialise, labels)
    seconds = {"initialise": time.perf_counter() - began}

    reached: StageResult | None = None
    records: list[StageRecord] = []
    listener = callback.on_iteration if callback else _ignore
    for name, stage in settings.stages.items():
        reached = run_stage(name, stage, measurements, state, known, settings.solver, listener)
        state = reached.state
        records += reached.records
        seconds[name] = records[-1].seconds
    assert reached is not None
    seconds["total"] = time.perf_counter() - began

    calibration = assemble(observations, measurements, reached, records, seconds)
    if callback:
        callback.on_end(calibration)
    return calibration


def points_used(observations: Observations, config: Config) -> list[int] | None:
    """The points that take part; None for all."""
    ends = {end for stick in observations.sticks for end in (stick.start, stick.end)}
    if config.points == "sticks":
        return sorted(ends)
    if config.points == "joints":
        return [point for point in range(observations.num_points) if point not in ends]
    return None


def _ignore(record: IterationRecord) -> None:
    return
