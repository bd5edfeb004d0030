"""Putting the result of a calibration together from its stages, in the caller's dtype and shapes."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from torchstickcal.model.measurements import Measurements
from torchstickcal.observations import Observations
from torchstickcal.pipeline.adjust import Adjustment
from torchstickcal.pipeline.check import CameraCheck
from torchstickcal.pipeline.synchronise import ClockEstimate
from torchstickcal.result import LENS_PARAMETERS, Calibration

_USELESS_FOCAL_SHARE = 0.03
_CONTRADICTED_SIGMAS = 4.0
_CONTRADICTED_SHARE = 0.005
_CONTRADICTED_FRAMES = 0.02
_OPEN_SHARE = 0.5
_OUT_OF_STEP = "the cameras do not seem to be in step: other frames fit together better than those told. Refine time_offset."


def assemble(
    observations: Observations,
    reached: Adjustment,
    covariance: Tensor | None,
    check: CameraCheck,
    clocks: ClockEstimate | None,
    out_of_step: bool,
    seconds: Mapping[str, float],
) -> Calibration:
    """The calibration of one session.

    Args:
        observations: the session as the user gave it.
        reached: where its adjustment ended.
        covariance: of the tangents of the cameras and of their further unknowns, (1, ...); None where no stage adjusted them.
        check: what the data say of lenses and clocks there.
        clocks: what a search for the clocks has found; None without one.
        out_of_step: whether the motion says that clocks that were taken as told are frames apart.
        seconds: time by step.
    """
    frames, measurements, result = reached.frames, reached.measurements, reached.result
    inliers, sigma_px = measurements.by_frame(result.inliers[0]), result.sigma_px[0]
    points = measurements.by_frame(result.state.points[0]).where(inliers.any(0), torch.nan).movedim(0, -1)
    cameras = measurements.cameras_at(result.state).to(torch.float64)[0]
    starts, ends = [stick.start for stick in observations.sticks], [stick.end for stick in observations.sticks]
    size, count = observations.image_size, observations.num_cameras
    distortion = cameras.distortion if reached.refined else observations.distortion
    poses, stds = _covariance(covariance, measurements)
    lens_std = torch.stack([stds.get(name, torch.zeros(count).to(points)) for name in LENS_PARAMETERS], dim=1)
    ratio, ratio_std = _focal(check, cameras.focal_px / measurements.cameras.focal_px[0], lens_std[:, 0])
    timing = _Timing(observations, reached, check, stds)

    def as_given(tensor: Tensor) -> Tensor:
        return tensor.to(observations.keypoints.dtype).contiguous()

    return Calibration(
        rotations=as_given(result.state.rotations[0]),
        translations=as_given(result.state.translations[0]),
        points=as_given(points),
        covariance=poses,
        residuals_px=as_given(frames.to_own(_residuals(reached), torch.nan)),
        inliers=frames.to_own(inliers, False),
        stick_lengths_m=as_given((points[:, ends] - points[:, starts]).norm(dim=-1)),
        sigma_px=as_given(sigma_px),
        intrinsics=as_given(cameras.matrix),
        distortion=None if distortion is None else as_given(distortion.expand(count, distortion.shape[-1])),
        refined=reached.refined,
        lens_std=as_given(lens_std),
        focal_ratio=as_given(ratio),
        focal_ratio_std=as_given(ratio_std),
        time_offsets=as_given(timing.offsets),
        time_offsets_std=as_given(timing.offsets_std),
        readout=as_given(timing.readout),
        readout_std=as_given(timing.readout_std),
        late=as_given(timing.late),
        late_std=as_given(timing.late_std),
        frame_index=frames.index,
        times=timing.times,
        image_size=None if size is None else size.expand(count, 2).round().long().contiguous(),
        fisheye=observations.fisheye,
        sticks=observations.sticks,
        fps=observations.fps,
        point_names=observations.point_names,
        camera_names=tuple(observations.camera_label(index) for index in range(count)),
        stages=reached.records,
        seconds=dict(seconds),
        warnings=(
            *_warnings(observations, measurements, inliers, sigma_px),
            *_lens_warnings(observations, ratio, ratio_std, lens_std[:, 0] > 0),
            *([_OUT_OF_STEP] if out_of_step else []),
            *timing.warnings(),
            *_undetermined(observations, measurements, stds, clocks),
        ),
    )


def _residuals(reached: Adjustment) -> Tensor:
    """Projections minus keypoints (C, G, P, 2) at the common frames, pixels; NaN where not seen or the point is not known."""
    measurements = reached.measurements
    known = measurements.visible & reached.result.inliers.any(1, keepdim=True)
    residuals = torch.empty_like(measurements.pixels, dtype=torch.float64)
    for columns, found, _ in measurements.residuals(reached.result.state):
        residuals[..., columns] = found.double().where(known[..., columns].unsqueeze(-2), torch.nan)
    return measurements.by_frame(residuals[0]).movedim(1, -1)


def _covariance(covariance: Tensor | None, measurements: Measurements) -> tuple[Tensor, dict[str, Tensor]]:
    """That of the cameras' tangents, and each camera's standard deviation (C,) of what else was unknown, by its kind."""
    tangents = 6 * (measurements.num_cameras - 1)
    if covariance is None:
        return torch.full((tangents, tangents), torch.nan, dtype=torch.float64), {}
    unknowns = measurements.unknowns
    if unknowns is None:
        return covariance[0], {}
    own = torch.einsum("ckj,jl,ckl->kc", unknowns.share, covariance[0, tangents:, tangents:], unknowns.share).sqrt()
    return covariance[0, :tangents, :tangents], {kind.name: std for kind, std in zip(unknowns.kinds, own, strict=True)}


def _focal(check: CameraCheck, ratio: Tensor, std: Tensor) -> tuple[Tensor, Tensor]:
    """Each camera's focal length over the one given, with its standard deviation: as refined, else as checked."""
    data = check.focal()
    return torch.where(std > 0, ratio, data.ratio), torch.where(std > 0, std * ratio, data.std)


