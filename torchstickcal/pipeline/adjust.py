"""One session's adjustment: initialised, brought through its stages, with lenses and clocks among the unknowns."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import torch
from torch import Tensor

from torchstickcal.config import Config, Stage, StickLengthSettings
from torchstickcal.errors import ObservationError
from torchstickcal.model.measurements import Measurements, State
from torchstickcal.model.unknowns import CLOCKS, REFINEMENTS, CameraUnknowns
from torchstickcal.observations import Observations
from torchstickcal.pipeline.check import CameraCheck, with_refinements
from torchstickcal.pipeline.focal_search import search_focal
from torchstickcal.pipeline.initialise import initialise
from torchstickcal.pipeline.stage import StageResult, rulers, run_stage
from torchstickcal.pipeline.synchronise import (
    CLOCK_STAGE,
    ClockEstimate,
    CommonFrames,
    Exposures,
    Support,
    on_common_frames,
    on_one_clock,
    out_of_step,
    search_offsets,
)
from torchstickcal.solvers import Listener, StageRecord
from torchstickcal.solvers.uncertainty import camera_covariance

_MAX_STARTS = 3
_CHECKED_FRAMES = 5000
_FITTING_SHARE, _FITTING_FOCAL_SHARE = 0.6, 0.01
"""Least share of the keypoints that agree, and largest noise over the focal length, where the cameras fit together."""
_FAR_FRAMES = 0.75
"""Offset from where a camera's frames were placed from which on others are nearer."""


@dataclass(frozen=True)
class Adjustment:
    """A session with its cameras adjusted."""

    frames: CommonFrames
    seen: Measurements
    """the keypoints as seen, on the common frames, with the unknowns"""
    measurements: Measurements
    """the same, brought to the common clock"""
    refined: tuple[str, ...]
    """what is found of the cameras beside their poses"""
    result: StageResult
    records: tuple[StageRecord, ...]
    window: slice = field(default_factory=lambda: slice(None))
    """which of the common frames this is about"""

    def within(self, most_frames: int) -> Adjustment:
        """Cut down to the middle of a session that is longer."""
        total = self.measurements.frames
        if total <= most_frames:
            return self
        start = (total - most_frames) // 2
        window = slice(start, start + most_frames)
        columns, result = self.measurements.columns_of(window), self.result
        state = replace(result.state, points=result.state.points[..., columns])
        return replace(
            self,
            seen=self.seen.within(window),
            measurements=self.measurements.within(window),
            result=result._replace(state=state, inliers=result.inliers[..., columns]),
            window=window,
        )

    @property
    def exposures(self) -> Exposures:
        """When the keypoints were exposed, as far as told."""
        return Exposures.of(self.frames, self.window)

    @property
    def apart(self) -> bool:
        """Whether keypoints at one common frame were not, or need not have been, exposed together."""
        return self.frames.apart or bool(CLOCKS & set(self.refined))

    @property
    def kept(self) -> Measurements:
        """The measurements that took part to the end."""
        return self.measurements.keeping(self.result.inliers)

    @property
    def converged(self) -> bool:
        """Whether every stage did."""
        return all(record.stop.converged for record in self.records)

    @property
    def fits(self) -> bool:
        """Whether the cameras agree as those of one scene do, with detectors of any use."""
        share = self.result.inliers.sum() / self.measurements.visible.sum()
        noise = self.result.sigma_px.median() / self.measurements.cameras.focal_px.mean()
        return self.converged and float(share) > _FITTING_SHARE and float(noise) < _FITTING_FOCAL_SHARE

    @property
    def median_residual(self) -> float:
        """Median squared residual of all keypoints, square pixels."""
        return float(self.measurements.squared_residuals(self.result.state)[self.measurements.visible].median())

    @property
    def late_frames(self) -> Tensor:
        """(C,), how much later than at :attr:`frames` the cameras were found to look, frames."""
        nothing = torch.zeros_like(self.frames.offsets_frames)
        return self.found.get("time_offset", nothing)

    @property
    def found(self) -> dict[str, Tensor]:
        """Each camera's value (C,) of what else was unknown of it, by kind."""
        unknowns, values = self.measurements.unknowns, self.result.state.unknowns
        if unknowns is None or values is None:
            return {}
        return {name: own[0] for name, own in unknowns.by_kind(values).items()}

    def covariance(self, sigma_px: Tensor) -> Tensor | None:
        """That of the cameras where they were adjusted, for a noise (1, P) of the points' keypoints."""
        if not self.result.cameras_free:
            return None
        return camera_covariance(self.kept, self.result.state, sigma_px, self.sigma_length_m)

    @property
    def sigma_length_m(self) -> Tensor | float:
        """How well the sticks' lengths hold."""
        length = self.result.losses.get("stick_length")
        return length.sigma if length is not None and length.weight == 1.0 else StickLengthSettings().sigma_m


