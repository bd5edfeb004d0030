"""The calibration, from keypoints to cameras in metres, as one story."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import Tensor

from torchstickcal.assemble import assemble
from torchstickcal.config import Config, StickLengthSettings, load_config
from torchstickcal.initialise import initialise
from torchstickcal.observations import Observations
from torchstickcal.problem import Measurements
from torchstickcal.result import Calibration
from torchstickcal.solvers import IterationRecord
from torchstickcal.stages import StageRecord, StageResult, rulers, run_stage
from torchstickcal.uncertainty import camera_covariance
from torchstickcal.workers import on_worker


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
    settings = load_config(config)
    return on_worker(observations.keypoints.device, _calibrated, observations, settings, callback)


def points_used(observations: Observations, config: Config) -> list[int] | None:
    """The points that take part; None for all."""
    ends = {end for stick in observations.sticks for end in (stick.start, stick.end)}
    if config.points == "sticks":
        return sorted(ends)
    if config.points == "joints":
        return [point for point in range(observations.num_points) if point not in ends]
    return None


def _calibrated(observations: Observations, settings: Config, callback: Callback | None) -> Calibration:
    began = time.perf_counter()
    known = rulers([observations], settings)
    precision = torch.float32 if settings.precision == "float32" else torch.float64
    measurements = Measurements.of(observations, points_used(observations, settings), precision)
    labels = [observations.camera_label(index) for index in range(observations.num_cameras)]

    state = initialise(measurements, settings.initialise, labels)
    seconds = {"initialise": time.perf_counter() - began}

    reached = adjusted = None
    records: list[StageRecord] = []
    listener = callback.on_iteration if callback else _ignore
    for name, stage in settings.stages.items():
        reached = run_stage(name, stage, measurements, state, known, settings.solver, listener)
        state = reached.state
        adjusted = reached if stage.cameras == "free" else adjusted
        records += reached.records
        seconds[name] = records[-1].seconds
    assert reached is not None
    covariance = adjusted and _covariance(measurements, adjusted, reached.sigma_px)
    seconds["total"] = time.perf_counter() - began

    calibration = assemble(observations, measurements, reached, covariance, records, seconds)
    if callback:
        callback.on_end(calibration)
    return calibration


def _covariance(measurements: Measurements, adjusted: StageResult, sigma_px: Tensor) -> Tensor:
    """The cameras' covariance where they were adjusted, for the noise found since."""
    length = adjusted.losses.get("stick_length")
    sigma_m = length.sigma if length is not None and length.weight == 1.0 else StickLengthSettings().sigma_m
    return camera_covariance(measurements.keeping(adjusted.inliers), adjusted.state, sigma_px, sigma_m)


def _ignore(record: IterationRecord) -> None:
    return
