"""The calibration as one story, in the steps of the README."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, Protocol

from torch import Tensor

from torchstickcal.config import Config, Refine, load_config, with_refine
from torchstickcal.errors import ObservationError, RigError
from torchstickcal.model.unknowns import REFINEMENTS, clock_refinements, with_refinements
from torchstickcal.observations import Observations
from torchstickcal.pipeline.adjust import Adjustment, Run, adjust_again, adjust_cameras, adjust_points, begin, measured
from torchstickcal.pipeline.check import CameraCheck
from torchstickcal.pipeline.conclude import conclude
from torchstickcal.pipeline.scale import rulers
from torchstickcal.pipeline.synchronise import ClockEstimate, on_common_frames, search_offsets, unsynchronised
from torchstickcal.result import Calibration
from torchstickcal.solvers import IterationRecord, unheard
from torchstickcal.workers import on_worker

_MAX_STARTS = 3
_FAR_FRAMES = 0.75
"""Time offset from the frames chosen, in frames, from which on other frames are nearer."""
_FITTING_SHARE, _FITTING_FOCAL_SHARE = 0.6, 0.01
"""Least fraction of inliers, and largest noise as a fraction of the focal length, of cameras that fit together."""


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
        config: the name of a configuration, a TOML file, a mapping of its keys, or a :class:`Config`.
        callback: listens to the iterations and the result.
        refine: what else to estimate of the cameras, instead of what the configuration says: names of
            :data:`torchstickcal.model.unknowns.REFINEMENTS`, such as ``focal``, ``radial`` or ``time_offset``, or ``auto`` for
            what the keypoints contradict.

    Returns:
        The calibration. Its ``status`` says whether every stage converged; a stage that did not leaves the best state it found.

    Raises:
        ConfigError: if the configuration cannot be used.
        ObservationError: if clocks are to be estimated without a frame rate.
        RigError: if the cameras cannot be placed in one rig.

    Example:
        >>> from torchstickcal.simulate import golf_session
        >>> observations, truth = golf_session(cameras=3, frames=20)
        >>> calibration = calibrate(observations)
        >>> calibration.status
        'converged'
        >>> calibration.rotations.shape, calibration.points.shape
        (torch.Size([3, 3, 3]), torch.Size([20, 21, 3]))
    """
    settings = load_config(config)
    if refine is not None:
        settings = with_refine(settings, refine)
    return on_worker(observations.keypoints.device, _calibrated, observations, settings, callback)


def _calibrated(observations: Observations, config: Config, callback: Callback | None) -> Calibration:
    began = time.perf_counter()
    run = Run(config, callback.on_iteration if callback else unheard)
    rulers([observations], config)
    choices = _Choices(observations, config)

    # 1. Synchronise: where the cameras' frames clearly do not belong together, find the time offsets.
    clocks = choices.searched if choices.may_search and choices.unsynchronised else None

    # 2. Initialise, and 3. adjust cameras and points, at the time offsets at which the views fit together best.
    adjusted, clocks = _adjusted(observations, run, choices, clocks)

    # 4. Check the given lenses and clocks; with refine="auto", estimate what the keypoints contradict.
    check = CameraCheck(adjusted, config.camera_groups)
    if config.refine == "auto":
        adjusted, check = _refined_where_contradicted(observations, run, choices, adjusted, check)

    # 5. Trajectories: with the cameras fixed, each point is smoothed as its noise and its motion demand.
    ended = adjust_points(adjusted, run)

    # 6. Conclude: covariance, warnings, and the result as the caller wants it.
    contradicted = config.synchronise and "time_offset" not in ended.refined and choices.unsynchronised
    run.seconds["total"] = time.perf_counter() - began
    calibration = conclude(ended, check, clocks, contradicted, run.seconds)
    if callback:
        callback.on_end(calibration)
    return calibration


@dataclass(frozen=True)
class _Choices:
    """What may be estimated beside poses and points, and what the motion in the images says of the clocks.

    Raises:
        ObservationError: if something is to be refined that the session does not allow.
    """

    observations: Observations
    config: Config

    def __post_init__(self) -> None:
        impossible = set(self.named) - self._refinable
        if impossible:
            raise ObservationError(
                "clocks cannot be estimated without a frame rate",
                where="refine",
                got=", ".join(sorted(impossible)),
                expected="fps or timestamps, and for readout also image_size",
            )

    @property
    def named(self) -> tuple[str, ...]:
        """What the configuration names."""
        return () if self.config.refine == "auto" else tuple(self.config.refine)

    @property
    def allowed(self) -> set[str]:
        """What may be estimated."""
        if self.config.refine != "auto":
            return set(self.named)
        return self._refinable if self.config.synchronise else self._refinable - clock_refinements()

    @property
    def may_search(self) -> bool:
        """Whether time offsets may be searched for."""
        return "time_offset" in self.allowed

    @cached_property
    def unsynchronised(self) -> bool:
        """Whether the cameras' frames clearly do not belong together as given."""
        return "time_offset" in self._refinable and unsynchronised(*self._to_search)

    @cached_property
    def searched(self) -> ClockEstimate:
        """The time offsets by the motion in the images."""
        return search_offsets(*self._to_search)

    @property
    def _to_search(self) -> tuple[Any, float]:
        """The keypoints at the times given, and the largest offset that is looked for, in frames."""
        frames = on_common_frames(self.observations)
        assert frames.rate_hz is not None
        return measured(frames, self.config), self.config.max_offset_s * frames.rate_hz

    @property
    def _refinable(self) -> set[str]:
        """What the session allows: clocks are counted in frames per second, read-out times in rows of the image."""
        given = self.observations
        names = set(REFINEMENTS) - clock_refinements()
        if given.fps is not None or given.timestamps is not None:
            names |= clock_refinements() if given.image_size is not None else {"time_offset"}
        return names


