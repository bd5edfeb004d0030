"""Points of another recording by cameras that were calibrated before, with the robustness of a calibration."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor

from torchstickcal.config import Config, Stage, load_config
from torchstickcal.geometry.singular import covariance_of
from torchstickcal.losses import FrameLoss, TrackLoss
from torchstickcal.model.state import State
from torchstickcal.model.unknowns import RigUnknowns
from torchstickcal.observations import Observations
from torchstickcal.pipeline.adjust import measured, relabelled
from torchstickcal.pipeline.adjustment import Adjustment
from torchstickcal.pipeline.conclude import keypoint_index, residuals_of
from torchstickcal.pipeline.initialise import triangulated
from torchstickcal.pipeline.relabel import Labels
from torchstickcal.pipeline.run import Run
from torchstickcal.pipeline.stage import run_stage
from torchstickcal.pipeline.stages import through
from torchstickcal.pipeline.start import cameras_of
from torchstickcal.pipeline.synchronise import clocks_unlike_given, on_common_frames
from torchstickcal.quality.evidence import Evidence
from torchstickcal.quality.findings.keypoints import keypoints as keypoint_findings
from torchstickcal.reconstruction import Reconstruction
from torchstickcal.result import Calibration
from torchstickcal.solvers import Listener, ignore_record
from torchstickcal.solvers.elimination.normal_equations import NormalEquations
from torchstickcal.solvers.uncertainty import likelihood, point_covariances
from torchstickcal.workers import on_worker
from torchstickcal.world import World

if TYPE_CHECKING:
    from collections.abc import Mapping

    from torchstickcal.io.rig import Rig

_ROBUST, _SMOOTH = "points", "trajectories"
"""Names of the stages."""
_CLOCK_ROUNDS = 10
_CLOCK_STEP = 0.003
"""Change of the time offsets, in frames, below which they are found."""
_CLOCK_SIGMAS, _CLOCK_FRAMES = 4.0, 0.02
"""Standard deviations, and frames, from which on a time offset is taken for one."""
_FAR_FRAMES = 0.75
_STARTS = 3


def triangulate(
    observations: Observations,
    calibration: Calibration | Rig,
    config: str | Path | Mapping[str, Any] | Config = "default",
    turned: str | None = None,
    listener: Listener = ignore_record,
) -> Reconstruction:
    """Find the points of a recording, in metres, with cameras that were calibrated before and have not been moved since.

    Keypoints that contradict the other cameras are set aside, label errors are undone, time offsets are found where the cameras
    do not run together, and trajectories are smoothed, as by :func:`torchstickcal.calibrate`. The lengths of sticks are not
    used. So they are an independent check of the calibration.

    Args:
        observations: the recording. Its intrinsics are replaced by those of the calibration.
        calibration: the cameras: matched by name, else by the last number in the names, else by order; without names by order.
        config: as of :func:`torchstickcal.calibrate`. ``points``, ``precision``, ``relabel``, ``synchronise`` and the last
            stage with ``cameras = "held"`` count.
        turned: how images were turned after the calibration: ``left``, ``right`` (a quarter, as a viewer sees it) or ``back``.
        listener: called after each iteration of the stages ``points`` and ``trajectories``.

    Raises:
        CalibrationError: if a camera is missing, or the calibration has no poses in a known unit.
        ConfigError: if the configuration cannot be used.
        ObservationError: if no two cameras have a frame in common.

    Example:
        >>> from torchstickcal import calibrate
        >>> from torchstickcal.simulate import golf_session
        >>> observations, truth = golf_session(cameras=3, frames=30)
        >>> calibration = calibrate(observations)
        >>> swing, truth = golf_session(cameras=3, frames=20)
        >>> reconstruction = triangulate(swing, calibration.in_world("athlete"))
        >>> reconstruction.points.shape, reconstruction.world.name
        (torch.Size([20, 21, 3]), 'athlete')
    """
    from torchstickcal.io.lenses import arranged, lenses_of, matched

    rig = cameras_of(calibration, "calibration")
    size, count = observations.image_size, observations.num_cameras
    images = None if size is None else size.double().cpu().expand(count, 2)
    covariance = _covariance(calibration, matched(rig.names, observations.camera_names)[0])
    rig, notes = arranged(rig, observations.camera_names, images, turned)
    lenses, _ = lenses_of(rig, rig.names, None)
    given = replace(
        observations,
        intrinsics=lenses.intrinsics,
        distortion=lenses.distortion,
        fisheye=lenses.fisheye,
        image_size=lenses.image_size,
        intrinsics_known=True,
        readout_s=_readout(calibration, observations, lenses.image_size),
    )
    device = observations.keypoints.device
    rotations, translations = (part.to(device) for part in rig.poses())
    world = calibration.world if isinstance(calibration, Calibration) else rig.world
    run = Run(load_config(config), listener)
    found = on_worker(device, _reconstructed, given, (rotations, translations), covariance.to(device), run)
    return replace(found, world=world or found.world, warnings=(*notes, *found.warnings), sticks=observations.sticks)


def _covariance(calibration: Calibration | Rig, order: list[int]) -> Tensor:
    """Covariance of the tangents of cameras in an order, relative to the first of them; zero where nothing is known of it."""
    if not isinstance(calibration, Calibration):
        size = 6 * (len(order) - 1)
        return torch.zeros(size, size, dtype=torch.float64)
    blocks = torch.nn.functional.pad(calibration.covariance.cpu(), (6, 0, 6, 0)).unflatten(0, (-1, 6)).unflatten(2, (-1, 6))
    blocks = blocks[order][:, :, order]
    relative = blocks - blocks[:1] - blocks[:, :, :1] + blocks[:1, :, :1]
    return relative[1:, :, 1:].flatten(2, 3).flatten(0, 1)


def _readout(calibration: Calibration | Rig, observations: Observations, image_size: Tensor | None) -> float | None:
    """The read-out time: as given, else as the calibration has found it."""
    timed = image_size is not None and (observations.fps is not None or observations.timestamps is not None)
    if observations.readout_s is not None or not isinstance(calibration, Calibration) or not timed:
        return observations.readout_s
    found = calibration.unknowns["readout"]
    return max(0.0, float(found.value.mean())) if found.refined or bool(found.given.any()) else None


class _Clocks(NamedTuple):
    offsets_frames: Tensor
    """(C,), beyond those at which the frames were chosen"""
    std_frames: Tensor
    """(C,)"""


def _reconstructed(observations: Observations, poses: tuple[Tensor, Tensor], covariance: Tensor, run: Run) -> Reconstruction:
    config = run.config
    robust, smooth = _stages(config)
    timed = config.synchronise and (observations.fps is not None or observations.timestamps is not None)
    offsets: Tensor | None = None
    if timed:
        frames = on_common_frames(observations)
        assert frames.rate_hz is not None
        seen, reach = measured(frames, config), config.max_offset_s * frames.rate_hz
        if (other := clocks_unlike_given(seen, reach)) is not None:
            offsets = other.likeliest_frames.to(observations.keypoints.device)
    adjusted, clocks = _placed(observations, poses, run, robust, covariance, offsets, timed)
    for _ in range(_STARTS - 1):
        if clocks is None or not bool((clocks.offsets_frames.abs() > _FAR_FRAMES).any()):
            break
        offsets = adjusted.frames[0].offsets_frames + clocks.offsets_frames
        adjusted, clocks = _placed(observations, poses, run, robust, covariance, offsets, timed)
    if clocks is not None:
        adjusted = _at(adjusted, clocks.offsets_frames)
        adjusted = through([(_ROBUST, robust)], replace(adjusted, results=(), records=((),)), run)
    if smooth is not None:
        adjusted = through([(_SMOOTH, smooth)], adjusted, run)
    return _concluded(adjusted, clocks, covariance, run)


def _stages(config: Config) -> tuple[Stage, Stage | None]:
    """The stages: without and with smoothness. The lengths of sticks take part in neither."""
    held = [stage for stage in config.stages.values() if stage.cameras == "held"]
    last = held[-1] if held else load_config().stages[_SMOOTH]
    points = {name: loss for name, loss in last.losses.items() if not issubclass(loss.loss, FrameLoss)}
    robust = {name: loss for name, loss in points.items() if not issubclass(loss.loss, TrackLoss)}
    first = replace(last, cameras="held", losses=robust, rescale=False)
    return first, (replace(first, losses=points) if len(points) > len(robust) else None)


def _placed(
    observations: Observations,
    poses: tuple[Tensor, Tensor],
    run: Run,
    stage: Stage,
    covariance: Tensor,
    offsets: Tensor | None,
    timed: bool,
) -> tuple[Adjustment, _Clocks | None]:
    """A recording after its first stage, at some time offsets (C,) of the frames, and the time offsets beyond these."""
    adjusted = through([(_ROBUST, stage)], _begun(observations, poses, run, offsets), run)
    clocks = _clocks(adjusted, stage, run, covariance, searched=offsets is not None) if timed else None
    return adjusted, clocks


def _begun(observations: Observations, poses: tuple[Tensor, Tensor], run: Run, offsets: Tensor | None) -> Adjustment:
    """A recording with its first points; label errors are undone where the configuration says so."""
    frames = on_common_frames(observations, offsets)
    seen = measured(frames, run.config)
    rotations, translations = poses[0][None], poses[1][None]
    state = State.of(rotations, translations, triangulated(seen, rotations, translations, run.config.initialise))
    begun = Adjustment((observations,), (frames,), (), seen, seen, state, Labels.as_given(seen))
    begun = relabelled(begun, run) if run.config.relabel else begun
    if begun.asynchronous:
        placed = run_stage(_ROBUST, _stages(run.config)[0], begun.measurements, begun.state, run)
        begun = begun.ended(placed)
        begun = replace(begun, measurements=begun.exposures.at_common_times(begun.seen, begun.state, begun.support))
        begun = replace(begun, results=(), records=((),))
    return begun


def _at(adjustment: Adjustment, offsets_frames: Tensor) -> Adjustment:
    """The recording with its keypoints moved to the common frames by time offsets (C,)."""
    unknowns = RigUnknowns.of(("time_offset",), adjustment.seen.cameras)
    seen = replace(adjustment.seen, unknowns=unknowns)
    state = replace(adjustment.state, unknowns=offsets_frames[None, 1:].to(adjustment.state.points))
    measurements = adjustment.exposures.at_common_times(seen, state, adjustment.support)
    return replace(adjustment, refined=("time_offset",), seen=seen, measurements=measurements, state=state)


def _clocks(adjustment: Adjustment, stage: Stage, run: Run, covariance: Tensor, searched: bool) -> _Clocks | None:
    """Time offsets of the cameras by the motion of the points, everything else being as it is; None where there are none.

    There are some where frames were chosen by a search, and where time offsets are larger than their standard deviations, to
    which the uncertainty (covariance) of the cameras adds.

    The points are eliminated, so that a time offset is not hidden in them.
    """
    current = adjustment
    offsets = torch.zeros(adjustment.seen.num_cameras - 1, dtype=torch.float64, device=adjustment.state.points.device)
    std = torch.full_like(offsets, torch.nan)
    for number in range(_CLOCK_ROUNDS):
        current = _at(current, torch.nn.functional.pad(offsets, (1, 0)))
        if number:
            current = current.ended(run_stage(_ROBUST, stage, current.measurements, current.state, run))
            current = replace(current, results=current.results[-1:])
        objective = likelihood(current.kept.without_sticks(), current.last.losses, current.last.sigma_px)
        system = NormalEquations(objective, current.state, cameras_free=True)
        poses = 6 * len(offsets)
        own = covariance_of(system.reduced[0, poses:, poses:])
        by_poses = own @ system.reduced[0, poses:, :poses]
        step = -own @ system.reduced_gradient[0, poses:]
        std = (own + by_poses @ covariance @ by_poses.mT).diagonal().sqrt()
        offsets = offsets + step.clamp(-1.0, 1.0)
        if not searched and number == 0 and not _certain(offsets, std):
            return None
        if float(step.abs().max()) < _CLOCK_STEP:
            break
    if not searched and not _certain(offsets, std):
        return None
    return _Clocks(*(torch.nn.functional.pad(part, (1, 0)) for part in (offsets, std)))


def _certain(offsets: Tensor, std: Tensor) -> bool:
    return bool(((offsets.abs() > _CLOCK_SIGMAS * std) & (offsets.abs() > _CLOCK_FRAMES)).any())


def _concluded(ended: Adjustment, clocks: _Clocks | None, covariance: Tensor, run: Run) -> Reconstruction:
    observations, frames, measurements = ended.observations[0], ended.frames[0], ended.measurements
    inliers, sigma_px = measurements.by_frame(ended.last.inliers[0]), ended.last.sigma_px[0]
    points = measurements.by_frame(ended.state.points[0]).where(inliers.any(0), torch.nan).movedim(0, -1)
    found = point_covariances(
        points.flatten(0, 1),
        inliers.flatten(1),
        sigma_px.expand(points.shape[:2]).flatten(),
        (ended.state.rotations[0], ended.state.translations[0]),
        measurements.cameras_at(ended.state).to(torch.float64)[0],
        covariance,
    )
    evidence = Evidence(ended, {}, covariance, torch.zeros_like(covariance), None, lambda: False, (), run.config)
    ends = torch.tensor([stick.ends for stick in observations.sticks], dtype=torch.long).view(-1, 2)
    offsets = frames.offsets_frames + (0.0 if clocks is None else clocks.offsets_frames)
    std = torch.full_like(offsets, torch.nan) if clocks is None else clocks.std_frames
    period_s = 0.0 if frames.rate_hz is None else 1 / frames.rate_hz
    first_s = 0.0 if observations.readout_s is None else observations.readout_s / 2

    lens = observations.distortion

    def as_given(tensor: Tensor) -> Tensor:
        return tensor.to(observations.keypoints.dtype).contiguous()

    return Reconstruction(
        points=as_given(points),
        points_std_m=as_given(found.diagonal(dim1=1, dim2=2).sum(1).sqrt().view(points.shape[:2])),
        residuals_px=as_given(frames.to_own(residuals_of(ended), torch.nan)),
        inliers=frames.to_own(inliers, False),
        sigma_px=as_given(sigma_px),
        stick_lengths_m=as_given((points[:, ends[:, 1]] - points[:, ends[:, 0]]).norm(dim=-1)),
        frame_index=frames.index,
        keypoint_index=keypoint_index(ended),
        other_person=frames.to_own(ended.labels.other_person[0], False),
        times=None if frames.rate_hz is None else frames.numbers.double() * period_s + first_s,
        time_offsets=as_given(offsets * period_s),
        time_offsets_std=as_given(std * period_s),
        rotations=as_given(ended.state.rotations[0]),
        translations=as_given(ended.state.translations[0]),
        intrinsics=as_given(observations.intrinsics.expand(observations.num_cameras, 3, 3)),
        distortion=lens if lens is None else as_given(lens.expand(observations.num_cameras, -1)),
        fisheye=observations.fisheye,
        covariance=covariance,
        sticks=observations.sticks,
        fps=observations.fps,
        point_names=observations.point_names,
        camera_names=observations.camera_labels,
        world=World(),
        warnings=tuple(finding.text for finding in keypoint_findings(evidence)),
    )