class _Timing:
    """What is known of the cameras' clocks and shutters in the end, (C,) each, seconds; NaN without a frame rate."""

    def __init__(self, observations: Observations, reached: Adjustment, check: CameraCheck, stds: Mapping[str, Tensor]) -> None:
        self._observations, self._refined, self._frames = observations, reached.refined, reached.frames
        frames, found = reached.frames, reached.found
        self._period_s = 1 / frames.rate_hz if frames.rate_hz is not None else torch.nan
        nothing = torch.zeros_like(frames.offsets_frames)
        self.readout = (observations.readout_s or 0.0) + self._seconds(found.get("readout", nothing))
        middle = self._seconds(frames.offsets_frames + reached.late_frames)
        self.offsets = middle - (self.readout - self.readout[0]) / 2
        self.offsets_std = self._seconds(stds.get("time_offset", nothing))
        self.readout_std = self._seconds(stds.get("readout", nothing))
        data = check.clocks()
        self._late_frames = data.late_frames
        self.late, self.late_std = self._seconds(data.late_frames), self._seconds(data.std)

    @property
    def times(self) -> Tensor | None:
        """(G,), when the common frames are."""
        if self._frames.rate_hz is None:
            return None
        common = self._frames.first + torch.arange(self._frames.lags.shape[1]).to(self.readout)
        return common / self._frames.rate_hz + self.readout[0] / 2

    def warnings(self) -> list[str]:
        """Clocks that were taken as told and are contradicted."""
        found: list[str] = []
        if "time_offset" in self._refined:
            return found
        for camera, (late, std) in enumerate(zip(self.late.tolist(), self.late_std.tolist(), strict=True)):
            noticeable = abs(float(self._late_frames[camera])) > _CONTRADICTED_FRAMES
            if noticeable and abs(late) > _CONTRADICTED_SIGMAS * std:
                label = self._observations.camera_label(camera)
                found.append(f"{label} looks {1000 * late:.1f} +- {1000 * std:.1f} ms later than told, by the data.")
        return found

    def _seconds(self, frames: Tensor) -> Tensor:
        return torch.where(frames == 0, 0.0, frames * self._period_s)


def _lens_warnings(observations: Observations, ratio: Tensor, std: Tensor, found: Tensor) -> list[str]:
    """Focal lengths that were given and are contradicted."""
    if not observations.intrinsics_known:
        return []
    warnings: list[str] = []
    for camera, (value, sigma) in enumerate(zip(ratio.tolist(), std.tolist(), strict=True)):
        if abs(value - 1) > max(_CONTRADICTED_SIGMAS * sigma, _CONTRADICTED_SHARE):
            used = "was found" if found[camera] else "is what the data want, the given one was used"
            warnings.append(
                f"{observations.camera_label(camera)}: {value:.4f} +- {sigma:.4f} of the given focal length {used}."
            )
    return warnings


def _undetermined(
    observations: Observations, measurements: Measurements, stds: Mapping[str, Tensor], clocks: ClockEstimate | None
) -> list[str]:
    """What was to be found and could not be."""
    found: list[str] = []
    unknowns = measurements.unknowns
    for kind in unknowns.kinds if unknowns is not None else ():
        prior = kind.prior(measurements.cameras[0])
        open_ones = (stds[kind.name] > _OPEN_SHARE * prior).nonzero().flatten().tolist() if kind.name in stds else []
        if open_ones:
            names = ", ".join(map(observations.camera_label, open_ones))
            found.append(f"{kind.name} stays near what was given, the data hardly tell it: {names}.")
    for camera, reason in enumerate(clocks.reasons if clocks is not None else ()):
        if reason:
            found.append(f"{observations.camera_label(camera)}: its clock's offset is not sure, {reason}.")
    return found


def _warnings(observations: Observations, measurements: Measurements, inliers: Tensor, sigma_px: Tensor) -> tuple[str, ...]:
    found: list[str] = []
    comparable, kept = int(measurements.visible.sum()), int(inliers.sum())
    seen = int(observations.visible[:, :, measurements.by_frame(measurements.active[0]).any(0)].sum())
    if seen > comparable:
        found.append(f"{seen - comparable} of {seen} keypoints took no part: no second camera saw the point.")
    if comparable > kept:
        share = (comparable - kept) / comparable
        found.append(f"{comparable - kept} of {comparable} keypoints ({share:.1%}) contradict the rest and were set aside.")
    noisy = (sigma_px > _USELESS_FOCAL_SHARE * measurements.cameras.focal_px.mean()).nonzero().flatten().tolist()
    if noisy:
        names = ", ".join(observations.point_label(point) for point in noisy)
        found.append(f"too noisy to be of use (their 3D points are not reliable): {names}.")
    return tuple(found)
