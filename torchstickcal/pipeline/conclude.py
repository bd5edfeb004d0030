"""From where the adjustment ended to the result, in the caller's dtype and shapes."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from torchstickcal.config import Config
from torchstickcal.geometry.singular import definite
from torchstickcal.inference import ordinary
from torchstickcal.model.correlation import error_correlation
from torchstickcal.model.unknowns import CameraUnknown, RigEstimate, all_unknowns
from torchstickcal.pipeline.adjustment import Adjustment
from torchstickcal.pipeline.check import CameraCheck
from torchstickcal.pipeline.height import HEIGHT_STD
from torchstickcal.pipeline.inference import inference_of
from torchstickcal.pipeline.run import Run
from torchstickcal.pipeline.scale import height_sets_scale
from torchstickcal.pipeline.synchronise import ClockEstimate, CommonFrames
from torchstickcal.quality.evidence import Evidence
from torchstickcal.quality.judge import judged
from torchstickcal.result import Calibration, CameraParameter
from torchstickcal.solvers.uncertainty import camera_covariance, likelihood, ruler_covariance, scale_covariance, without_scale
from torchstickcal.workers import map_with_idle_workers, on_worker


def conclude(
    ended: Adjustment,
    check: CameraCheck,
    clocks: ClockEstimate | None,
    unsynchronised: Callable[[], bool],
    left_out: tuple[str, ...],
    start_contradicted: bool,
    run: Run,
) -> Calibration:
    """The calibration of one session.

    Args:
        ended: where its last stage ended.
        check: what the keypoints say of lenses and clocks.
        clocks: what a search for time offsets has found; None without one.
        unsynchronised: says whether the motion contradicts the clocks, which were not estimated.
        left_out: names of the cameras that are no part of the rig.
        start_contradicted: whether poses were given as a start that the keypoints contradict.
        run: its configuration, and the time by step.
    """
    observations, frames, measurements = ended.observations[0], ended.frames[0], ended.measurements
    inliers, sigma_px = measurements.by_frame(ended.last.inliers[0]), ended.last.sigma_px[0]
    points = measurements.by_frame(ended.state.points[0]).where(inliers.any(0), torch.nan).movedim(0, -1)
    cameras = measurements.cameras_at(ended.state).to(torch.float64)[0]
    evidence = evidence_of(ended, check, run.config, clocks, unsynchronised, left_out, start_contradicted)
    covariance, unknowns = definite(evidence.noise + evidence.ruler), evidence.unknowns
    tangents = 6 * (measurements.num_cameras - 1)
    ends = torch.tensor([stick.ends for stick in observations.sticks], dtype=torch.long).view(-1, 2)
    size, count = observations.image_size, observations.num_cameras
    distortion = cameras.distortion if ended.refined else observations.distortion

    def as_given(tensor: Tensor) -> Tensor:
        return tensor.to(observations.keypoints.dtype).contiguous()

    return Calibration(
        rotations=as_given(ended.state.rotations[0]),
        translations=as_given(ended.state.translations[0]),
        points=as_given(points),
        covariance=covariance[:tangents, :tangents],
        residuals_px=as_given(frames.to_own(residuals_of(ended), torch.nan)),
        inliers=frames.to_own(inliers, False),
        stick_lengths_m=as_given((points[:, ends[:, 1]] - points[:, ends[:, 0]]).norm(dim=-1)),
        sigma_px=as_given(sigma_px),
        intrinsics=as_given(cameras.matrix),
        distortion=None if distortion is None else as_given(distortion.expand(count, distortion.shape[-1])),
        refined=ended.refined,
        unknowns={name: parameter.to(observations.keypoints.dtype) for name, parameter in unknowns.items()},
        frame_index=frames.index,
        keypoint_index=keypoint_index(ended),
        other_person=frames.to_own(ended.labels.other_person[0], False),
        times=_times(frames, unknowns["readout"].value[0]),
        image_size=None if size is None else size.expand(count, 2).round().long().contiguous(),
        fisheye=observations.fisheye,
        sticks=observations.sticks,
        fps=observations.fps,
        point_names=observations.point_names,
        camera_names=observations.camera_labels,
        stages=ended.records[0],
        seconds=dict(run.seconds),
        judgement=partial(judged, evidence),
        left_out=left_out,
    )


def evidence_of(
    ended: Adjustment,
    check: CameraCheck,
    config: Config,
    clocks: ClockEstimate | None = None,
    unsynchronised: Callable[[], bool] = lambda: False,
    left_out: tuple[str, ...] = (),
    start_contradicted: bool = False,
) -> Evidence:
    """What the quality of one session is judged by; arguments as of :func:`conclude`."""
    noise, ruler = _covariances(ended, config)
    tangents = 6 * (ended.measurements.num_cameras - 1)
    mode = partial(inference_of, ended.observations[0], config)
    unknowns = _unknowns(ended, check, (noise + ruler)[tangents:, tangents:], mode)
    return Evidence(ended, unknowns, noise, ruler, clocks, unsynchronised, left_out, config, start_contradicted, check)


def keypoint_index(ended: Adjustment) -> Tensor:
    """The point whose given keypoint each point uses (C, F, P), in the cameras' own frames."""
    own, index = ended.frames[0].to_own(ended.labels.index[0], -1), torch.arange(ended.observations[0].num_points)
    unused = own < 0
    return torch.where(unused, index.to(own.device), own) if bool(unused.any()) else own


