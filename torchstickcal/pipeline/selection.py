"""Model selection: at which time offsets, and with what unknown of its cameras, a session is adjusted."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from torchstickcal.errors import ObservationError, RigError
from torchstickcal.lazy import cached_property
from torchstickcal.model.measurements import Measurements, count_of
from torchstickcal.model.unknowns import REFINEMENTS, clock_refinements, with_refinements
from torchstickcal.observations import Observations
from torchstickcal.pipeline.adjust import adjust_again, adjust_cameras, begin, begin_at_nearest_frames, measured
from torchstickcal.pipeline.adjustment import Adjustment
from torchstickcal.pipeline.check import CameraCheck
from torchstickcal.pipeline.run import Run
from torchstickcal.pipeline.synchronise import ClockEstimate, clocks_unlike_given, on_common_frames, search_offsets
from torchstickcal.quality.handedness import MIRRORED_SHARE, mirrored_share

_MAX_STARTS = 3
_MOST_TRIALS = 3
"""Adjustments with more refined that ``auto`` tries."""
_BY_CHANCE = 1.1
"""Factor by which the median squared residual may grow where nothing has become worse."""
_FAR_FRAMES = 0.5
"""Remaining time offset, in frames, from which on a camera's frames are chosen anew. Offsets of nearly a frame are found too
small, so that the next frames have to be tried before they seem much closer."""
_CLEARLY_BETTER = 0.5
"""Median squared residual at other time offsets, relative to that at the given ones, up to which they are tried."""
_FITTING_SHARE, _FITTING_FOCAL_SHARE = 0.6, 0.01
"""Least fraction of inliers, and largest noise as a fraction of the focal length, of cameras that fit together."""
_CLEAR_SHARE, _CLEAR_FOCAL_SHARE = 0.8, 0.003
"""The same of cameras that were started from given poses and need no comparison with cameras that were not."""
_CLEARLY_LESS, _LESS = 0.5, 0.9
"""Squared residual, relative to another, from which on it is clearly less; and the same where something else speaks against the
other."""


class ModelSelection:
    """One session, adjusted at different time offsets and with different parameters of its cameras refined.

    Args:
        observations: the session.
        run: what all steps share.
        start: poses to start from, as of :func:`torchstickcal.pipeline.adjust.begin`.

    Raises:
        ObservationError: if the configuration names something to refine that the session does not allow.
    """

    def __init__(self, observations: Observations, run: Run, start: tuple[Tensor, Tensor] | None = None) -> None:
        self._observations, self._run, self._start = observations, run, start
        self._begun: dict[bool, Adjustment] = {}
        self.start_contradicted = False
        """whether the poses to start from were given up, because others fit the keypoints and they do not"""
        config = run.config
        self.named = () if config.refine == "auto" else tuple(config.refine)
        """what the configuration refines"""
        self.allowed = set(self.named)
        """what may be refined"""
        if config.refine == "auto":
            self.allowed = self._refinable if config.synchronise else self._refinable - clock_refinements()
        if impossible := set(self.named) - self._refinable:
            raise ObservationError(
                "clocks cannot be estimated without a frame rate",
                where="refine",
                got=", ".join(sorted(impossible)),
                expected="fps or timestamps, and for readout also image_size",
            )

    @cached_property
    def clocks_unlike_given(self) -> ClockEstimate | None:
        """The time offsets where the cameras' frames clearly do not belong together as given, by the motion in the images."""
        return clocks_unlike_given(*self._keypoints_and_reach) if "time_offset" in self._refinable else None

    @cached_property
    def _searched(self) -> ClockEstimate:
        """The time offsets, by the motion in the images."""
        return search_offsets(*self._keypoints_and_reach)

    def begun(self) -> Adjustment | None:
        """At the given time offsets, with the first estimate of rig and points; None where the cameras are no one rig there."""
        try:
            return self._begun_as_given()
        except RigError:
            return None

    def adjusted(
        self, clocks: ClockEstimate | None, first: Adjustment | None = None
    ) -> tuple[Adjustment, ClockEstimate | None]:
        """Adjusted at the time offsets at which the views fit together best, of those given and those searched for.

        Args:
            clocks: time offsets that were searched for. If there are none, and the cameras do not fit together at those given,
                they are searched for now.
            first: what has begun at the given time offsets, with its cameras adjusted; None to do that now.

        Returns:
            The adjustment with all that the configuration refines, and the time offsets that were searched for.

        Raises:
            RigError: if the cameras cannot be placed in one rig.
        """
        found, clocks = self._found(clocks, first)
        if self._start is not None and not any(_fits(one, _CLEAR_SHARE, _CLEAR_FOCAL_SHARE) for one in found):
            found, clocks = self._without_start(found, clocks)
        best = self._turned_back(min(found, key=_median_squared_residual) if len(found) > 1 else found[0])
        return best if set(self.named) <= set(best.refined) else self._with(best, self.named), clocks

    def _turned_back(self, found: Adjustment) -> Adjustment:
        """What was found or, where the athlete's right side is on the left in it, what is found from reversed depths.

        The latter only if it fits better, which it does not where the videos are mirrored.
        """
        m, names = found.measurements, found.observations[0].point_names
        points = m.by_frame(found.state.points[0].where(found.last.inliers[0].any(0), torch.nan))
        if mirrored_share(points, names) <= MIRRORED_SHARE:
            return found
        reverse = replace(found[0], state=found.state.depth_reversed(m.active))
        other = self._at_nearest_frames(adjust_cameras(reverse, self._run))
        better = _median_squared_residual(other) < _LESS * _median_squared_residual(found)
        return other if better and other.converged else found

    def _without_start(
        self, found: list[Adjustment], clocks: ClockEstimate | None
    ) -> tuple[list[Adjustment], ClockEstimate | None]:
        """What was found from the poses to start from or, where that is clearly better, what is found without them."""
        start, self._start = self._start, None
        try:
            others, own_clocks = self._found(clocks)
        except RigError:
            others, own_clocks = [], clocks
        least = min((_median_squared_residual(one) for one in found if one.converged), default=math.inf)
        clearly_less = (_median_squared_residual(other) < _CLEARLY_LESS * least for other in others if other.converged)
        self.start_contradicted = any(clearly_less)
        if self.start_contradicted:
            return others, own_clocks
        self._start = start
        return found, clocks

    def _found(
        self, clocks: ClockEstimate | None, first: Adjustment | None = None
    ) -> tuple[list[Adjustment], ClockEstimate | None]:
        """What was adjusted at all time offsets that were tried; arguments and errors as of :meth:`adjusted`."""
        found = [] if clocks is None else self._at_offsets(clocks)
        failure: RigError | None = None
        if not any(map(_fits, found)):
            try:
                first = first or adjust_cameras(self._begun_as_given(), self._run)
                found.append(self._at_nearest_frames(first))
            except RigError as error:
                failure = error
        if clocks is None and "time_offset" in self.allowed and not any(map(_fits, found)):
            clocks = self._searched
            found += self._at_offsets(clocks)
        if not found and failure is not None:
            raise failure
        return found, clocks

    def refined_where_contradicted(self, adjusted: Adjustment, check: CameraCheck) -> tuple[Adjustment, CameraCheck]:
        """Adjusted with what the keypoints contradict of the cameras, the most contradicted first, and checked again.

        What was found is kept only if it fits better and is still needed there: the check is about the first step, and the
        adjustment may end elsewhere. Where the given cameras do not converge, nothing more is estimated. Where clocks may be so
        far off that the check cannot say how far, the motion in the images does.
        """
        if not adjusted.converged:
            return adjusted, check
        if "time_offset" not in adjusted.refined and check.may_be_far_in_time(self.allowed):
            for offsets in self._searched.alternatives:
                elsewhere = adjust_cameras(begin_at_nearest_frames(adjusted, self._run, offsets), self._run, only_last=True)
                if (confirmed := self._confirmed(("time_offset",), self._at_nearest_frames(elsewhere), adjusted)) is not None:
                    adjusted, check = confirmed
                    break
        failed: list[tuple[str, ...]] = []
        for _ in range(_MOST_TRIALS):
            choice = check.wanted(self.allowed, adjusted.refined, failed)
            if not choice:
                break
            refined = self._with(adjusted, with_refinements(adjusted.refined, choice))
            if (confirmed := self._confirmed(choice, refined, adjusted)) is not None:
                adjusted, check = confirmed
            else:
                failed.append(refined.refined)
        return adjusted, check

    def _confirmed(
        self, choice: tuple[str, ...], refined: Adjustment, before: Adjustment
    ) -> tuple[Adjustment, CameraCheck] | None:
        """An adjustment with a choice refined, and its check; None if it does not fit better or the choice is not needed."""
        if not refined.converged or _median_squared_residual(refined) > _BY_CHANCE * _median_squared_residual(before):
            return None
        check = CameraCheck(refined, self._run.config.camera_groups)
        return (refined, check) if check.confirms(choice, refined.deviations) else None

    def _at_offsets(self, clocks: ClockEstimate) -> list[Adjustment]:
        """Adjusted at those of the offsets at which the views clearly fit together better than at the given times.

        A first adjustment says so soon.
        """
        given = self._first_residual(self._begun_as_given) if clocks.alternatives else 0.0
        found: list[Adjustment] = []
        for offsets in clocks.alternatives:
            if self._first_residual(partial(self._begun_at, self._named_lenses, offsets.round())) > _CLEARLY_BETTER * given:
                continue
            try:
                found.append(self._adjusted_at(with_refinements(self.named, ("time_offset",)), offsets))
            except (RigError, ObservationError):
                continue
        return found

    def _first_residual(self, begun: Callable[[], Adjustment]) -> float:
        """Median squared residual after the first stage from a beginning, square pixels; infinite where there is no rig."""
        config = self._run.config
        first = Run(replace(config, stages=dict(list(config.stages.items())[:1]), relabel=False))
        try:
            return _median_squared_residual(adjust_cameras(begun(), first))
        except (RigError, ObservationError):
            return math.inf

    @property
    def _named_lenses(self) -> list[str]:
        """What the configuration refines of the lenses."""
        return [name for name in self.named if name not in clock_refinements()]

    def _begun_as_given(self) -> Adjustment:
        """Initialised at the given time offsets, once for each start."""
        started = self._start is not None
        if started not in self._begun:
            self._begun[started] = self._begun_at(self._named_lenses)
        return self._begun[started]

    def _begun_at(self, refined: Sequence[str], offsets_frames: Tensor | None = None) -> Adjustment:
        """Initialised at some time offsets (C,) of the cameras, in frames; None for those given."""
        return begin(self._observations, self._run, refined, offsets_frames, poses=self._start)

    def _adjusted_at(self, refined: Sequence[str], offsets_frames: Tensor) -> Adjustment:
        """Initialised and adjusted at some time offsets (C,) of the cameras, in frames."""
        return self._at_nearest_frames(adjust_cameras(self._begun_at(refined, offsets_frames), self._run))

    def _with(self, adjustment: Adjustment, refined: Sequence[str]) -> Adjustment:
        """Adjusted from where an adjustment has ended, with more refined."""
        return self._at_nearest_frames(adjust_again(adjustment, self._run, refined))

    def _at_nearest_frames(self, adjustment: Adjustment) -> Adjustment:
        """Adjusted anew with other frames, where the estimated time offsets say that those are closer in time, and they are."""
        for _ in range(_MAX_STARTS - 1):
            if not bool((adjustment.remaining_offsets_frames.abs() > _FAR_FRAMES).any()):
                break
            again = adjust_cameras(begin_at_nearest_frames(adjustment, self._run), self._run, only_last=True)
            if _median_squared_residual(again) > _BY_CHANCE * _median_squared_residual(adjustment):
                break
            adjustment = again
        return adjustment

    @property
    def _keypoints_and_reach(self) -> tuple[Measurements, float]:
        """The keypoints at the times given, and the largest time offset that is looked for, in frames."""
        frames = on_common_frames(self._observations)
        assert frames.rate_hz is not None
        return measured(frames, self._run.config), self._run.config.max_offset_s * frames.rate_hz

    @property
    def _refinable(self) -> set[str]:
        """What the session allows: clocks are counted in frames per second, read-out times in rows of the image."""
        given = self._observations
        names = set(REFINEMENTS) - clock_refinements()
        if given.fps is not None or given.timestamps is not None:
            names |= clock_refinements() if given.image_size is not None else {"time_offset"}
        return names


def _fits(
    adjustment: Adjustment, least_share: float = _FITTING_SHARE, largest_focal_share: float = _FITTING_FOCAL_SHARE
) -> bool:
    """Whether the cameras agree with one another as those of one scene do."""
    share = count_of(adjustment.last.inliers).sum() / count_of(adjustment.measurements.visible).sum()
    noise = adjustment.last.sigma_px.median() / adjustment.measurements.cameras.focal_px.mean()
    return adjustment.converged and float(share) > least_share and float(noise) < largest_focal_share


def _median_squared_residual(adjustment: Adjustment) -> float:
    """Of all keypoints, inliers and outliers, square pixels."""
    squared = adjustment.measurements.squared_residuals(adjustment.state)
    return float(squared[adjustment.measurements.visible].median())
