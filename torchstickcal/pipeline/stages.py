"""Stages one after another, each repeated until it no longer changes how much the keypoints of a point count.

Errors that last are hidden in the cameras, as long as points with such errors determine them.
"""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

from torchstickcal.config import Stage
from torchstickcal.model.measurements import Measurements
from torchstickcal.pipeline.adjustment import Adjustment
from torchstickcal.pipeline.noise import correlation_for_weights
from torchstickcal.pipeline.run import Run
from torchstickcal.pipeline.stage import run_stage

_MOST_ROUNDS = 6
_SETTLED = 0.1
"""Relative change of the numbers of keypoints that count as one, below which a stage need not be repeated with new ones."""
_LASTING_FRAMES, _CLEARLY_SHORTER, _ROUNDS_BY_ENDS = 3.0, 0.5, 2
"""As many keypoints of a stick's end as count as one, from which on its errors seem to last; the ratio of two such numbers that
is clearly less than 1; and for how many rounds the ends are trusted alone. After the first, their noise is known."""


def through(stages: Iterable[tuple[str, Stage]], adjustment: Adjustment, run: Run, least: float = 0.0) -> Adjustment:
    """After some stages. One in which keypoints count as fewer is repeated, until what they count no longer changes.

    Errors that last are hidden in the cameras, as long as points with such errors determine them. Cameras that joints have
    deceived contradict the sticks, whose ends then seem to err in the same way for long. So where they do, the stage is also
    begun from the ends alone, and where their errors last clearly less from there, that is right.
    """
    for name, stage in stages:
        begun, adjustment = adjustment, _repeated(name, stage, adjustment, run, least)
        lasting = _of_ends(adjustment.last.correlation_frames, adjustment.measurements)
        if stage.cameras == "free" and _estimated(adjustment) and bool((lasting > _LASTING_FRAMES).any()):
            adjustment = _by_ends_where_right(name, stage, begun, adjustment, run, least)
    return adjustment


def _repeated(
    name: str, stage: Stage, adjustment: Adjustment, run: Run, least: float, times: Tensor | None = None
) -> Adjustment:
    """After one stage, which is repeated until what keypoints count no longer changes; arguments as of :func:`run_stage`."""
    adjustment = adjustment.ended(run_stage(name, stage, adjustment.measurements, adjustment.state, run, least, times))
    before, found = torch.ones_like(adjustment.last.correlation_frames), adjustment.last.correlation_frames
    for _ in range(_MOST_ROUNDS - 1 if _estimated(adjustment) else 0):
        unchanged = ((found / before).log().abs() < _SETTLED).flatten(1).all(1)
        if bool(unchanged.all()):
            break
        again = adjustment.ended(run_stage(name, stage, adjustment.measurements, adjustment.state, run, least, times))
        adjustment = again.replaced(unchanged, adjustment)
        before, found = found, adjustment.last.correlation_frames
    return adjustment


def _by_ends_where_right(name: str, stage: Stage, begun: Adjustment, ended: Adjustment, run: Run, least: float) -> Adjustment:
    """After one stage, with the sessions in which the ends of the sticks are to be trusted begun from these alone.

    It is begun as if the errors of the ends were independent, and those of all other points always the same. Then it is
    repeated with what the others are found to count, and once with what the ends are found to count, too.

    Args:
        name: of the stage.
        stage: its settings.
        begun: where it began.
        ended: where it has ended, with the errors of some ends that last.
        run: what all steps share.
        least: as of :func:`run_stage`.
    """
    m = begun.measurements
    before = _of_ends(ended.last.correlation_frames, m).amax(1)

    def shorter(times: Tensor) -> Tensor:
        return (before > _LASTING_FRAMES) & (_of_ends(times, m).amax(1) < _CLEARLY_SHORTER * before)

    times = begun.state.points.new_full((m.sessions, m.points_per_frame), float(m.frames))
    times[:, m.sticks.flatten()] = 1.0
    other = begun
    for _ in range(_ROUNDS_BY_ENDS):
        other = other.ended(run_stage(name, stage, m, other.state, run, least, times))
    found = correlation_for_weights(other.kept, other.last.minimum, other.last.sigma_px)
    if not bool(shorter(found.times).any()):
        return ended
    other = _repeated(name, stage, other, run, least, times.where(times == 1.0, torch.nan))
    other = other.ended(run_stage(name, stage, m, other.state, run, least))
    return ended.replaced(shorter(other.last.correlation_frames), other)


def _estimated(adjustment: Adjustment) -> bool:
    """Whether the last stage has estimated what keypoints count."""
    return adjustment.last.gates.correlation is not None


def _of_ends(times: Tensor, m: Measurements) -> Tensor:
    """Of numbers (B, P) those of the ends of sticks, (B, 2 S); (B, 0) if there are no other points."""
    ends = m.sticks.flatten()
    return times[:, ends] if len(set(ends.tolist())) < times.shape[1] else times[:, :0]
