"""Why a camera contradicts the others, by trial: each explanation is tried, and the one that explains most is said."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

from torchstickcal.quality.evidence import Evidence
from torchstickcal.quality.far import FARTHEST_DEG, moved_far
from torchstickcal.quality.finding import Finding, Severity
from torchstickcal.quality.registry import findings
from torchstickcal.quality.resection import Resection
from torchstickcal.quality.trials import (
    Hypothesis,
    Moving,
    Rest,
    Sight,
    hypotheses,
    moved_within,
    moving_throughout,
    shifted_share,
    sight_of,
    tried,
    without,
)

_SOUND_SHARE, _GAIN, _CLEAR_GAIN = 0.6, 0.15, 0.08
"""Share of keypoints that agree in a sound camera, and the least gain of an explanation over none, where that is wrong and
where it is nearly right."""
_ALIKE, _ALIKE_DISTANCE = 0.05, 1.15
"""Difference of shares, and ratio of distances, up to which the simpler of two explanations is the one."""
_CLOSER, _CLOSER_IF_WRONG = 0.8, 0.9
"""Ratio of distances from which on an explanation with an equal share is better than none: of any camera, and of one whose
intrinsics are surely not as given."""
_WHOLE_SHARE = 0.8
_ALIEN_SHARE = 0.75
"""Share of a camera's keypoints that agree, over that of the others, below which it shows something else."""
_IN_TIME_SHARE = 0.85
_FITTING_SHARE = 0.95
"""The same at another time, from which on the camera shows the same thing then: others do similar things at other times. And
where the camera seems to fit as given."""
_MOVING_SHARE, _MOVING_SPREAD = 0.5, 0.015
"""Share of the keypoints of short parts that agree, each part at its own place, where a camera turns all the time, and how far
these places are apart at most, as a share of the rig. What shows something else has 0.4, or places 0.02 apart and more."""
_MOST_SUSPECTS = 4
_SHARE_OF_NOISE = 0.1
"""Share of agreeing keypoints that is worth as much as noise smaller by the factor e."""
_BEHIND_OTHERS = 0.75
_SUSPECT_SHARE = 0.8
_NOISE_RATIO, _NOISY_MRAD = 0.6, 2.0
"""Noise without a camera, over that with it, from which on the camera contradicts the others however many keypoints agree, and
the noise above which that is looked at."""
_NEAR_SIGMAS = 4.0
"""Median distance of a camera's keypoints from the points of the others, in noise, within which an explanation is one."""


@findings("causes", "why a camera contradicts the others, by trial", tries=True)
def causes(evidence: Evidence) -> Iterator[Finding]:
    """The explanation of what is wrong, if there is one."""
    if evidence.cameras == 2:
        yield from _of_a_pair(evidence)
        return
    agreement = evidence.agreement * (1 - evidence.ended.labels.other_person[0].double().mean(1))
    order = agreement.argsort().tolist()
    suspicious = (evidence.absurd_focals | evidence.off_centre | evidence.misfits).tolist()
    off_centre = [camera for camera in order if evidence.off_centre[camera]]
    at_end = [camera for camera in order if evidence.set_aside_at_end[camera]]
    doubted = [c for c in order if float(agreement[c]) < _SUSPECT_SHARE or suspicious[c]]
    suspects = off_centre or at_end or (doubted if evidence.cameras > 3 else []) or order
    best: tuple[float, int, Rest] | None = None
    for camera in suspects[:_MOST_SUSPECTS]:
        rest = without(evidence, camera)
        if rest is not None and (best is None or _soundness(rest) > best[0]):
            best = _soundness(rest), camera, rest
    if best is None:
        return
    _, camera, rest = best
    worse = bool(evidence.doubtful[camera]) or float(agreement[camera]) < _BEHIND_OTHERS * rest.share
    worse |= bool(evidence.set_aside_at_end[camera])
    noisy = evidence.noise_mrad > _NOISY_MRAD and rest.noise_mrad < _NOISE_RATIO * evidence.noise_mrad
    noisy |= bool(evidence.hidden[camera])
    if rest.share < _SOUND_SHARE or not (worse or noisy or suspicious[camera]):
        return
    if (finding := _explained(evidence, camera, rest, 0.0 if noisy else float(evidence.agreement[camera]))) is not None:
        yield finding


