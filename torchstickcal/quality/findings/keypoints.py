"""Keypoints: label errors, wrong ones, unused ones, noisy ones, and values that are no pixels."""

from __future__ import annotations

from collections.abc import Iterator

from torchstickcal.observations import Doubt
from torchstickcal.pipeline.relabel import exchanges
from torchstickcal.quality.evidence import Evidence
from torchstickcal.quality.finding import Finding, Severity
from torchstickcal.quality.registry import findings

_USELESS_FOCAL_SHARE = 0.03
_REJECTED_SHARE = 0.4
"""Sound sessions with 20 % of wrong keypoints lose up to 30 %."""
_OTHER_PERSON_SHARE = 0.2
_CORNER_SHARE = 0.02
_STOPPED_SHARE = 0.8
"""Share of a camera's frames that are copies of the frame before, from which on hardly anything is left of its video."""
_WHOLE_PX_NOISE = 0.6
"""Noise, in pixels, below which the rounding of whole pixels, which has a standard deviation of 0.29, matters."""
_NOISY_MRAD = 10.0
"""Good detectors have 1 to 4; mirrored or alien cameras raise the noise of all to 10 and more."""


@findings("keypoints", "label errors, wrong, unused and noisy keypoints, and values that are no pixels", direct=True)
def keypoints(evidence: Evidence) -> Iterator[Finding]:
    """Findings about keypoints."""
    yield from _values(evidence)
    yield from _labels(evidence)
    yield from _used(evidence)
    yield from _noise(evidence)


def _values(evidence: Evidence) -> Iterator[Finding]:
    """Keypoints at (0, 0), frames that are copies, and whole numbers of pixels."""
    observations = evidence.observations
    for doubt in observations.doubts:
        severity, limit = _severity(doubt)
        yield Finding(
            doubt.code,
            severity,
            doubt.meaning,
            doubt.advice,
            cameras=(doubt.camera,) if doubt.camera else (),
            figure=doubt.share,
            limit=limit,
            unit="share",
            is_cause=severity > Severity.NOTE,
        )
    given = observations.keypoints[observations.visible]
    noise = float(evidence.sigma_px.median())
    if len(given) and noise < _WHOLE_PX_NOISE and bool((given == given.round()).all()):
        yield Finding(
            "whole_pixels",
            Severity.NOTE,
            f"All keypoints are whole numbers of pixels, but their noise is only {noise:.2g} px, so that "
            "rounding is a part of it.",
            "Write the keypoints with decimals.",
            figure=noise,
            limit=_WHOLE_PX_NOISE,
            unit="px",
        )


def _severity(doubt: Doubt) -> tuple[Severity, float]:
    """What a doubt about the input means for the result, and the limit that this follows from."""
    if doubt.code == "keypoints_at_corner":
        return (Severity.SERIOUS if doubt.share > _CORNER_SHARE else Severity.NOTE), _CORNER_SHARE
    if doubt.share <= doubt.negligible:
        return Severity.NOTE, doubt.negligible
    return (Severity.SERIOUS if doubt.share > _STOPPED_SHARE else Severity.CAUTION), doubt.negligible


def _labels(evidence: Evidence) -> Iterator[Finding]:
    """Label errors that were undone, and frames that show another person."""
    observations, labels = evidence.observations, evidence.ended.labels
    frames = observations.num_frames
    for exchange in exchanges(observations.point_names, [stick.ends for stick in observations.sticks]):
        for camera, count in enumerate(labels.exchanged_frames(exchange)[0].sum(-1).tolist() if exchange.whole else ()):
            if count:
                yield Finding(
                    "labels_exchanged",
                    Severity.NOTE,
                    f"{evidence.camera(camera)}: {exchange.what} were exchanged in {count} of {frames} frames, and corrected.",
                    cameras=(evidence.camera(camera),),
                    figure=count,
                    limit=0,
                    unit="frames",
                )
    for camera, count in enumerate(labels.other_person[0].sum(-1).tolist()):
        if count and camera not in evidence.changes_at_end:
            yield Finding(
                "other_person",
                Severity.SERIOUS if count > _OTHER_PERSON_SHARE * frames else Severity.NOTE,
                f"{evidence.camera(camera)}: {count} of {frames} frames were set aside: all their keypoints contradict the "
                "other cameras, as if they showed another person.",
                "Check which person the detector follows in this camera." if count > _OTHER_PERSON_SHARE * frames else "",
                cameras=(evidence.camera(camera),),
                figure=count / frames,
                limit=_OTHER_PERSON_SHARE,
                unit="share",
            )


def _used(evidence: Evidence) -> Iterator[Finding]:
    """Keypoints that were set aside: those that no second camera saw, and those that contradict the others."""
    observations, ended = evidence.observations, evidence.ended
    frames, measurements = ended.frames[0], ended.measurements
    seen = observations.visible & ~frames.to_own(ended.labels.other_person[0], False)[..., None]
    compared = frames.to_own(measurements.by_frame(measurements.visible[0]), False)
    used = frames.to_own(measurements.by_frame(ended.last.inliers[0]), False)
    total, alone = int(observations.visible.sum()), int(seen.sum() - compared.sum())
    if alone:
        yield Finding(
            "keypoints_unused",
            Severity.NOTE,
            f"{alone} of {total} keypoints were set aside: no second camera saw the point in that frame.",
            figure=alone / total,
            unit="share",
        )
    contradict, comparable = int(compared.sum() - used.sum()), int(compared.sum())
    if contradict:
        share = contradict / comparable
        yield Finding(
            "keypoints_rejected",
            Severity.CAUTION if share > _REJECTED_SHARE else Severity.NOTE,
            f"{contradict} of {total} keypoints were set aside: they contradict the others ({100 * share:.1f} % of those that "
            "could be compared).",
            figure=share,
            limit=_REJECTED_SHARE,
            unit="share",
        )


def _noise(evidence: Evidence) -> Iterator[Finding]:
    """Points, or all keypoints, with too much noise."""
    focal = evidence.measurements.cameras.focal_px.mean()
    noisy = (evidence.sigma_px > _USELESS_FOCAL_SHARE * focal).nonzero().flatten().tolist()
    if noisy:
        names = tuple(map(evidence.point, noisy))
        sticks = evidence.kept.sticks.tolist()
        without_scale = bool(sticks) and all(set(ends) & set(noisy) for ends in sticks)
        effect = (
            "the points not reliable, and so is the scale, which comes from them"
            if without_scale
            else "the points not reliable"
        )
        yield Finding(
            "points_noisy",
            Severity.SERIOUS if without_scale else Severity.CAUTION,
            f"The keypoints of these points are too noisy, and {effect}: {', '.join(names)}.",
            "Look at the videos with the keypoints drawn into them: does the detector follow these points?",
            points=names,
            figure=float(evidence.sigma_px.max()),
            limit=float(_USELESS_FOCAL_SHARE * focal),
            unit="px",
        )
    if evidence.noise_mrad > _NOISY_MRAD:
        yield Finding(
            "noise_large",
            Severity.SERIOUS,
            f"The keypoints contradict each other by {float(evidence.sigma_px.median()):.3g} px ({evidence.noise_mrad:.2g} "
            "mrad) on average, several times more than those of a good detector.",
            "Look at the videos with the keypoints drawn into them, and check the intrinsics.",
            figure=evidence.noise_mrad,
            limit=_NOISY_MRAD,
            unit="mrad",
        )