def _adjusted(
    observations: Observations, run: Run, choices: _Choices, clocks: ClockEstimate | None
) -> tuple[Adjustment, ClockEstimate | None]:
    """The session adjusted at the time offsets, of those given and those searched for, at which the views fit together best.

    Raises:
        RigError: if the cameras cannot be placed in one rig.
    """
    lenses = tuple(name for name in choices.named if name not in clock_refinements())
    found = [] if clocks is None else _at_offsets(observations, run, choices, clocks)
    failure: RigError | None = None
    if not any(map(_fits, found)):
        try:
            found.append(_adjusted_at(observations, run, lenses))
        except RigError as error:
            failure = error
    if choices.may_search and clocks is None and not any(map(_fits, found)):
        clocks = choices.searched
        found += _at_offsets(observations, run, choices, clocks)
    if not found and failure is not None:
        raise failure
    best = min(found, key=_median_squared_residual)
    if not set(choices.named) <= set(best.refined):
        best = _at_nearest_frames(observations, run, adjust_again(best, run, choices.named))
    return best, clocks


def _at_offsets(observations: Observations, run: Run, choices: _Choices, clocks: ClockEstimate) -> list[Adjustment]:
    """The session adjusted at the likeliest offsets, and where not all are certain, also at the certain ones alone."""
    found: list[Adjustment] = []
    for offsets in (clocks.likeliest_frames, *(() if all(clocks.determined) else (clocks.offsets_frames,))):
        try:
            found.append(_adjusted_at(observations, run, with_refinements(choices.named, ("time_offset",)), offsets))
        except (RigError, ObservationError):
            continue
    return found


def _adjusted_at(
    observations: Observations, run: Run, refined: Sequence[str], offsets_frames: Tensor | None = None
) -> Adjustment:
    """The session initialised and adjusted at some time offsets (C,) of the cameras, in frames; None for those given."""
    begun = begin(observations, run, refined, offsets_frames)
    return _at_nearest_frames(observations, run, adjust_cameras(begun, run))


def _at_nearest_frames(observations: Observations, run: Run, adjustment: Adjustment) -> Adjustment:
    """Begun again where the time offsets found say that other frames of a camera are nearer to the common frames."""
    for _ in range(_MAX_STARTS - 1):
        remaining = adjustment.remaining_offsets_frames
        if not bool((remaining.abs() > _FAR_FRAMES).any()):
            break
        offsets = adjustment.frames[0].offsets_frames + remaining
        adjustment = adjust_cameras(begin(observations, run, adjustment.refined, offsets), run)
    return adjustment


def _refined_where_contradicted(
    observations: Observations, run: Run, choices: _Choices, adjusted: Adjustment, check: CameraCheck
) -> tuple[Adjustment, CameraCheck]:
    """The session adjusted with the unknowns that the keypoints contradict, the most contradicted first, and checked again."""
    failed: list[tuple[str, ...]] = []
    while choice := check.wanted(choices.allowed, adjusted.refined, failed):
        refined = with_refinements(adjusted.refined, choice)
        again = _at_nearest_frames(observations, run, adjust_again(adjusted, run, refined))
        if again.converged:
            adjusted, check = again, CameraCheck(again, run.config.camera_groups)
        else:
            failed.append(choice)
    return adjusted, check


def _fits(adjustment: Adjustment) -> bool:
    """Whether the cameras agree with one another as those of one scene do."""
    share = adjustment.last.inliers.sum() / adjustment.measurements.visible.sum()
    noise = adjustment.last.sigma_px.median() / adjustment.measurements.cameras.focal_px.mean()
    return adjustment.converged and float(share) > _FITTING_SHARE and float(noise) < _FITTING_FOCAL_SHARE


def _median_squared_residual(adjustment: Adjustment) -> float:
    """Of all keypoints, inliers and outliers, square pixels."""
    squared = adjustment.measurements.squared_residuals(adjustment.state)
    return float(squared[adjustment.measurements.visible].median())
