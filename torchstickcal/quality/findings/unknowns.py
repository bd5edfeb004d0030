"""Lenses and clocks: given values that the keypoints contradict, and what was to be estimated and could not be."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from torchstickcal.model.unknowns import CameraUnknown, all_unknowns
from torchstickcal.quality.evidence import CONSTANT_SIGMAS, Evidence
from torchstickcal.quality.finding import Finding, Severity
from torchstickcal.quality.lags import frames_are_apart
from torchstickcal.quality.registry import findings
from torchstickcal.result import CameraParameter

_CONTRADICTED_SIGMAS = 4.0
_CLEAR_SIGMAS = 8.0
"""For values with a weak prior, which biased keypoints move easily."""
_ASTRAY, _LEFT_SIGMAS = 0.1, 5.0
"""Error of a given focal length that was estimated, from which on such values are contradicted already by fewer standard
deviations, and are serious: a wrong focal length can take the place of most of their error."""
_OPEN_SHARE = 0.5
_WRONG_FOCAL = 0.02
"""Error of a focal length from which on the camera's distance is wrong by 2 %. Biased keypoints alone make 1 to 2 %."""
_ANOTHER_CAMERA = 0.3
"""Error of a focal length that no calibration of the same camera makes: an estimate that far away is doubted too."""
_FAR_FOCAL, _FAR_SIGMAS, _FAR_BY_CHANCE = 0.03, 3.0, 0.005
"""Error of a focal length that no careful calibration makes, from which on less evidence is enough, where the errors of the
keypoints are not always the same: for the common factor of all cameras, in standard deviations; for the most doubtful of all
cameras, as the share of sound sessions in which chance reaches it."""
_BIASED_FOCAL = 0.1
"""The same where they are: biased keypoints alone make 1 to 2 %, and a wrong focal length makes such errors too."""
_UNSEEN_FOCAL = 0.05
"""Error of all focal lengths from which on it is said that the keypoints would not show it."""
_IN_STEP_FRAMES = 0.15
_IN_COMMON_SHARE, _LITTLE_IN_COMMON_SHARE = 0.6, 0.5
_WRONG_FRAMES = 0.5
"""Time offset, in frames, from which on the clocks matter."""


@findings("unknowns", "lenses and clocks that the keypoints contradict or do not determine", small=True)
def unknowns(evidence: Evidence) -> Iterator[Finding]:
    """Findings about lenses and clocks."""
    for name, unknown in all_unknowns().items():
        contradicted = list(_contradicted(evidence, unknown, evidence.unknowns[name]))
        yield from contradicted
        yield from _different(evidence, unknown, evidence.unknowns[name])
        yield from _undetermined(evidence, unknown, evidence.unknowns[name])
        if name == "focal" and not contradicted and evidence.observations.intrinsics_known:
            yield from _all_focals(evidence)


@findings("clocks", "cameras whose clocks are apart or uncertain, by the motion in the images")
def clocks(evidence: Evidence) -> Iterator[Finding]:
    """Findings about clocks, of the motion in the images."""
    if not _in_step(evidence) and evidence.unsynchronised() and frames_are_apart(evidence) is not False:
        yield Finding(
            "unsynchronised",
            Severity.SERIOUS if _apart(evidence) else Severity.CAUTION,
            "The cameras do not seem to be synchronised: other frames fit together better than those of equal number or time.",
            "Estimate the time offsets (refine 'time_offset').",
            is_cause=evidence.explains_most("clock"),
        )
    yield from _little_in_common(evidence)
    for camera, reason in enumerate(evidence.clocks.reasons if evidence.clocks is not None else ()):
        if reason:
            name = evidence.camera(camera)
            yield Finding(
                "time_offset_uncertain", Severity.CAUTION, f"{name}: its time offset is uncertain, {reason}.", cameras=(name,)
            )


def _little_in_common(evidence: Evidence) -> Iterator[Finding]:
    """Cameras of which little is compared with the others, by a time offset that was searched for."""
    for camera, share in enumerate(evidence.in_common.tolist() if evidence.clocks is not None else ()):
        if share < _IN_COMMON_SHARE:
            name, little = evidence.camera(camera), share < _LITTLE_IN_COMMON_SHARE
            yield Finding(
                "little_in_common",
                Severity.SERIOUS if little else Severity.CAUTION,
                f"{name}: by the time offset that was found, only {100 * share:.0f} % of its keypoints are of times and points "
                "that the other cameras see: two recordings have so much in common by chance.",
                "Check that its video belongs to this session, and cut the videos so that they begin at the same time.",
                cameras=(name,),
                figure=share,
                limit=_LITTLE_IN_COMMON_SHARE if little else _IN_COMMON_SHARE,
                unit="share",
                is_cause=little,
            )


