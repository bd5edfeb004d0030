"""Putting the result of a calibration together from its stages, in the caller's dtype and shapes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from torchstickcal.cameras import Intrinsics
from torchstickcal.lens_check import FocalCheck
from torchstickcal.losses import reprojection_residuals
from torchstickcal.observations import Observations
from torchstickcal.problem import Measurements
from torchstickcal.result import LENS_PARAMETERS, Calibration
from torchstickcal.stages import StageRecord, StageResult

_USELESS_FOCAL_SHARE = 0.03
_CONTRADICTED_SIGMAS = 4.0
_CONTRADICTED_SHARE = 0.005
_OPEN_SHARE = 0.5


def assemble(
    observations: Observations,
    measurements: Measurements,
    reached: StageResult,
    covariance: Tensor | None,
    refined: Sequence[str],
    focal: FocalCheck,
    stages: Sequence[StageRecord],
    seconds: Mapping[str, float],
    session: int = 0,
) -> Calibration:
    """The calibration of one session that the last of the stages has reached.

    Args:
        observations: the session as the user gave it.
        measurements: all that could take part, of all sessions solved together.
        reached: what the last stage ended with.
        covariance: of the tangents of all sessions' cameras and of their further unknowns; None where no stage adjusted them.
        refined: what else was found of the cameras.
        focal: the focal lengths as the data have them.
        stages: the records of this session's stages, in order.
        seconds: time by step.
        session: which of the sessions solved together it is.
    """
    one = slice(session, session + 1)
    measurements, inliers, sigma_px = measurements[one], reached.inliers[session], reached.sigma_px[session]
    rotations, translations = reached.state.rotations[session], reached.state.translations[session]
    points = measurements.by_frame(reached.state.points[session].where(inliers.any(0), torch.nan)).movedim(0, -1)
    cameras = measurements.cameras_at(reached.state[one]).to(torch.float64)[0]
    residuals = torch.empty_like(observations.keypoints, dtype=torch.float64)
    for frames in measurements.frame_slices():
        seen = (observations.visible[:, frames] & points[frames].isfinite().all(-1))[..., None]
        keypoints = observations.keypoints[:, frames].double()
        found = reprojection_residuals(points[frames], rotations, translations, keypoints, cameras)
        residuals[:, frames] = found.where(seen, torch.nan)
    starts, ends = [stick.start for stick in observations.sticks], [stick.end for stick in observations.sticks]
    size, count = observations.image_size, observations.num_cameras
    distortion = cameras.distortion if refined else observations.distortion
    poses, lenses = _covariance(covariance, measurements, session)
    ratio, ratio_std = _focal(focal, measurements, cameras, lenses)

    def as_given(tensor: Tensor) -> Tensor:
        return tensor.to(observations.keypoints.dtype).contiguous()

    return Calibration(
        rotations=as_given(rotations),
        translations=as_given(translations),
        points=as_given(points),
        covariance=poses,
        residuals_px=as_given(residuals),
        inliers=measurements.by_frame(inliers),
        stick_lengths_m=as_given((points[:, ends] - points[:, starts]).norm(dim=-1)),
        sigma_px=as_given(sigma_px),
        intrinsics=as_given(cameras.matrix),
        distortion=None if distortion is None else as_given(distortion.expand(count, distortion.shape[-1])),
        refined=tuple(refined),
        lens_std=as_given(lenses),
        focal_ratio=as_given(ratio),
        focal_ratio_std=as_given(ratio_std),
        image_size=None if size is None else size.expand(count, 2).round().long().contiguous(),
        fisheye=observations.fisheye,
        sticks=observations.sticks,
        fps=observations.fps,
        point_names=observations.point_names,
        camera_names=tuple(observations.camera_label(index) for index in range(count)),
        stages=tuple(stages),
        seconds=dict(seconds),
        warnings=(
            *_warnings(observations, measurements, inliers, sigma_px),
            *_lens_warnings(observations, measurements, lenses, ratio, ratio_std),
        ),
    )


def _covariance(covariance: Tensor | None, measurements: Measurements, session: int) -> tuple[Tensor, Tensor]:
    """That of the cameras' tangents, and standard deviations (C, 5) of what the lenses' parameters are."""
    tangents = 6 * (measurements.num_cameras - 1)
    stds = torch.zeros(measurements.num_cameras, len(LENS_PARAMETERS), dtype=torch.float64, device=measurements.pixels.device)
    if covariance is None:
        return torch.full((tangents, tangents), torch.nan, dtype=torch.float64), stds
    unknowns = measurements.unknowns
    if unknowns is not None:
        own = torch.einsum("ckj,jl,ckl->ck", unknowns.share, covariance[session, tangents:, tangents:], unknowns.share).sqrt()
        for number, kind in enumerate(unknowns.kinds):
            stds[:, LENS_PARAMETERS.index(kind.name)] = own[:, number]
    return covariance[session, :tangents, :tangents], stds


def _focal(focal: FocalCheck, measurements: Measurements, cameras: Intrinsics, lenses: Tensor) -> tuple[Tensor, Tensor]:
    """Each camera's focal length over the one given, with its standard deviation: as refined, else as checked."""
    found = lenses[:, 0] > 0
    ratio = cameras.focal_px / measurements.cameras.focal_px[0]
    return torch.where(found, ratio, focal.ratio), torch.where(found, lenses[:, 0] * ratio, focal.std)


def _lens_warnings(
    observations: Observations, measurements: Measurements, lenses: Tensor, ratio: Tensor, std: Tensor
) -> list[str]:
    """What was given and is contradicted, and what was to be found and could not be."""
    found: list[str] = []
    for camera, (value, sigma) in enumerate(zip(ratio.tolist(), std.tolist(), strict=True)):
        if observations.intrinsics_known and abs(value - 1) > max(_CONTRADICTED_SIGMAS * sigma, _CONTRADICTED_SHARE):
            used = "was found" if lenses[camera, 0] > 0 else "is what the data want, the given one was used"
            found.append(f"{observations.camera_label(camera)}: {value:.4f} +- {sigma:.4f} of the given focal length {used}.")
    unknowns = measurements.unknowns
    for kind in unknowns.kinds if unknowns is not None else ():
        prior = kind.prior(measurements.cameras[0])
        open_ones = (lenses[:, LENS_PARAMETERS.index(kind.name)] > _OPEN_SHARE * prior).nonzero().flatten().tolist()
        if open_ones:
            names = ", ".join(map(observations.camera_label, open_ones))
            found.append(f"{kind.name} stays near what was given, the data hardly tell it: {names}.")
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
