"""Putting the result of a calibration together from its stages, in the caller's dtype and shapes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from torchstickcal.losses import reprojection_residuals
from torchstickcal.observations import Observations
from torchstickcal.problem import Measurements
from torchstickcal.result import Calibration
from torchstickcal.stages import StageRecord, StageResult

_USELESS_FOCAL_SHARE = 0.03


def assemble(
    observations: Observations,
    measurements: Measurements,
    reached: StageResult,
    covariance: Tensor | None,
    stages: Sequence[StageRecord],
    seconds: Mapping[str, float],
    session: int = 0,
) -> Calibration:
    """The calibration of one session that the last of the stages has reached.

    Args:
        observations: the session as the user gave it.
        measurements: all that could take part, of all sessions solved together.
        reached: what the last stage ended with.
        covariance: of the tangents of all sessions' cameras; None where no stage adjusted them.
        stages: the records of this session's stages, in order.
        seconds: time by step.
        session: which of the sessions solved together it is.
    """
    one = slice(session, session + 1)
    measurements, inliers, sigma_px = measurements[one], reached.inliers[session], reached.sigma_px[session]
    rotations, translations = reached.state.rotations[session], reached.state.translations[session]
    points = measurements.by_frame(reached.state.points[session].where(inliers.any(0), torch.nan)).movedim(0, -1)
    residuals = torch.empty_like(observations.keypoints, dtype=torch.float64)
    for frames in measurements.frame_slices():
        seen = (observations.visible[:, frames] & points[frames].isfinite().all(-1))[..., None]
        keypoints = observations.keypoints[:, frames].double()
        found = reprojection_residuals(points[frames], rotations, translations, keypoints, measurements.cameras[0])
        residuals[:, frames] = found.where(seen, torch.nan)
    starts, ends = [stick.start for stick in observations.sticks], [stick.end for stick in observations.sticks]
    distortion, size, cameras = observations.distortion, observations.image_size, observations.num_cameras

    def as_given(tensor: Tensor) -> Tensor:
        return tensor.to(observations.keypoints.dtype).contiguous()

    return Calibration(
        rotations=as_given(rotations),
        translations=as_given(translations),
        points=as_given(points),
        covariance=_covariance(covariance, cameras, session),
        residuals_px=as_given(residuals),
        inliers=measurements.by_frame(inliers),
        stick_lengths_m=as_given((points[:, ends] - points[:, starts]).norm(dim=-1)),
        sigma_px=as_given(sigma_px),
        intrinsics=as_given(observations.cameras.matrix),
        distortion=None if distortion is None else as_given(distortion.expand(cameras, distortion.shape[-1])),
        image_size=None if size is None else size.expand(cameras, 2).round().long().contiguous(),
        fisheye=observations.fisheye,
        sticks=observations.sticks,
        fps=observations.fps,
        point_names=observations.point_names,
        camera_names=tuple(observations.camera_label(index) for index in range(cameras)),
        stages=tuple(stages),
        seconds=dict(seconds),
        warnings=_warnings(observations, measurements, inliers, sigma_px),
    )


def _covariance(covariance: Tensor | None, cameras: int, session: int) -> Tensor:
    size = 6 * (cameras - 1)
    return torch.full((size, size), torch.nan, dtype=torch.float64) if covariance is None else covariance[session]


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
