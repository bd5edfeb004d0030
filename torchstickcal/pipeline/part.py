"""A long session begins with a part of its frames: some thousand frames tell nearly as well as an hour where the cameras are.

The part goes through all stages. From its cameras, the points of all frames are found, and the last two stages that estimate
cameras are run with everything: they decide of every keypoint whether it takes part, and end at the same minimum.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from torchstickcal.errors import ObservationError, RigError
from torchstickcal.model.measurements import are_many
from torchstickcal.model.trajectories import WINDOW_FRAMES
from torchstickcal.model.unknowns import clock_refinements
from torchstickcal.observations import Observations
from torchstickcal.pipeline.adjust import adjust_cameras, begin
from torchstickcal.pipeline.adjustment import Adjustment, WarmStart
from torchstickcal.pipeline.run import Run
from torchstickcal.pipeline.selection import ModelSelection
from torchstickcal.pipeline.stages import through
from torchstickcal.pipeline.start import Poses

_PART_KEYPOINTS = 200_000
_RUN_FRAMES = 100
"""Frames of the part that follow each other, so that motion is seen."""
_LEAST_TIMES_LONGER = 2
"""So many times as many frames a session must have as the part, for the part to be worth its time."""
_ROUGHLY = 1e-2
"""Relative decrease of the cost from which on the stage before the last is near enough to its end."""
_FARTHER = 1.1
"""Reprojection error of a camera where that stage began, over that where it ended, from which on its start was not near. Some
of its decisions may be wrong then."""


def adjusted_from_part(models: ModelSelection, observations: Observations, run: Run, start: Poses | None) -> Adjustment | None:
    """A session with its cameras adjusted, from where a part of its frames has ended.

    Args:
        models: what may be estimated of the session.
        observations: the session.
        run: what all steps share.
        start: poses to start from, as of :func:`torchstickcal.pipeline.adjust.begin`.

    Returns:
        None where the session is not long, where its clocks or intrinsics are in question, and where the part does not tell
        enough. All frames are needed then from the beginning.
    """
    if len(run.camera_stages) < 2 or models.allowed & clock_refinements() or not observations.intrinsics_known:
        return None
    if observations.timestamps is not None or observations.readout_s or not are_many(observations.visible.numel()):
        return None
    few = part_of(observations)
    if _LEAST_TIMES_LONGER * few.num_frames > observations.num_frames:
        return None
    try:
        of_part = ModelSelection(few, run, start)
        part, _ = of_part.adjusted(None)
    except (RigError, ObservationError):
        return None
    if of_part.start_contradicted or not part.converged:
        return None
    sigma_px = part.last.sigma_px[0]
    cameras = part.state.rotations[0], part.state.translations[0]
    found = WarmStart(*cameras, points=None, unknowns=part.state.unknowns[0], inliers=None, sigma_px=sigma_px)
    *_, before_last, _ = run.camera_stages.items()
    whole = through([before_last], begin(observations, run, part.refined, start=found), run, _ROUGHLY)
    if not _began_near(whole):
        return None
    whole = adjust_cameras(whole, run, only_last=True)
    return replace(whole, records=(part.records[0] + whole.records[0],))


def part_of(observations: Observations) -> Observations:
    """Runs of frames, spread evenly over those frames in which points are seen, with frames between them in which none are.

    So nothing that looks at motion sees any from one run to the next.
    """
    seen = (observations.visible.sum(0) >= 2).sum(1).cumsum(0)
    count = -(-_PART_KEYPOINTS // (observations.num_cameras * observations.num_points * _RUN_FRAMES))
    middles = torch.searchsorted(seen, (torch.arange(count, device=seen.device) + 0.5) / count * seen[-1])
    length = min(_RUN_FRAMES, observations.num_frames)
    starts = (middles - length // 2).clamp(0, observations.num_frames - length)
    frames = (starts[:, None] + torch.arange(length, device=seen.device)).flatten().unique()
    runs = frames.tensor_split((frames.diff() > 1).nonzero()[:, 0].cpu() + 1)
    unseen = frames.new_full((WINDOW_FRAMES + 1,), -1)
    frames = torch.cat([part for run in runs for part in (run, unseen)])

    def of(values: Tensor, fill: float) -> Tensor:
        return values[:, frames.clamp_min(0)].masked_fill((frames < 0).view(-1, *[1] * (values.ndim - 2)), fill)

    confidence = observations.confidence
    return replace(
        observations,
        keypoints=of(observations.keypoints, torch.nan),
        confidence=None if confidence is None else of(confidence, 0.0),
    )


def _began_near(adjustment: Adjustment) -> bool:
    """Whether the last stage began near where it ended, by the reprojection errors of all cameras."""
    iterations = adjustment.last.records[0].iterations
    both = iterations[0].reprojection_px, iterations[-1].reprojection_px
    return all(before <= _FARTHER * after for before, after in zip(*both, strict=True))