def residuals_of(ended: Adjustment) -> Tensor:
    """Projections minus keypoints (C, G, P, 2) at the common frames, pixels; NaN where not seen or the point is not known."""
    measurements = ended.measurements
    known = measurements.visible & ended.last.inliers.any(1, keepdim=True)
    residuals = measurements.pixels.new_empty(known.shape[1], known.shape[2], 2, dtype=torch.float64)

    def put(columns: slice) -> None:
        found, _ = measurements.residuals_at(ended.state, columns)
        residuals[:, columns] = found[0].double().where(known[0][:, None, columns], torch.nan).movedim(1, -1)

    map_with_idle_workers(put, measurements.chunks())
    return residuals.unflatten(1, (measurements.frames, -1))


def _covariances(ended: Adjustment, config: Config) -> tuple[Tensor, Tensor]:
    """Covariances of the cameras' tangents and further unknowns where they were estimated last; NaN if they never were.

    The first comes from the errors of the keypoints, the second from those of the given lengths. Nothing is known of a
    camera whose keypoints do not agree with those of the others.
    """
    last, measurements = ended.last_camera_stage, ended.measurements
    if last.stage.cameras != "free":
        size = 6 * (measurements.num_cameras - 1) + measurements.unknowns.count
        unknown = torch.full((size, size), torch.nan, dtype=torch.float64, device=measurements.pixels.device)
        return unknown, unknown
    kept = measurements.keeping(last.inliers & ended.agreeing_cameras[..., None])
    sigma_px, times = ended.last.sigma_px, last.correlation_frames
    correlation = error_correlation(kept, last.state, sigma_px)
    noise = camera_covariance(likelihood(kept, last.losses, sigma_px * times.sqrt()), last.state, correlation, times)[0]
    if height_sets_scale(config, kept.sticks.shape[0]):
        return without_scale(noise, kept, last.state), scale_covariance(kept, last.state, HEIGHT_STD)
    return noise, ruler_covariance(kept, last.state, sigma_px)


def _unknowns(
    ended: Adjustment, check: CameraCheck, covariance: Tensor, mode: Callable[[], torch.inference_mode]
) -> dict[str, CameraParameter]:
    """Everything that can be unknown of the cameras beside their poses, refined or not, in its own unit."""
    observations, frames, measurements = ended.observations[0], ended.frames[0], ended.measurements
    found = {name: own[0] for name, own in measurements.unknowns.by_name(ended.state.unknowns).items()}
    variances = measurements.unknowns.variances(covariance)
    zero = measurements.cameras.focal_px[0].new_zeros(measurements.num_cameras)
    estimate = RigEstimate(
        given=measurements.cameras[0],
        found=measurements.cameras_at(ended.state).to(torch.float64)[0],
        frame_period_s=torch.nan if frames.rate_hz is None else 1 / frames.rate_hz,
        frame_offsets=frames.offsets_frames,
        readout_s=observations.readout_s or 0.0,
        deviations={n: found.get(n, zero[:, None].expand(-1, len(u.components))) for n, u in all_unknowns().items()},
    )
    parameters: dict[str, CameraParameter] = {}
    for name, unknown in all_unknowns().items():
        value, given, factor = unknown.in_units(estimate)
        parameters[name] = CameraParameter(
            label=unknown.label,
            unit=unknown.unit,
            components=unknown.components,
            refined=name in found,
            value=_own(value),
            std=_own(variances[name].sqrt() * factor.abs() if name in found else torch.full_like(value, torch.nan)),
            given=_own(given),
            prior_std=_own(unknown.prior(estimate.given) * factor.abs()),
            suggestion=partial(_suggestion, check, unknown, estimate, mode),
        )
    return parameters


def _suggestion(
    check: CameraCheck, unknown: CameraUnknown, estimate: RigEstimate, mode: Callable[[], torch.inference_mode]
) -> tuple[Tensor, Tensor]:
    """What the keypoints suggest for something that may be unknown of the cameras, and its standard deviation, in its unit."""

    def found() -> tuple[Tensor, Tensor]:
        with mode():
            deviation, std = check.suggestion(unknown.name)
            deviations = estimate.deviations | {unknown.name: estimate.deviations[unknown.name] + deviation}
            moved = estimate._replace(found=unknown.applied(estimate.found, deviation), deviations=deviations)
            _, _, factor = unknown.in_units(estimate)
            return ordinary((_own(unknown.in_units(moved).value), _own(std * factor.abs())))

    return on_worker(estimate.found.matrix.device, found)


def _own(values: Tensor) -> Tensor:
    """Values (C, n) as (C,) where n is 1."""
    return values[:, 0] if values.shape[1] == 1 else values


def _times(frames: CommonFrames, first_readout_s: Tensor) -> Tensor | None:
    """(G,), when the common frames are."""
    if frames.rate_hz is None:
        return None
    return frames.numbers.to(first_readout_s) / frames.rate_hz + first_readout_s / 2