def _in_step(evidence: Evidence) -> bool:
    """Whether the points say that the cameras are synchronised, to a fraction of a frame."""
    rate, offset = evidence.ended.frames[0].rate_hz, evidence.unknowns["time_offset"]
    if rate is None or not evidence.consistent:
        return False
    frames = (offset.suggested - offset.given).abs() * rate + offset.suggested_std * rate
    return bool((frames < _IN_STEP_FRAMES).all())


def _apart(evidence: Evidence) -> bool:
    """Whether the points do not fit together, or say that the clock of some camera is clearly ahead or behind."""
    rate, offset = evidence.ended.frames[0].rate_hz, evidence.unknowns["time_offset"]
    difference = (offset.suggested - offset.given).abs()
    clear = (difference * (rate or 1.0) > _WRONG_FRAMES) & (difference > _CONTRADICTED_SIGMAS * offset.suggested_std)
    return not evidence.consistent or bool(clear.any())


def _contradicted(evidence: Evidence, unknown: CameraUnknown, parameter: CameraParameter) -> Iterator[Finding]:
    """Given values that the keypoints contradict."""
    guessed = unknown.family == "lens" and not evidence.observations.intrinsics_known
    if unknown.noticeable_prior_share is None or guessed or (parameter.refined and unknown.family == "clock"):
        return
    names = ("value", "std") if parameter.refined else ("suggested", "suggested_std")
    first = zip(*(parameter.by_component(name)[:, 0].tolist() for name in (*names, "given", "prior_std")), strict=True)
    alone = _far_alone(evidence) if unknown.name == "focal" and not parameter.refined else None
    for camera, (value, std, given, prior_std) in enumerate(first):
        limit = _CONTRADICTED_SIGMAS
        if alone is not None and alone.camera == camera and abs(value - given) < limit * std:
            value, std, limit = alone.value, alone.std, alone.limit
        if not abs(value - given) > max(limit * std, unknown.noticeable_prior_share * prior_std):
            continue
        if unknown.name == "focal" and not parameter.refined:
            limit = evidence.slow_changes_beside(camera, value / given).least(limit)
            if not abs(value - given) > limit * std:
                continue
        matters = not parameter.refined and _matters(evidence, unknown.name, value - given, given)
        far = parameter.refined and unknown.name == "focal" and abs(value - given) > _ANOTHER_CAMERA * abs(given)
        name = evidence.camera(camera)
        what = f"{name}: {unknown.label} {_quantity(value, std, unknown.unit)}"
        if parameter.refined:
            meaning = f"{what} estimated, {_quantity(given, None, unknown.unit)} was given."
            advice = "Such intrinsics are those of another camera or resolution: give the right ones." if far else ""
        else:
            meaning = f"{what} suggested by the keypoints, but {_quantity(given, None, unknown.unit)} was given and used."
            advice = f"Check it, or estimate it (refine {next(iter(unknown.variants))!r})."
        yield Finding(
            f"{unknown.name}_contradicted",
            Severity.SERIOUS if matters or far else Severity.NOTE if parameter.refined else Severity.CAUTION,
            meaning,
            advice,
            cameras=(name,),
            figure=(value - given) / std if std > 0 else None,
            limit=limit,
            unit="standard deviations",
            is_cause=matters and evidence.explains_most(unknown.family),
        )


class _Alone(NamedTuple):
    """The camera whose focal length the keypoints contradict most, where those of the others are as given."""

    camera: int
    value: float
    """pixels"""
    std: float
    limit: float
    """standard deviations that chance hardly reaches in any of the cameras"""


def _far_alone(evidence: Evidence) -> _Alone | None:
    """The focal length that is the most doubtful by itself; None unless it is as wrong as no careful calibration makes it."""
    if evidence.check is None:
        return None
    values, stds = (own[:, 0] for own in evidence.check.suggestion_of_one("focal"))
    camera = int((values / stds).abs().nan_to_num(0.0).argmax())
    change, given = float(values[camera].expm1()), float(evidence.unknowns["focal"].given[camera])
    biased = evidence.constant_errors_sigmas >= CONSTANT_SIGMAS
    if not abs(change) > (_BIASED_FOCAL if biased else _FAR_FOCAL):
        return None
    limit = torch.special.ndtri(torch.tensor(1 - _FAR_BY_CHANCE / (2 * evidence.cameras), dtype=torch.float64))
    return _Alone(camera, given * (1 + change), given * float(stds[camera]), float(limit))


