"""The calibration, from keypoints to cameras in metres, as one story."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, Protocol

import torch
from torch import Tensor

from torchstickcal.assemble import assemble
from torchstickcal.camera_unknowns import CameraUnknowns
from torchstickcal.config import Config, Refine, Stage, StickLengthSettings, load_config, with_refine
from torchstickcal.errors import ConfigError
from torchstickcal.focal_search import search_focal
from torchstickcal.initialise import initialise
from torchstickcal.lens_check import LensCheck, with_refinements
from torchstickcal.observations import Observations
from torchstickcal.problem import Measurements, State
from torchstickcal.result import Calibration
from torchstickcal.solvers import IterationRecord, unheard
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
    refine: Sequence[Refine] | Literal["auto"] | None = None,
) -> Calibration:
    """Find the extrinsics of all cameras and the 3D points, in metres, in the frame of the first camera.

    Args:
        observations: keypoints, intrinsics and sticks.
        config: a configuration's name, a TOML file, a mapping of its keys, or a :class:`Config`.
        callback: listens to the iterations and the result.
        refine: what else to find of the cameras, instead of what the configuration says: some of ``focal``, ``focal_shared``,
            ``principal_point``, ``radial``, or ``auto`` for what the data contradict.

    Returns:
        The calibration. Its ``status`` says whether every stage converged; a stage that did not leaves the best state it
        reached.

    Raises:
        ConfigError: for an unusable configuration.
        RigError: if the cameras cannot be placed in one rig.
    """
    settings = load_config(config)
    if refine is not None:
        settings = with_refine(settings, refine)
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
    refined = () if settings.refine == "auto" else tuple(settings.refine)
    if observations.intrinsics_known:
        state = initialise(measurements, settings.initialise, labels)
    else:
        measurements, state = search_focal(measurements, settings, labels, known)
        refined = refined if "focal" in refined else with_refinements(refined, ("focal_shared",))
    measurements = refining(measurements, refined, settings)
    seconds = {"initialise": time.perf_counter() - began}

    records: list[StageRecord] = []
    listener = callback.on_iteration if callback else unheard

    def run(stages: Mapping[str, Stage], start: State) -> StageResult:
        result: StageResult | None = None
        for name, stage in stages.items():
            result = run_stage(name, stage, measurements, start, known, settings.solver, listener)
            start = result.state
            records.extend(result.records)
            seconds[name] = seconds.get(name, 0.0) + records[-1].seconds
        assert result is not None
        return result

    adjusting, holding = _split(settings.stages)
    adjusted = run(adjusting, state)
    check = _check(measurements, adjusted, settings)
    failed: list[tuple[str, ...]] = []
    while settings.refine == "auto" and (choice := check.wanted(refined, failed)):
        wanted = with_refinements(refined, choice)
        before = len(records)
        known_lenses, measurements = measurements, refining(measurements, wanted, settings)
        found = run(adjusting, replace(adjusted.state, unknowns=None))
        if not all(record.stop.converged for record in records[before:]):
            measurements = known_lenses
            failed.append(choice)
            del records[before:]
            continue
        refined, adjusted = wanted, found
        check = _check(measurements, adjusted, settings)
    reached = run(holding, adjusted.state) if holding else adjusted
    covariance = _covariance(measurements, adjusted, reached.sigma_px)
    seconds["total"] = time.perf_counter() - began

    calibration = assemble(observations, measurements, reached, covariance, refined, check.focal(), records, seconds)
    if callback:
        callback.on_end(calibration)
    return calibration


def refining(measurements: Measurements, names: Sequence[str], settings: Config) -> Measurements:
    """Measurements with some of :data:`torchstickcal.camera_unknowns.REFINEMENTS` among the unknowns.

    Raises:
        ConfigError: if there are camera groups, but not a label for each camera.
    """
    groups = settings.camera_groups
    if groups and len(groups) != measurements.num_cameras:
        raise ConfigError(
            "camera groups do not fit the cameras",
            where="camera_groups",
            got=f"{len(groups)} labels",
            expected=f"{measurements.num_cameras}, one for each camera",
        )
    return replace(measurements, unknowns=CameraUnknowns.of(names, measurements.cameras, groups) if names else None)


def _split(stages: Mapping[str, Stage]) -> tuple[dict[str, Stage], dict[str, Stage]]:
    """The stages up to the last that adjusts the cameras, and those after it."""
    names = list(stages)
    last = max((number for number, name in enumerate(names) if stages[name].cameras == "free"), default=len(names) - 1)
    return {name: stages[name] for name in names[: last + 1]}, {name: stages[name] for name in names[last + 1 :]}


def _check(measurements: Measurements, adjusted: StageResult, settings: Config) -> LensCheck:
    kept = measurements.keeping(adjusted.inliers)
    return LensCheck(kept, adjusted.state, adjusted.sigma_px, _sigma_length_m(adjusted), settings.camera_groups)


def _covariance(measurements: Measurements, adjusted: StageResult, sigma_px: Tensor) -> Tensor | None:
    """That of the cameras where they were adjusted, for the noise found since."""
    if not adjusted.cameras_free:
        return None
    return camera_covariance(measurements.keeping(adjusted.inliers), adjusted.state, sigma_px, _sigma_length_m(adjusted))


def _sigma_length_m(adjusted: StageResult) -> Tensor | float:
    length = adjusted.losses.get("stick_length")
    return length.sigma if length is not None and length.weight == 1.0 else StickLengthSettings().sigma_m