class Adjuster:
    """Adjusts one session in different ways: at other clock offsets, with other unknowns.

    Args:
        observations: the session.
        settings: the configuration.
        listener: hears every iteration.

    Raises:
        ConfigError: if nothing sets the scale.
        ObservationError: if clocks are to be found without what they are counted in.
    """

    def __init__(self, observations: Observations, settings: Config, listener: Listener) -> None:
        self._observations, self._settings, self._listener = observations, settings, listener
        self._known = rulers([observations], settings)
        self._adjusting, self._holding = _split(settings.stages)
        self.seconds: dict[str, float] = {}
        """time by step"""
        impossible = set() if settings.refine == "auto" else set(settings.refine) - self.refinable
        if impossible:
            raise ObservationError(
                "clocks without what they are counted in",
                where="refine",
                got=", ".join(sorted(impossible)),
                expected="fps or timestamps, and for readout the image size",
            )

    @property
    def refinable(self) -> set[str]:
        """What the session allows to refine: clocks are counted in frames a second, a shutter in rows of the image."""
        given = self._observations
        names = set(REFINEMENTS) - CLOCKS
        if given.fps is not None or given.timestamps is not None:
            names |= CLOCKS if given.image_size is not None else {"time_offset"}
        return names

    def search(self) -> ClockEstimate:
        """The clocks' offsets by the motion in the images."""
        return search_offsets(*self._as_told())

    @cached_property
    def out_of_step(self) -> bool:
        """Whether the cameras' frames clearly do not belong together as told, by the motion in the images."""
        return "time_offset" in self.refinable and out_of_step(*self._as_told())

    def _as_told(self) -> tuple[Measurements, float]:
        """The keypoints on the clocks as told, and the largest offset that is looked for, frames."""
        frames = on_common_frames(self._observations)
        assert frames.rate_hz is not None
        return self._seen(frames), self._settings.max_offset_s * frames.rate_hz

    def _seen(self, frames: CommonFrames) -> Measurements:
        """The keypoints that may take part."""
        precision = torch.float32 if self._settings.precision == "float32" else torch.float64
        return Measurements.of(frames.observations, points_used(self._observations, self._settings), precision)

    def begin(self, refined: Sequence[str], offsets_frames: Tensor | None = None) -> Adjustment:
        """Adjust from nothing.

        Args:
            refined: what to find of the cameras beside their poses.
            offsets_frames: (C,), how much later than reckoned the cameras' frames begin; None for not at all.

        Raises:
            RigError: if the cameras cannot be placed in one rig.
        """
        return self._nearer(self._begin(refined, offsets_frames))

    def _begin(self, refined: Sequence[str], offsets_frames: Tensor | None) -> Adjustment:
        """Initialised with the cameras' frames side by side at some offsets, and adjusted."""
        began = time.perf_counter()
        frames = on_common_frames(self._observations, offsets_frames)
        seen, given = self._seen(frames), self._observations
        labels = [given.camera_label(index) for index in range(given.num_cameras)]
        if given.intrinsics_known:
            state = initialise(seen, self._settings.initialise, labels)
        else:
            seen, state = search_focal(seen, self._settings, labels, self._known)
            refined = refined if "focal" in refined else with_refinements(refined, ("focal_shared",))
        self._took("initialise", time.perf_counter() - began)
        seen = self._refining(seen, refined)
        measurements, records = _resting(frames, seen), []
        result = self._through(self._adjusting, measurements, _starting(seen, state), records)
        return self._on_one_clock(Adjustment(frames, seen, measurements, tuple(refined), result, tuple(records)))

    def again(self, adjustment: Adjustment, refined: Sequence[str]) -> Adjustment:
        """Adjust again from where an adjustment ended, with more refined; where that is clocks alone, the last stage does."""
        seen, old = self._refining(adjustment.seen, refined), adjustment.result.state
        state = _starting(seen, old, adjustment.seen.unknowns)
        result = adjustment.result._replace(state=state)
        measurements = _placed(adjustment, seen, state) if adjustment.apart else _resting(adjustment.frames, seen)
        records = list(adjustment.records)
        if set(refined) - set(adjustment.refined) - CLOCKS:
            records = []
            result = self._through(self._adjusting, measurements, state, records)
        started = replace(adjustment, seen=seen, measurements=measurements, refined=tuple(refined))
        return self._nearer(self._on_one_clock(replace(started, result=result, records=tuple(records))))

    def _nearer(self, adjustment: Adjustment) -> Adjustment:
        """Begun again with the cameras' frames at the common frames nearest to them, if these are others than was thought."""
        for _ in range(_MAX_STARTS - 1):
            if not bool((adjustment.late_frames.abs() > _FAR_FRAMES).any()):
                break
            adjustment = self._begin(adjustment.refined, adjustment.frames.offsets_frames + adjustment.late_frames)
        return adjustment

    def held(self, adjustment: Adjustment) -> Adjustment:
        """The stages that follow once the cameras are found."""
        if not self._holding:
            return adjustment
        records = list(adjustment.records)
        result = self._through(self._holding, adjustment.measurements, adjustment.result.state, records)
        return replace(adjustment, result=result, records=tuple(records))

    def check(self, adjustment: Adjustment) -> CameraCheck:
        """What the data say of lenses and clocks where an adjustment ended; of a long session some of the data."""
        part = adjustment.within(_CHECKED_FRAMES)
        result = part.result
        kept = _placed(part, part.seen, result.state).keeping(result.inliers)
        return CameraCheck(kept, result.state, result.sigma_px, adjustment.sigma_length_m, self._settings.camera_groups)

    def _on_one_clock(self, adjustment: Adjustment) -> Adjustment:
        """Where keypoints were not exposed together, the last stage on the common clock."""
        if not adjustment.apart:
            return adjustment
        last, records = list(self._adjusting.values())[-1], list(adjustment.records)

        def run(placed: Measurements, state: State) -> StageResult:
            return self._run(CLOCK_STAGE, last, placed, state, records)

        ended = adjustment.measurements, adjustment.result
        placed, result = on_one_clock(adjustment.seen, adjustment.exposures, *ended, run)
        return replace(adjustment, measurements=placed, result=result, records=tuple(records))

    def _through(
        self, stages: Mapping[str, Stage], measurements: Measurements, state: State, records: list[StageRecord]
    ) -> StageResult:
        result: StageResult | None = None
        for name, stage in stages.items():
            result = self._run(name, stage, measurements, state, records)
            state = result.state
        assert result is not None
        return result

    def _run(
        self, name: str, stage: Stage, measurements: Measurements, state: State, records: list[StageRecord]
    ) -> StageResult:
        result = run_stage(name, stage, measurements, state, self._known, self._settings.solver, self._listener)
        records.extend(result.records)
        self._took(name, records[-1].seconds)
        return result

    def _took(self, step: str, seconds: float) -> None:
        self.seconds[step] = self.seconds.get(step, 0.0) + seconds

    def _refining(self, seen: Measurements, names: Sequence[str]) -> Measurements:
        """Measurements with some of :data:`torchstickcal.model.unknowns.REFINEMENTS` among the unknowns.

        Raises:
            ConfigError: if there are camera groups, but not a label for each camera.
        """
        return replace(seen, unknowns=CameraUnknowns.of(names, seen.cameras, self._settings.camera_groups) if names else None)


