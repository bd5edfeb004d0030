"""Causes, found by trial: the rig without a camera, and this camera again as it would be under each explanation."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from torchstickcal.config import Config
from torchstickcal.errors import CalibrationError, ObservationError
from torchstickcal.geometry import se3
from torchstickcal.geometry.cameras import Intrinsics
from torchstickcal.metrics import rotation_angle
from torchstickcal.observations import Observations
from torchstickcal.pipeline.adjust import adjust_cameras, begin
from torchstickcal.pipeline.adjustment import Adjustment
from torchstickcal.pipeline.run import Run
from torchstickcal.quality.evidence import Evidence
from torchstickcal.quality.resection import AGREEING_SIGMAS, LEAST_REACH, Resection, at_later_frames, resected

_TRIAL_ITERATIONS = 20
"""Iterations of a stage of a trial at most: one that needs more explains nothing."""
_SCALES = (1 / 3, 0.5, 2 / 3, 0.75, 4 / 3, 1.5, 2.0, 3.0)
"""Ratios of resolutions that videos are commonly converted by."""
_LEAST_OF_PLACES, _GAIN_OF_PLACES, _RATIO_OF_PLACES = 0.45, 0.1, 1.25
"""Share of a camera's keypoints that agree with it at two places, one before and one after some frame: the least, and over that
at one place. Or half of those that contradict it at one place agree."""
_PARTS, _PART_FRAMES = 16, 3
"""Parts of a session in which a camera that moves all the time is placed, and their frames."""
_LARGEST_SHIFT_S = 1.0
_COARSE_SHIFTS = 12


class Sight(NamedTuple):
    """Keypoints and intrinsics of one camera."""

    keypoints: Tensor
    """(F, P, 2), pixels"""
    camera: Intrinsics
    """of one camera"""
    size: Tensor | None
    """(2,), of its images"""


@dataclass(frozen=True)
class Hypothesis:
    """What may be wrong with one camera.

    Args:
        code: of the finding.
        what: what it means, after the name of the camera.
        advice: one sentence.
        changed: gives the camera as it would be if this were so.
    """

    code: str
    what: str
    advice: str
    changed: Callable[[Sight], Sight]


def hypotheses() -> Iterator[Hypothesis]:
    """What may be wrong with one camera, the simplest first."""
    yield Hypothesis(
        "camera_mirrored",
        "its video is mirrored: with left and right exchanged its keypoints agree",
        "Mirror its keypoints, x to width - 1 - x, or record it again without mirroring.",
        _mirrored,
    )
    yield Hypothesis(
        "intrinsics_turned",
        "its intrinsics are those of a video turned by 90 degrees: with the coordinates of the centre exchanged its keypoints "
        "agree",
        "Give the intrinsics of the video as the detector saw it.",
        _turned,
    )
    for scale in _SCALES:
        yield Hypothesis(
            "intrinsics_other_resolution",
            f"its intrinsics are those of another resolution: with all of them times {scale:.3g} its keypoints agree",
            "Give the intrinsics of the resolution that the detector saw.",
            _scaled(scale),
        )


def _mirrored(sight: Sight) -> Sight:
    width = 2 * sight.camera.matrix[0, 0, 2] + 1 if sight.size is None else sight.size[0]
    keypoints = sight.keypoints.clone()
    keypoints[..., 0] = width - 1 - keypoints[..., 0]
    return sight._replace(keypoints=keypoints)


def _turned(sight: Sight) -> Sight:
    matrix = sight.camera.matrix.clone()
    matrix[:, 0, 2], matrix[:, 1, 2] = sight.camera.matrix[:, 1, 2], sight.camera.matrix[:, 0, 2]
    matrix[:, 0, 0], matrix[:, 1, 1] = sight.camera.matrix[:, 1, 1], sight.camera.matrix[:, 0, 0]
    return sight._replace(camera=replace(sight.camera, matrix=matrix))


def _scaled(scale: float) -> Callable[[Sight], Sight]:
    def changed(sight: Sight) -> Sight:
        factor = torch.ones_like(sight.camera.matrix)
        factor[:, :2] = scale
        return sight._replace(camera=replace(sight.camera, matrix=sight.camera.matrix * factor))

    return changed


@dataclass(frozen=True)
class Rest:
    """The rig without one camera, calibrated by itself.

    Args:
        adjustment: of the other cameras.
        points: (3, F, P), metres; NaN where fewer than two of the others see a point.
        sigma_px: (P,), noise of each point's keypoints.
    """

    adjustment: Adjustment
    points: Tensor
    sigma_px: Tensor

    @property
    def share(self) -> float:
        """Share of the other cameras' keypoints that agree with each other."""
        kept, seen = self.adjustment.kept.visible.sum(), self.adjustment.measurements.visible.sum()
        return float(kept / seen.clamp_min(1))

    @property
    def noise_mrad(self) -> float:
        """Median noise of their keypoints, as an angle."""
        return 1000 * float(self.sigma_px.median() / self.adjustment.measurements.cameras.focal_px.mean())

    def placed(self, sight: Sight, frames: slice = slice(None), later: int = 0) -> tuple[Resection, Tensor] | None:
        """A camera placed by the points of the others, and which keypoints (F, P) that is about; None where no place fits.

        Args:
            sight: the camera.
            frames: that count.
            later: frames by which the camera's frames belong to later ones of the others.
        """
        points = at_later_frames(self.points, later)
        usable = points.isfinite().all(0) & sight.keypoints.isfinite().all(-1)
        chosen = torch.zeros_like(usable)
        chosen[frames] = usable[frames]
        sigma = self.sigma_px.expand(usable.shape)[chosen]
        placed = resected(points[:, chosen], sight.keypoints[chosen].mT, sigma, sight.camera)
        return None if placed is None else (placed, chosen)