def _soundness(rest: Rest) -> float:
    """How well the cameras of a rig agree. Points of two cameras give way to errors, so that noise counts as much as shares."""
    return rest.share - _SHARE_OF_NOISE * math.log(max(rest.noise_mrad, 1e-3))


def _explained(evidence: Evidence, camera: int, rest: Rest, agreement: float) -> Finding | None:
    """What is wrong with the camera without which the others agree; None if nothing is.

    Args:
        evidence: of the session.
        camera: which.
        rest: the others.
        agreement: share of the camera's keypoints that agree in the result; 0 where its noise is so large that this says
            nothing.
    """
    sight, name = sight_of(evidence, camera), evidence.camera(camera)
    plain = rest.placed(sight)
    as_given = 0.0 if plain is None else plain[0].share

    def cause(code: str, what: str, advice: str, share: float, is_cause: bool = True) -> Finding:
        return Finding(
            code,
            Severity.SERIOUS,
            f"{name}: {what} ({100 * share:.0f} % of them; {100 * as_given:.0f} % as given).",
            advice,
            cameras=(name,),
            figure=share,
            limit=_SOUND_SHARE,
            unit="share",
            is_cause=is_cause,
        )

    found = [(h, placed[0]) for h in hypotheses() if (placed := rest.placed(h.changed(sight))) is not None]
    best = _best(found)
    if best is not None and not _explains(best[1], None if plain is None else plain[0], bool(evidence.absurd_focals[camera])):
        best = None
    moved = moved_within(rest, sight) if as_given < _WHOLE_SHARE or best is not None else None
    finding = None
    if moved is not None:
        before, after = ((place.rotation, place.translation) for place in moved[1:])
        finding = moved_far(evidence, camera, moved[0], before, after)
    if best is not None and (moved is None or finding is None or not _closer(moved[1:], best[1])):
        hypothesis, placed = best
        return cause(hypothesis.code, hypothesis.what, hypothesis.advice, placed.share)
    if finding is not None:
        return finding
    misfit, seems_to_fit = bool(evidence.misfits[camera]), as_given > _SOUND_SHARE
    if seems_to_fit and not misfit:
        if as_given < agreement + _CLEAR_GAIN:
            return None
        return cause(
            "camera_misplaced",
            "its keypoints agree with the other cameras at another place than the one that was found",
            "Calibrate the other cameras first, or give a session in which this camera shares more with them.",
            as_given,
            is_cause=False,
        )
    later, share = shifted_share(rest, sight, evidence.ended.frames[0].rate_hz)
    gain, in_time = (_CLEAR_GAIN, _FITTING_SHARE) if seems_to_fit else (_GAIN, _IN_TIME_SHARE)
    if later and share > max(_SOUND_SHARE, in_time * rest.share, as_given + gain):
        word = "later" if later > 0 else "earlier"
        return cause(
            "clock_apart",
            f"its frames show what the other cameras see {abs(later)} frames {word}: so moved, its keypoints agree",
            "Estimate the time offsets (refine 'time_offset'), or cut its video to begin with the others.",
            share,
        )
    if agreement > _ALIEN_SHARE * rest.share and not misfit:
        return None
    moving = None if seems_to_fit else moving_throughout(rest, sight)
    if moving is not None and _follows(moving, as_given, evidence.rig_m):
        return cause(
            "camera_moving",
            f"it turns all the time, by up to {moving.angle_deg:.2g} degrees, as a camera that follows the athlete: in short "
            "parts of the session, its keypoints agree at a place of their own",
            "Use a camera that stands still, or leave it out.",
            moving.share,
        )
    return cause(
        "camera_alien",
        "its keypoints fit the other cameras at no place as theirs fit each other, neither mirrored, turned, scaled nor moved "
        "in time: it shows another person or another recording",
        "Check which person the detector follows in this camera, and whether the video belongs to this session.",
        max([as_given, *(placed.share for _, placed in found)]),
    )


