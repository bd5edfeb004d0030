"""What a careful user should know about a result, in sentences: what happened, what it means, what to do."""

from __future__ import annotations

import itertools
from collections.abc import Mapping

import torch

from torchstickcal.losses import ReprojectionLoss
from torchstickcal.model.objective import Objective
from torchstickcal.model.unknowns import CameraUnknown, all_unknowns
from torchstickcal.observations import Observations
from torchstickcal.pipeline.adjust import Adjustment
from torchstickcal.pipeline.relabel import exchanges
from torchstickcal.pipeline.stage import agreeing_cameras
from torchstickcal.pipeline.synchronise import ClockEstimate
from torchstickcal.result import CameraParameter
from torchstickcal.solvers.elimination.normal_equations import NormalEquations

_USELESS_FOCAL_SHARE = 0.03
_CONTRADICTED_SIGMAS = 4.0
_OPEN_SHARE = 0.5
_SAME_VIEW_RAD = 0.005
"""Mean angle between the rays of two cameras to the same points, below which they see one and the same view."""
_WRONG_LENGTH_SHARE, _WRONG_LENGTH_SIGMAS = 0.02, 4.0
"""Deviation of a stick's length from the given one, as a share of it and in tolerances, beyond which it is not the stick."""


def warnings_of(
    ended: Adjustment,
    unknowns: Mapping[str, CameraParameter],
    clocks: ClockEstimate | None,
    unsynchronised: bool,
    left_out: tuple[str, ...] = (),
) -> tuple[str, ...]:
    """All warnings about a session where its last stage ended.

    Args:
        ended: the session.
        unknowns: what may be unknown of the cameras, as found and as the keypoints suggest.
        clocks: what a search for time offsets has found; None without one.
        unsynchronised: whether the motion contradicts the clocks, which were not estimated.
        left_out: names of the cameras that are no part of the rig.
    """
    found = [*_left_out(left_out), *keypoint_warnings(ended), *_same_views(ended)]
    if len(ended.measurements.sticks) > 1:
        found += _contradicted_lengths(ended)
    for name, unknown in all_unknowns().items():
        found += _contradicted(ended.observations[0], unknown, unknowns[name])
        found += _undetermined(ended, unknown, unknowns[name])
    if unsynchronised:
        found.append(
            "The cameras do not seem to be synchronised: other frames fit together better than those of equal number or time. "
            "Estimate the time offsets (refine 'time_offset')."
        )
    for camera, reason in enumerate(clocks.reasons if clocks is not None else ()):
        if reason:
            found.append(f"{ended.observations[0].camera_label(camera)}: its time offset is uncertain, {reason}.")
    return tuple(found)


def keypoint_warnings(ended: Adjustment) -> tuple[str, ...]:
    """Warnings about the keypoints alone."""
    return (*ended.observations[0].warnings, *_labels(ended), *_keypoints(ended))


def _left_out(cameras: tuple[str, ...]) -> list[str]:
    """Cameras that are no part of the rig."""
    if not cameras:
        return []
    return [f"Not calibrated, because they share too few points with the other cameras: {', '.join(cameras)}."]


def _labels(ended: Adjustment) -> list[str]:
    """Label errors that were undone, and frames that show another person."""
    observations, labels = ended.observations[0], ended.labels
    found: list[str] = []
    for exchange in exchanges(observations.point_names, [stick.ends for stick in observations.sticks]):
        if exchange.whole:
            for camera, count in enumerate(labels.exchanged_frames(exchange)[0].sum(-1).tolist()):
                if count:
                    found.append(
                        f"{observations.camera_label(camera)}: {exchange.what} were exchanged in {count} of "
                        f"{observations.num_frames} frames, and corrected."
                    )
    for camera, count in enumerate(labels.other_person[0].sum(-1).tolist()):
        if count:
            found.append(
                f"{observations.camera_label(camera)}: {count} of {observations.num_frames} frames were not used: all their "
                "keypoints contradict the other cameras, as if they showed another person."
            )
    return found


def _keypoints(ended: Adjustment) -> list[str]:
    """Keypoints that took no part, and points that are too noisy."""
    observations, measurements = ended.observations[0], ended.measurements
    found: list[str] = []
    comparable, kept, agreeing = int(measurements.visible.sum()), int(ended.last.inliers.sum()), ended.kept
    takes_part = measurements.by_frame(measurements.active[0]).any(0)
    same_person = ~ended.frames[0].to_own(ended.labels.other_person[0], False)
    seen = int((observations.visible[:, :, takes_part] & same_person[..., None]).sum())
    if seen > comparable:
        found.append(f"{seen - comparable} of {seen} keypoints were not used: no second camera saw the point in that frame.")
    if comparable > kept:
        share = (comparable - kept) / comparable
        found.append(f"{comparable - kept} of {comparable} keypoints ({share:.1%}) were rejected: they contradict the others.")
    for camera in (~agreeing_cameras(measurements, agreeing)[0]).nonzero().flatten().tolist():
        own, left = (int(m.visible[0, camera].sum()) for m in (measurements, agreeing))
        found.append(
            f"{observations.camera_label(camera)}: {left} of {own} keypoints agree with the other cameras, so that nothing "
            "is known of where it is. Check that it shows the same athlete at the same time, and that its intrinsics are right."
        )
    sigma_px = ended.last.sigma_px[0]
    noisy = (sigma_px > _USELESS_FOCAL_SHARE * measurements.cameras.focal_px.mean()).nonzero().flatten().tolist()
    if noisy:
        names = ", ".join(map(observations.point_label, noisy))
        found.append(f"The keypoints of these points are too noisy, and the points not reliable: {names}.")
    return found


