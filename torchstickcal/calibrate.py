"""The calibration, from keypoints to cameras in metres, as one story."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import Tensor

from torchstickcal.config import Config, load_config
from torchstickcal.initialise import initialise
from torchstickcal.losses import reprojection_residuals
from torchstickcal.noise import estimate_sigma_px
from torchstickcal.observations import Observations
from torchstickcal.problem import Measurements, State
from torchstickcal.result import Calibration
from torchstickcal.solvers import IterationRecord
from torchstickcal.stages import StageRecord, rulers, run_stage

_USELESS_FOCAL_SHARE = 0.03


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
    known = rulers(observations, settings)
    measurements = Measurements.of(observations, _points_used(observations, settings))
    labels = [observations.camera_label(index) for index in range(observations.num_cameras)]

    state = initialise(measurements, settings.initialise, labels)
    seconds = {"initialise": time.perf_counter() - began}

    used, stages = measurements, list[StageRecord]()
    for name, stage in settings.stages.items():
        listener = callback.on_iteration if callback else _ignore
        state, used, record = run_stage(name, stage, measurements, state, known, settings.solver, listener)
        stages.append(record)
        seconds[name] = record.seconds
    seconds["total"] = time.perf_counter() - began

    calibration = _result(observations, measurements, used, state, stages, seconds, labels)
    if callback:
        callback.on_end(calibration)
    return calibration


def _points_used(observations: Observations, config: Config) -> list[int] | None:
    """The points that take part; None for all."""
    ends = {end for stick in observations.sticks for end in (stick.start, stick.end)}
    if config.points == "sticks":
        return sorted(ends)
    if config.points == "joints":
        return [point for point in range(observations.num_points) if point not in ends]
    return None


def _result(
    observations: Observations,
    measurements: Measurements,
    used: Measurements,
    state: State,
    stages: list[StageRecord],
    seconds: dict[str, float],
    labels: list[str],
) -> Calibration:
    points = used.by_frame(state.points.where(used.active, torch.nan)).movedim(0, -1)
    compared = (observations.visible & points.isfinite().all(-1))[..., None]
    residuals = reprojection_residuals(
        points, state.rotations, state.translations, observations.keypoints.double(), measurements.cameras
    ).where(compared, torch.nan)

    def as_given(tensor: Tensor) -> Tensor:
        return tensor.to(observations.keypoints.dtype).contiguous()

    sigma_px = estimate_sigma_px(measurements, state)
    distortion, size = observations.distortion, observations.image_size
    cameras = observations.num_cameras
    return Calibration(
        rotations=as_given(state.rotations),
        translations=as_given(state.translations),
        points=as_given(points),
        residuals_px=as_given(residuals),
        inliers=used.by_frame(used.visible),
        stick_lengths_m=as_given(_stick_lengths(observations, points)),
        sigma_px=as_given(sigma_px),
        intrinsics=as_given(observations.cameras.matrix),
        distortion=None if distortion is None else as_given(distortion.expand(cameras, distortion.shape[-1])),
        image_size=None if size is None else size.expand(cameras, 2).round().long().contiguous(),
        fisheye=observations.fisheye,
        sticks=observations.sticks,
        fps=observations.fps,
        point_names=observations.point_names,
        camera_names=tuple(labels),
        stages=tuple(stages),
        seconds=seconds,
        warnings=_warnings(observations, measurements, used, sigma_px),
    )


def _stick_lengths(observations: Observations, points: Tensor) -> Tensor:
    """(F, S), of points (F, P, 3)."""
    starts, ends = [s.start for s in observations.sticks], [s.end for s in observations.sticks]
    return (points[:, ends] - points[:, starts]).square().sum(-1).sqrt()


def _warnings(observations: Observations, measurements: Measurements, used: Measurements, sigma_px: Tensor) -> tuple[str, ...]:
    found: list[str] = []
    comparable, kept = int(measurements.visible.sum()), int(used.visible.sum())
    seen = int(observations.visible[:, :, measurements.by_frame(measurements.active).any(0)].sum())
    if seen > comparable:
        found.append(f"{seen - comparable} of {seen} keypoints took no part: no second camera saw the point.")
    if comparable > kept:
        share = (comparable - kept) / comparable
        found.append(f"{comparable - kept} of {comparable} keypoints ({share:.1%}) contradict the rest and were set aside.")
    blurred = (sigma_px > _USELESS_FOCAL_SHARE * measurements.cameras.focal_px.mean()).nonzero().flatten().tolist()
    if blurred:
        names = ", ".join(observations.point_label(point) for point in blurred)
        found.append(f"too noisy to be of use (their 3D points are not reliable): {names}.")
    return tuple(found)


def _ignore(record: IterationRecord) -> None:
    return