def points_used(observations: Observations, config: Config) -> list[int] | None:
    """The points that take part; None for all."""
    ends = {end for stick in observations.sticks for end in (stick.start, stick.end)}
    if config.points == "sticks":
        return sorted(ends)
    if config.points == "joints":
        return [point for point in range(observations.num_points) if point not in ends]
    return None


def _split(stages: Mapping[str, Stage]) -> tuple[dict[str, Stage], dict[str, Stage]]:
    """The stages up to the last that adjusts the cameras, and those after it."""
    names = list(stages)
    last = max((number for number, name in enumerate(names) if stages[name].cameras == "free"), default=len(names) - 1)
    return {name: stages[name] for name in names[: last + 1]}, {name: stages[name] for name in names[last + 1 :]}


def _starting(seen: Measurements, state: State, before: CameraUnknowns | None = None) -> State:
    """A state for the measurements' unknowns: those it has, of the unknowns before, and else what was given."""
    if seen.unknowns is None:
        return replace(state, unknowns=None)
    nothing = torch.zeros_like(seen.unknowns.prior_sigma)
    if before is None or state.unknowns is None:
        return replace(state, unknowns=nothing)
    return replace(state, unknowns=seen.unknowns.taken_over(before, state.unknowns))


def _resting(frames: CommonFrames, seen: Measurements) -> Measurements:
    """Keypoints as seen, as if nothing moved, where clocks are among the unknowns."""
    return Exposures.of(frames).resting(seen) if seen.unknowns is not None and seen.unknowns.clocked else seen


def _placed(adjustment: Adjustment, seen: Measurements, state: State) -> Measurements:
    """Keypoints as seen, brought to the common clock at a state by the motion that an adjustment has found."""
    result = adjustment.result
    return adjustment.exposures.placed(seen, state, Support.of(adjustment.kept, result.state, result.sigma_px))