def _same_views(ended: Adjustment) -> list[str]:
    """Pairs of cameras that see the points from the same place."""
    observations, measurements = ended.observations[0], ended.measurements
    centres = -(ended.state.rotations[0].mT @ ended.state.translations[0][..., None])
    rays = torch.nn.functional.normalize(ended.state.points - centres, dim=1)
    found: list[str] = []
    for first, second in itertools.combinations(range(measurements.num_cameras), 2):
        common = measurements.visible[0, first] & measurements.visible[0, second]
        angles = (rays[first] - rays[second])[:, common].square().sum(0).sqrt()
        if len(angles) and float(angles.mean()) < _SAME_VIEW_RAD:
            names = f"{observations.camera_label(first)} and {observations.camera_label(second)}"
            found.append(
                f"{names} see the scene from the same place, so that the pair has no depth. Check whether the same video was "
                "taken for both."
            )
    return found


def _contradicted_lengths(ended: Adjustment) -> list[str]:
    """Sticks whose given lengths contradict each other: by the keypoints alone, they have others."""
    observations, kept = ended.observations[0], ended.kept
    reprojection = Objective(kept, {"reprojection": ReprojectionLoss(ended.last.sigma_px[:, None, None])})
    step = NormalEquations(reprojection, ended.state, cameras_free=False).step()
    lengths_m = kept.stick_lengths_m(ended.state.points + step.points)[0].nanmedian(0).values.tolist()
    found: list[str] = []
    for ends, given, sigma, length in zip(
        kept.sticks.tolist(), kept.lengths_m[0].tolist(), kept.stick_sigma_m.tolist(), lengths_m, strict=True
    ):
        if abs(length - given) > max(_WRONG_LENGTH_SHARE * given, _WRONG_LENGTH_SIGMAS * sigma):
            names = " - ".join(map(observations.point_label, ends))
            found.append(
                f"The stick {names} is {length:.4g} m long by the keypoints, but {given:.4g} m was given. Check the lengths of "
                "all sticks, and which points are their ends."
            )
    return found


def _contradicted(observations: Observations, unknown: CameraUnknown, parameter: CameraParameter) -> list[str]:
    """Given values that the keypoints contradict."""
    guessed = unknown.family == "lens" and not observations.intrinsics_known
    if unknown.noticeable_prior_share is None or guessed or (parameter.refined and unknown.family == "clock"):
        return []
    names = ("value", "std") if parameter.refined else ("suggested", "suggested_std")
    first = (parameter.by_component(name)[:, 0].tolist() for name in (*names, "given", "prior_std"))
    found: list[str] = []
    for camera, (value, std, given, prior_std) in enumerate(zip(*first, strict=True)):
        if abs(value - given) > max(_CONTRADICTED_SIGMAS * std, unknown.noticeable_prior_share * prior_std):
            what = f"{observations.camera_label(camera)}: {unknown.label} {_quantity(value, std, unknown.unit)}"
            if parameter.refined:
                found.append(f"{what} estimated, {_quantity(given, None, unknown.unit)} was given.")
            else:
                found.append(
                    f"{what} suggested by the keypoints, but {_quantity(given, None, unknown.unit)} was given and used. "
                    f"Check it, or estimate it (refine {next(iter(unknown.variants))!r})."
                )
    return found


def _undetermined(ended: Adjustment, unknown: CameraUnknown, parameter: CameraParameter) -> list[str]:
    """What was to be estimated and could not be."""
    if not parameter.refined:
        return []
    uncertain = parameter.by_component("std") > _OPEN_SHARE * parameter.by_component("prior_std")
    found: list[str] = []
    for number, component in enumerate(unknown.components):
        cameras = uncertain[:, number].nonzero().flatten().tolist()
        if cameras:
            names = ", ".join(map(ended.observations[0].camera_label, cameras))
            found.append(f"{component} stays near the given value: the keypoints do not determine it ({names}).")
    return found


def _quantity(value: float, std: float | None, unit: str) -> str:
    """A value with its standard deviation and unit."""
    factor, unit = (1000, "ms") if unit == "s" else (1, unit)
    number = f"{factor * value:.5g}" if std is None else f"{factor * value:.5g} ± {factor * std:.2g}"
    return f"{number} {unit}".strip()