def _best(found: list[tuple[Hypothesis, Resection]]) -> tuple[Hypothesis, Resection] | None:
    """The explanation by which most keypoints agree; of several that are alike, the closest, or the simplest."""
    largest = max((placed.share for _, placed in found), default=0.0)
    alike = [one for one in found if one[1].share >= largest - _ALIKE]
    least = min((placed.distance_sigmas for _, placed in alike), default=0.0)
    return next((one for one in alike if one[1].distance_sigmas <= _ALIKE_DISTANCE * least), None)


def _explains(placed: Resection, plain: Resection | None, surely_wrong: bool) -> bool:
    """Whether a camera as it would be by an explanation fits the others clearly better than as given.

    Args:
        placed: by the explanation.
        plain: as given.
        surely_wrong: whether its intrinsics are surely not as given.
    """
    if placed.share < _SOUND_SHARE or placed.distance_sigmas > _NEAR_SIGMAS or plain is None:
        return placed.share > _SOUND_SHARE and placed.distance_sigmas < _NEAR_SIGMAS
    ratio = _CLOSER_IF_WRONG if surely_wrong else _CLOSER
    closer = placed.share > plain.share - _ALIKE and placed.distance_sigmas < ratio * plain.distance_sigmas
    gain = _GAIN if plain.share < _SOUND_SHARE else _CLEAR_GAIN
    return closer or placed.share > plain.share + gain


def _follows(moving: Moving, as_given: float, rig_m: float) -> bool:
    """Whether a camera that was placed in short parts of the session turned all the time, and showed the same as the others."""
    near = moving.angle_deg < FARTHEST_DEG and moving.spread_m < _MOVING_SPREAD * rig_m
    return near and moving.share > max(_MOVING_SHARE, as_given + _GAIN)


def _closer(places: Sequence[Resection], single: Resection) -> bool:
    """Whether a camera fits the others at two places as often as at one by another explanation, and clearly closer."""
    farthest, least = max(one.distance_sigmas for one in places), min(one.share for one in places)
    return least > single.share - _ALIKE and farthest < _CLOSER * single.distance_sigmas


def _of_a_pair(evidence: Evidence) -> Iterator[Finding]:
    """With two cameras, each explanation needs a calibration of its own."""
    observations = evidence.observations
    noise = evidence.noise_mrad
    for hypothesis in hypotheses():
        for camera in range(2):
            changed: Sight = hypothesis.changed(sight_of(evidence, camera))
            keypoints, matrix = observations.keypoints.clone(), observations.cameras.matrix.clone()
            keypoints[camera] = changed.keypoints.to(keypoints)
            matrix[camera] = changed.camera.matrix[0]
            trial = replace(observations, keypoints=keypoints, intrinsics=matrix)
            ended = tried(trial, evidence.config, (), must_converge=True)
            if ended is None:
                continue
            share = float(ended.kept.visible.sum() / ended.measurements.visible.sum().clamp_min(1))
            own = 1000 * float(ended.last.sigma_px[0].median() / ended.measurements.cameras.focal_px.mean())
            if share > _SOUND_SHARE and own < _NOISE_RATIO * noise and share > float(evidence.agreement.mean()) - 0.02:
                name = evidence.camera(camera)
                yield Finding(
                    hypothesis.code,
                    Severity.SERIOUS,
                    f"{name}, or the other camera: {hypothesis.what} ({100 * share:.0f} % of them).",
                    hypothesis.advice,
                    cameras=(name,),
                    figure=share,
                    limit=_SOUND_SHARE,
                    unit="share",
                    is_cause=True,
                )
                return
    yield Finding(
        "pair_contradicts",
        Severity.SERIOUS,
        "The two cameras contradict each other, and no explanation that was tried makes them agree: they may show different "
        "persons or different recordings.",
        "Check which person the detector follows in each camera, and that both videos belong to this session.",
        cameras=tuple(map(evidence.camera, range(2))),
        is_cause=True,
    )