def without(evidence: Evidence, camera: int) -> Rest | None:
    """The rig without a camera; None where the others are no rig by themselves."""
    others = [other for other in range(evidence.cameras) if other != camera]
    if len(others) < 2:
        return None
    groups = evidence.config.camera_groups
    config = replace(evidence.config, camera_groups=[groups[other] for other in others] if groups else [])
    observations = evidence.ended.labels.applied(evidence.observations) if evidence.synchronous else evidence.observations
    try:
        ended = tried(observations.of_cameras(others), config, evidence.ended.refined)
    except ObservationError:  # the others do not see a stick
        return None
    if ended is None:
        return None
    known = ended.kept.active[0]
    points = ended.measurements.by_frame(ended.state.points[0].where(known, torch.nan))
    return Rest(ended, points, ended.last.sigma_px[0])


def tried(
    observations: Observations, config: Config, refined: tuple[str, ...], must_converge: bool = False
) -> Adjustment | None:
    """A session adjusted in few iterations without anybody listening; None where its cameras are no rig, or do not converge."""
    stages = {
        name: replace(stage, max_iterations=min(stage.max_iterations, _TRIAL_ITERATIONS))
        for name, stage in config.stages.items()
    }
    run = Run(replace(config, stages=stages, solver="gauss_newton"), must_converge=must_converge)
    try:
        return adjust_cameras(begin(observations, run, refined), run)
    except CalibrationError:
        return None


def sight_of(evidence: Evidence, camera: int) -> Sight:
    """One camera as it was given, without keypoints at exactly (0, 0)."""
    observations = evidence.observations
    size = observations.image_size
    return Sight(
        evidence.keypoints_of(camera),
        observations.cameras[camera : camera + 1],
        None if size is None else (size if size.ndim == 1 else size[camera]),
    )


