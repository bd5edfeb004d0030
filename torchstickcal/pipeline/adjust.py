"""The path that :func:`torchstickcal.calibrate` and :class:`torchstickcal.CalibrationLayer` share.

``begin`` (one session) -> ``adjust_cameras`` -> ``adjust_points`` (B sessions side by side). What follows is each one's own: a
:class:`torchstickcal.Calibration`, or gradients.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from torchstickcal.config import Config, Stage
from torchstickcal.model.measurements import Measurements
from torchstickcal.model.state import State
from torchstickcal.model.unknowns import RigUnknowns, clock_refinements, with_refinements
from torchstickcal.observations import Observations
from torchstickcal.pipeline.adjustment import Adjustment, WarmStart
from torchstickcal.pipeline.focal_search import search_focal
from torchstickcal.pipeline.initialise import initialise, small_squared_residuals, triangulated
from torchstickcal.pipeline.noise import check_noise
from torchstickcal.pipeline.relabel import Labels, mended
from torchstickcal.pipeline.run import Run
from torchstickcal.pipeline.scale import check_scale, rulers
from torchstickcal.pipeline.settle import polished, settled
from torchstickcal.pipeline.stage import StageResult, run_stage
from torchstickcal.pipeline.stages import through
from torchstickcal.pipeline.synchronise import (
    CLOCK_STAGE,
    CommonFrames,
    Support,
    on_common_frames,
    synchronise_keypoints,
)

_INITIALISE, _RELABEL = "initialise", "relabel"
_MAX_RELABELLINGS = 3
_ALIKE, _CLEARLY_LESS = 4.0, 0.9
"""Ratio of the lower quartiles of the squared residuals of two scenes, below which their images are alike; and the ratio that
says that one of them is wrong."""
_EXACT = 1e-5
"""Cost tolerance of the stage for this comparison."""
_ROUGHLY, _NEARLY = 1e-3, 1e-6
"""Relative decrease of the cost from which on Newton's method can take over; and the same where it is first decided there from
which keypoints the noise is estimated."""


def begin(
    observations: Observations,
    run: Run,
    refined: Sequence[str] = (),
    offsets_frames: Tensor | None = None,
    start: WarmStart | None = None,
    poses: tuple[Tensor, Tensor] | None = None,
) -> Adjustment:
    """One session with the first estimate of its rig and points.

    Args:
        observations: the session.
        run: what all steps share.
        refined: what is to be estimated of the cameras beside their poses.
        offsets_frames: (C,), time offsets of the cameras' frames, in frames; None for those given.
        start: an earlier estimate; None to estimate the rig from nothing.
        poses: rotations (C, 3, 3) and translations (C, 3) to start from, up to scale, with the first camera as the world; None
            to estimate them from nothing.

    Raises:
        ConfigError: if nothing sets the scale, if there are camera groups, but not a label for each camera, and if the noise of
            another number of points is given.
        ObservationError: if no two cameras have a frame in common.
        RigError: if the cameras cannot be placed in one rig.
    """
    began = time.perf_counter()
    config, frames = run.config, on_common_frames(observations, offsets_frames)
    seen = measured(frames, config)
    check_scale(seen, rulers(seen, config))
    check_noise(config, seen.points_per_frame)
    if start is not None:
        state = _state_of(start, seen, config)
    elif poses is not None:
        rotations, translations = poses[0][None].double(), poses[1][None].double()
        state = State.of(rotations, translations, triangulated(seen, rotations, translations, config.initialise))
        refined = (
            refined if observations.intrinsics_known or "focal" in refined else with_refinements(refined, ("focal_shared",))
        )
    elif observations.intrinsics_known:
        state = initialise(seen, config.initialise, observations.camera_labels)
    else:
        seen, state = search_focal(seen, observations.camera_labels, run)
        refined = refined if "focal" in refined else with_refinements(refined, ("focal_shared",))
    seen = replace(seen, unknowns=RigUnknowns.of(refined, seen.cameras, config.camera_groups))
    if start is None:
        state = replace(state, unknowns=seen.unknowns.given)
    begun = Adjustment((observations,), (frames,), tuple(refined), seen, seen, state, Labels.as_given(seen))
    if seen.unknowns.clocked:
        begun = replace(begun, measurements=begun.exposures.unmoved(seen))
    if start is not None and config.relabel:
        begun = relabelled(begun, run)
    if start is not None and seen.unknowns.clocked:
        known = begun.measurements
        if start.inliers is not None:
            known = known.keeping(start.inliers.flatten(1)[None])
        support = Support.of(known, begun.state, start.sigma_px[None].double())
        begun = replace(begun, measurements=begun.exposures.at_common_times(begun.seen, begun.state, support))
    run.took(_INITIALISE, time.perf_counter() - began)
    return begun


def begin_at_nearest_frames(adjustment: Adjustment, run: Run, offsets_frames: Tensor | None = None) -> Adjustment:
    """One session from where it has ended, with other frames, and time offsets among what is estimated.

    Args:
        adjustment: where the session has ended.
        run: what all steps share.
        offsets_frames: (C,), time offsets of the cameras' frames, in frames; None for those found.

    Raises:
        ObservationError: if no two cameras have a frame in common at these offsets.
    """
    if offsets_frames is None:
        offsets_frames = adjustment.frames[0].offsets_frames + adjustment.remaining_offsets_frames
    refined = with_refinements(adjustment.refined, ("time_offset",))
    own = adjustment.seen.unknowns.by_name(adjustment.state.unknowns)
    own.pop("time_offset", None)
    state = adjustment.state
    start = WarmStart(
        state.rotations[0],
        state.translations[0],
        points=None,
        unknowns=RigUnknowns.of(refined, adjustment.seen.cameras, run.config.camera_groups).of_cameras(own)[0],
        inliers=None,
        sigma_px=adjustment.last.sigma_px[0],
    )
    return begin(adjustment.observations[0], run, refined, offsets_frames, start)


def adjust_cameras(adjustment: Adjustment, run: Run, only_last: bool = False) -> Adjustment:
    """The stages up to the last that estimates cameras, and clocks until they agree with the points' motion.

    Args:
        adjustment: sessions that have begun.
        run: what all steps share.
        only_last: whether the state is near enough to begin with the last of these stages.
    """
    first, *between = run.camera_stages.items()
    if only_last:
        return _with_last_camera_stage(adjustment, run)
    if not between:
        return _settled(_synchronised(_relabelling([first], adjustment, run), run), run)
    return _with_last_camera_stage(through(between[:-1], _relabelling([first], adjustment, run), run), run)


def adjust_again(adjustment: Adjustment, run: Run, refined: Sequence[str]) -> Adjustment:
    """Sessions from where they have ended, with more to be estimated of their cameras.

    Where that is clocks alone, the last stage is run again with them; otherwise all stages are.

    Args:
        adjustment: where the sessions have ended.
        run: what all steps share.
        refined: what is to be estimated of the cameras beside their poses.
    """
    seen = replace(adjustment.seen, unknowns=RigUnknowns.of(refined, adjustment.seen.cameras, run.config.camera_groups))
    values = seen.unknowns.taken_over(adjustment.seen.unknowns, adjustment.state.unknowns)
    state = replace(adjustment.state, unknowns=values)
    measurements = seen
    if seen.unknowns.clocked and not adjustment.asynchronous:
        measurements = adjustment.exposures.unmoved(seen)
    if adjustment.asynchronous:
        measurements = adjustment.exposures.at_common_times(seen, state, adjustment.support)
    again = replace(adjustment, refined=tuple(refined), seen=seen, measurements=measurements, state=state)
    if set(refined) - set(adjustment.refined) <= clock_refinements():
        result = again.last._replace(state=state, minimum=replace(again.last.minimum, unknowns=values))
        return _settled(_synchronised(replace(again, results=(result,)), run), run)
    begun = replace(again, results=(), records=((),) * seen.sessions)
    *before, _ = run.camera_stages.items()
    return _with_last_camera_stage(through(before, begun, run), run)


def adjust_points(adjustment: Adjustment, run: Run) -> Adjustment:
    """The stages in which the cameras are fixed."""
    for named in run.point_stages.items():
        before, adjustment = adjustment, through([named], adjustment, run, _ROUGHLY if run.to_rounding else 0.0)
        if run.to_rounding:
            adjustment = _finished(adjustment, run, named, before.state, polished)
    return adjustment


def measured(frames: CommonFrames, config: Config) -> Measurements:
    """The keypoints that take part, as detected."""
    precision = torch.float32 if config.precision == "float32" else torch.float64
    return Measurements.of(frames.observations, points_used(frames.observations, config), precision)


def points_used(observations: Observations, config: Config) -> list[int] | None:
    """The points that take part; None for all."""
    ends = {end for stick in observations.sticks for end in stick.ends}
    if config.points == "sticks":
        return sorted(ends)
    if config.points == "joints":
        return [point for point in range(observations.num_points) if point not in ends]
    return None


def _with_last_camera_stage(adjustment: Adjustment, run: Run) -> Adjustment:
    """After the last stage that estimates cameras, with clocks and noise that agree with what it found."""
    *_, last = run.camera_stages.items()
    least = 0.0
    if run.settles and not adjustment.asynchronous:
        least = _NEARLY if last[1].reject_sigmas is None and not run.to_rounding else _ROUGHLY
    return _settled(_synchronised(through([last], adjustment, run, least), run), run)


def _settled(adjustment: Adjustment, run: Run) -> Adjustment:
    """With the noise as it is found where the last camera stage has ended, if that stage takes it from the data.

    Where no such state is found near, the stage is first run to its end.
    """
    if not run.settles:
        return adjustment
    *_, last = run.camera_stages.items()
    return _finished(adjustment, run, last, adjustment.state, settled)


def _finished(
    adjustment: Adjustment,
    run: Run,
    named: tuple[str, Stage],
    begin_at: State,
    finish: Callable[[str, Measurements, StageResult, Run], tuple[StageResult, Tensor]],
) -> Adjustment:
    """With the last stage taken to where a function takes it.

    Args:
        adjustment: sessions that have come near that.
        run: what all steps share.
        named: the last stage.
        begin_at: where the stage begins again, for sessions in which the function has not found what it looks for.
        finish: the function; it also says in which sessions it has found it.
    """
    name, stage = named
    result, found = finish(name, adjustment.measurements, adjustment.last, run)
    earlier = adjustment.results[:-1]
    finished = replace(adjustment, state=result.state, results=(*earlier, result))
    if bool(found.all()):
        return finished
    ended = run_stage(name, stage, adjustment.measurements, begin_at, run)
    result, _ = finish(name, adjustment.measurements, ended, run)
    return replace(adjustment, results=earlier).ended(result).replaced(found, finished)


def _relabelling(stages: Sequence[tuple[str, Stage]], begun: Adjustment, run: Run) -> Adjustment:
    """Sessions after their first stages, which are run again where label errors were found, until none are left."""
    ended = _on_the_right_side(stages[:1], through(stages, begun, run), run)
    for _ in range(_MAX_RELABELLINGS if run.config.relabel else 0):
        before = [ended[session] for session in range(ended.seen.sessions)]
        after = [relabelled(session, run) for session in before]
        changed = torch.tensor(
            [new is not old for new, old in zip(after, before, strict=True)], device=ended.state.points.device
        )
        if not changed.any():
            break
        ended = through(stages, Adjustment.stack(after), run).replaced(~changed, ended)
    return ended


def _on_the_right_side(stages: Sequence[tuple[str, Stage]], ended: Adjustment, run: Run) -> Adjustment:
    """Sessions after some stages, or after the same from reversed depths where the views then clearly fit together better.

    Images of a distant scene look almost alike if its depths are reversed (Necker's cube). With large errors the start may be
    on the wrong side, and an adjustment does not leave it. A scene that fits much better than its reverse is none.
    """
    m, reverse = ended.measurements, ended.state.depth_reversed(ended.measurements.active)
    squared = small_squared_residuals(m, ended.state)
    alike = small_squared_residuals(m, reverse) < _ALIKE * squared
    if not bool(alike.any()):
        return ended
    exact = [(name, replace(stage, cost_tolerance=min(stage.cost_tolerance, _EXACT))) for name, stage in stages]

    def again(state: State) -> Adjustment:
        return through(exact, replace(ended, state=state, results=(), records=((),) * ended.seen.sessions), run)

    others = again(reverse)
    squared_elsewhere = small_squared_residuals(m, others.state)
    closer = squared_elsewhere < squared
    if not bool((alike & closer).any()):
        return ended
    better = alike & closer & (squared_elsewhere < _CLEARLY_LESS * small_squared_residuals(m, again(ended.state).state))
    return ended.replaced(better, others) if bool(better.any()) else ended


def relabelled(adjustment: Adjustment, run: Run) -> Adjustment:
    """One session with its label errors undone; the same object where there are none."""
    began = time.perf_counter()
    frames, given = adjustment.frames[0], adjustment.measurements

    def seen_with(labels: Labels) -> Measurements:
        fresh = measured(replace(frames, observations=labels.applied(frames.observations)), run.config)
        return replace(adjustment.seen, pixels=fresh.pixels, confidence=fresh.confidence)

    def measured_with(labels: Labels) -> Measurements:
        again = replace(adjustment, labels=labels)
        return again.exposures.unmoved(seen_with(labels)) if given.unknowns.clocked else seen_with(labels)

    labels, measurements, state = mended(adjustment.labels, given, adjustment.state, measured_with)
    run.took(_RELABEL, time.perf_counter() - began)
    if labels is adjustment.labels:
        return adjustment
    return replace(adjustment, seen=seen_with(labels), measurements=measurements, state=state, labels=labels)


def _synchronised(adjustment: Adjustment, run: Run) -> Adjustment:
    """Where keypoints were not all exposed together: the last stage again and again, until clocks and motion agree."""
    if not adjustment.asynchronous:
        return adjustment
    *_, stage = run.camera_stages.values()

    def run_again(measurements: Measurements, state: State) -> StageResult:
        return run_stage(CLOCK_STAGE, stage, measurements, state, run)

    before = adjustment.measurements, adjustment.last
    measurements, result, records = synchronise_keypoints(adjustment.seen, adjustment.exposures, *before, run_again)
    together = tuple((*earlier, *own) for earlier, own in zip(adjustment.records, records, strict=True))
    return replace(adjustment, measurements=measurements, state=result.state, results=(result,), records=together)


def _state_of(start: WarmStart, seen: Measurements, config: Config) -> State:
    """An earlier estimate as a state; points that it does not have are triangulated."""
    rotations, translations, unknowns = (v[None].double() for v in (start.rotations, start.translations, start.unknowns))
    points = torch.full_like(seen.pixels[:, 0, :1].double().expand(-1, 3, -1), torch.nan)
    if start.points is not None:
        points = start.points.double().flatten(0, 1).mT[None]
    known = points.isfinite().all(1)
    points = points.nan_to_num()
    if bool((seen.active & ~known).any()):
        points = points.where(known[:, None], triangulated(seen, rotations, translations, config.initialise))
    return State(rotations, translations, points.contiguous(), unknowns)