def _all_focals(evidence: Evidence) -> Iterator[Finding]:
    """Focal lengths that are all wrong by the same factor: several cameras together say more than each by itself."""
    if evidence.common_focal is None:
        return
    wanted, std = evidence.common_focal
    change, names = math.expm1(wanted), evidence.observations.camera_labels
    if abs(change) > _FAR_FOCAL and abs(wanted) > _FAR_SIGMAS * std:
        yield Finding(
            "focal_contradicted",
            Severity.SERIOUS if abs(wanted) > _CONTRADICTED_SIGMAS * std else Severity.CAUTION,
            f"All focal lengths together: the keypoints suggest {100 * change:+.1f} ± {100 * std:.1f} %, but the "
            "given ones were used.",
            "Check them, or estimate their common factor (refine 'focal_shared').",
            cameras=names,
            figure=wanted / std,
            limit=_FAR_SIGMAS,
            unit="standard deviations",
            is_cause=evidence.explains_most("lens"),
        )
    elif (unseen := _FAR_SIGMAS * std) > _UNSEEN_FOCAL:
        yield Finding(
            "focal_unchecked",
            Severity.NOTE,
            f"The keypoints would not show focal lengths that are all wrong by up to {100 * min(unseen, 1.0):.0f} %. The "
            "distances of the cameras from the athlete would be wrong by about as much; their std does not contain that.",
            "Calibrate the lenses with care, or record more frames, in which the athlete moves and turns.",
            figure=unseen,
            limit=_UNSEEN_FOCAL,
            unit="share",
        )


def _different(evidence: Evidence, unknown: CameraUnknown, parameter: CameraParameter) -> Iterator[Finding]:
    """Given values that small errors of the keypoints change much, where the keypoints clearly want others."""
    guessed = unknown.family == "lens" and not evidence.observations.intrinsics_known
    if unknown.noticeable_prior_share is not None or unknown.family != "lens" or parameter.refined or guessed:
        return
    difference = (parameter.by_component("suggested") - parameter.by_component("given")).abs()
    far = (difference > parameter.by_component("prior_std")).any(1)
    astray = _focals_astray(evidence)
    limits = astray.double() * (_LEFT_SIGMAS - _CLEAR_SIGMAS) + _CLEAR_SIGMAS
    for camera in (far & (evidence.contradictions[unknown.name] > limits**2)).nonzero().flatten().tolist():
        name = evidence.camera(camera)
        pairs = zip(
            parameter.by_component("suggested")[camera].tolist(), parameter.by_component("given")[camera].tolist(), strict=True
        )
        values = ", ".join(
            f"{component} {_quantity(value, None, unknown.unit)} instead of {_quantity(given, None, unknown.unit)}"
            for component, (value, given) in zip(unknown.components, pairs, strict=True)
        )
        yield Finding(
            f"{unknown.name}_contradicted",
            Severity.SERIOUS if astray[camera] else Severity.CAUTION,
            f"{name}: the keypoints suggest another {unknown.label}: {values}.",
            f"Check it, or estimate it (refine {next(iter(unknown.variants))!r}).",
            cameras=(name,),
            figure=float(evidence.contradictions[unknown.name][camera].sqrt()),
            limit=float(limits[camera]),
            unit="standard deviations",
            is_cause=evidence.explains_most("lens"),
        )


def _focals_astray(evidence: Evidence) -> Tensor:
    """(C,), the cameras whose focal length was estimated far from the given one: it may have taken up another error of the
    lens, most of which it can explain."""
    focal = evidence.unknowns["focal"]
    return (focal.value / focal.given - 1).abs() > _ASTRAY if focal.refined else torch.zeros_like(focal.given, dtype=torch.bool)


def _matters(evidence: Evidence, name: str, difference: float, given: float) -> bool:
    """Whether a wrong value makes the cameras wrong by about 1 %."""
    if name == "focal":
        return abs(difference) > _WRONG_FOCAL * abs(given)
    rate = evidence.ended.frames[0].rate_hz
    return name == "time_offset" and rate is not None and abs(difference) * rate > _WRONG_FRAMES


def _undetermined(evidence: Evidence, unknown: CameraUnknown, parameter: CameraParameter) -> Iterator[Finding]:
    """What was to be estimated and could not be."""
    if not parameter.refined:
        return
    uncertain = parameter.by_component("std") > _OPEN_SHARE * parameter.by_component("prior_std")
    for number, component in enumerate(unknown.components):
        cameras = uncertain[:, number].nonzero().flatten().tolist()
        if cameras:
            names = tuple(map(evidence.camera, cameras))
            yield Finding(
                f"{unknown.name}_undetermined",
                Severity.CAUTION,
                f"{component} stays near the given value: the keypoints do not determine it ({', '.join(names)}).",
                cameras=names,
                limit=_OPEN_SHARE,
                unit="prior standard deviations",
            )


def _quantity(value: float, std: float | None, unit: str) -> str:
    """A value with its standard deviation and unit."""
    factor, unit = (1000, "ms") if unit == "s" else (1, unit)
    number = f"{factor * value:.5g}" if std is None else f"{factor * value:.5g} ± {factor * std:.2g}"
    return f"{number} {unit}".strip()