def shifted_share(rest: Rest, sight: Sight, rate_hz: float | None) -> tuple[int, float]:
    """The number of frames by which a camera's frames belong to later ones of the others, and the share that then agrees."""
    frames = rest.points.shape[1]
    most = min(frames // 2, math.ceil(_LARGEST_SHIFT_S * rate_hz) if rate_hz else frames // 2)
    step = max(1, most // _COARSE_SHIFTS)
    best, share = 0, 0.0
    for width in (step, 1) if step > 1 else (1,):
        around = range(-most, most + 1, step) if width == step else range(best - step, best + step + 1)
        for later in around:
            placed = rest.placed(sight, later=later)
            if placed is not None and placed[0].share > share:
                best, share = later, placed[0].share
    return best, share


def moved_within(rest: Rest, sight: Sight) -> tuple[int, Resection, Resection] | None:
    """A camera that moved far: the first frame after it, and its places before and after; None where it did not."""
    frames = rest.points.shape[1]
    third = max(1, frames // 3)
    start, end = rest.placed(sight, slice(0, third)), rest.placed(sight, slice(frames - third, frames))
    if start is None or end is None:
        return None
    usable = rest.points.isfinite().all(0) & sight.keypoints.isfinite().all(-1)
    agree = [_agreeing(placed[0], rest, sight, usable).sum(-1).double() for placed in (start, end)]
    gain = torch.nn.functional.pad((agree[0] - agree[1]).cumsum(0), (1, 0))
    frame = int(gain.argmax())
    total = usable.sum()
    share = float((agree[0][:frame].sum() + agree[1][frame:].sum()) / total.clamp_min(1))
    single = max(float(one.sum() / total.clamp_min(1)) for one in agree)
    least = max(_LEAST_OF_PLACES, single + _GAIN_OF_PLACES, min(_RATIO_OF_PLACES * single, (1 + single) / 2))
    if not third // 2 < frame < frames - third // 2 or share < least:
        return None
    before, after = rest.placed(sight, slice(0, frame)), rest.placed(sight, slice(frame, frames))
    return None if before is None or after is None else (frame, before[0], after[0])


class Moving(NamedTuple):
    """A camera that was placed anew in short parts of the session."""

    share: float
    """of its keypoints in these parts that agree with the others"""
    angle_deg: float
    """largest angle between two of its places"""
    spread_m: float
    """median distance of its places from their middle"""


def moving_throughout(rest: Rest, sight: Sight) -> Moving | None:
    """A camera, placed anew in some parts of a session in which one that follows the athlete hardly turns; None where it can be
    placed in few of them."""
    frames = rest.points.shape[1]
    starts = torch.linspace(0, max(0, frames - _PART_FRAMES), min(_PARTS, frames // _PART_FRAMES)).long().tolist()
    places = [found[0] for start in starts if (found := rest.placed(sight, slice(start, start + _PART_FRAMES))) is not None]
    if len(places) < _PARTS // 2:
        return None
    agreeing = torch.cat([place.agreeing for place in places])
    rotations = torch.stack([place.rotation for place in places])
    centres = se3.camera_centres(rotations, torch.stack([place.translation for place in places]))
    angles = rotation_angle(rotations[:, None] @ rotations[None].mT).rad2deg()
    spread = (centres - centres.median(0).values).norm(dim=-1).median()
    return Moving(float(agreeing.double().mean()), float(angles.max()), float(spread))


def _agreeing(placed: Resection, rest: Rest, sight: Sight, usable: Tensor) -> Tensor:
    """(F, P), the keypoints that agree with a camera at some place."""
    in_camera = torch.einsum("ij,jfp->fpi", placed.rotation, rest.points) + placed.translation
    pixels = sight.camera.project(in_camera.nan_to_num().flatten(0, 1)[None])[0].view(*usable.shape, 2)
    reach = (AGREEING_SIGMAS * rest.sigma_px).clamp_min(LEAST_REACH * float(sight.camera.focal_px.mean()))
    near = (pixels - sight.keypoints).norm(dim=-1) < reach
    return near & usable & (in_camera[..., 2] > 0)
