"""What a careful user should know about a result, in sentences: what happened, what it means, what to do."""

from __future__ import annotations

from collections.abc import Mapping

from torchstickcal.model.unknowns import CameraUnknown, all_unknowns
from torchstickcal.observations import Observations
from torchstickcal.pipeline.adjust import Adjustment
from torchstickcal.pipeline.synchronise import ClockEstimate
from torchstickcal.result import CameraParameter

_USELESS_FOCAL_SHARE = 0.03
_CONTRADICTED_SIGMAS = 4.0
_OPEN_SHARE = 0.5


def warnings_of(
    ended: Adjustment, unknowns: Mapping[str, CameraParameter], clocks: ClockEstimate | None, unsynchronised: bool
) -> tuple[str, ...]:
    """All warnings about a session where its last stage ended.

    Args:
        ended: the session.
        unknowns: what may be unknown of the cameras, as found and as the keypoints suggest.
        clocks: what a search for time offsets has found; None without one.
        unsynchronised: whether the motion contradicts the clocks, which were not estimated.
    """
    found = [*ended.observations[0].warnings, *_keypoints(ended)]
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


def _keypoints(ended: Adjustment) -> list[str]:
    """Keypoints that took no part, and points that are too noisy."""
    observations, measurements = ended.observations[0], ended.measurements
    found: list[str] = []
    comparable, kept = int(measurements.visible.sum()), int(ended.last.inliers.sum())
    takes_part = measurements.by_frame(measurements.active[0]).any(0)
    seen = int(observations.visible[:, :, takes_part].sum())
    if seen > comparable:
        found.append(f"{seen - comparable} of {seen} keypoints were not used: no second camera saw the point in that frame.")
    if comparable > kept:
        share = (comparable - kept) / comparable
        found.append(f"{comparable - kept} of {comparable} keypoints ({share:.1%}) were rejected: they contradict the others.")
    sigma_px = ended.last.sigma_px[0]
    noisy = (sigma_px > _USELESS_FOCAL_SHARE * measurements.cameras.focal_px.mean()).nonzero().flatten().tolist()
    if noisy:
        names = ", ".join(map(observations.point_label, noisy))
        found.append(f"The keypoints of these points are too noisy, and the points not reliable: {names}.")
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
