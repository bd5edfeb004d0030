"""The calibration, from keypoints to cameras in metres, as one story."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, Protocol

from torchstickcal.config import Config, Refine, load_config, with_refine
from torchstickcal.errors import ObservationError, RigError
from torchstickcal.model.unknowns import CLOCKS
from torchstickcal.observations import Observations
from torchstickcal.pipeline.adjust import Adjuster, Adjustment
from torchstickcal.pipeline.check import CameraCheck, with_refinements
from torchstickcal.pipeline.conclude import assemble
from torchstickcal.pipeline.synchronise import ClockEstimate
from torchstickcal.result import Calibration
from torchstickcal.solvers import IterationRecord, unheard
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
            ``principal_point``, ``radial``, ``time_offset``, ``readout``, or ``auto`` for what the data contradict.

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


def _calibrated(observations: Observations, settings: Config, callback: Callback | None) -> Calibration:
    began = time.perf_counter()
    adjuster = Adjuster(observations, settings, callback.on_iteration if callback else unheard)
    adjusted, clocks = _synchronised(adjuster, settings)
    check = adjuster.check(adjusted)
    if settings.refine == "auto":
        adjusted, check = _chosen(adjuster, settings, adjusted, check)
    reached = adjuster.held(adjusted)
    covariance = adjusted.covariance(reached.result.sigma_px)
    doubtful = settings.synchronise and "time_offset" not in reached.refined and adjuster.out_of_step
    seconds = adjuster.seconds | {"total": time.perf_counter() - began}
    calibration = assemble(observations, reached, covariance, check, clocks, doubtful, seconds)
    if callback:
        callback.on_end(calibration)
    return calibration


def _synchronised(adjuster: Adjuster, settings: Config) -> tuple[Adjustment, ClockEstimate | None]:
    """The session adjusted with the unknowns that the configuration names, and what a search for the clocks has found.

    The clocks are searched for where they may differ, and the cameras are clearly out of step or do not fit together. Of the
    offsets told and those found, the ones at which the views agree best are taken.

    Raises:
        RigError: if the cameras cannot be placed in one rig.
    """
    refined = () if settings.refine == "auto" else tuple(settings.refine)
    lenses = tuple(name for name in refined if name not in CLOCKS)
    searchable = "time_offset" in (_free(adjuster, settings) if settings.refine == "auto" else refined)
    clocks: ClockEstimate | None = None
    found: list[Adjustment] = []
    failure: RigError | None = None
    if searchable and adjuster.out_of_step:
        clocks = adjuster.search()
        found += _at_offsets(adjuster, refined, clocks)
    if not any(adjustment.fits for adjustment in found):
        try:
            found.append(adjuster.begin(lenses))
        except RigError as error:
            failure = error
    if searchable and clocks is None and not any(adjustment.fits for adjustment in found):
        clocks = adjuster.search()
        found += _at_offsets(adjuster, refined, clocks)
    if not found and failure is not None:
        raise failure
    best = min(found, key=lambda adjustment: adjustment.median_residual)
    return best if set(refined) <= set(best.refined) else adjuster.again(best, refined), clocks


def _at_offsets(adjuster: Adjuster, refined: Sequence[str], clocks: ClockEstimate) -> list[Adjustment]:
    """The session adjusted at the offsets that a search has found; where some are not sure, at the likeliest and as told."""
    found: list[Adjustment] = []
    for offsets in (clocks.likeliest_frames, *(() if all(clocks.determined) else (clocks.offsets_frames,))):
        try:
            found.append(adjuster.begin(with_refinements(refined, ("time_offset",)), offsets))
        except (RigError, ObservationError):
            continue
    return found


def _chosen(adjuster: Adjuster, settings: Config, adjusted: Adjustment, check: CameraCheck) -> tuple[Adjustment, CameraCheck]:
    """The session adjusted with what the data contradict among the unknowns, the most contradicted first, and checked again."""
    free, failed = _free(adjuster, settings), []
    while choice := check.wanted(free, adjusted.refined, failed):
        refined = adjuster.again(adjusted, with_refinements(adjusted.refined, choice))
        if refined.converged:
            adjusted, check = refined, adjuster.check(refined)
        else:
            failed.append(choice)
    return adjusted, check


def _free(adjuster: Adjuster, settings: Config) -> set[str]:
    """What ``auto`` may refine."""
    return adjuster.refinable if settings.synchronise else adjuster.refinable - CLOCKS
