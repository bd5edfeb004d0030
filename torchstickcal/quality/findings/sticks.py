"""Sticks and scale: lengths that contradict each other or the keypoints, and a scale that little determines."""

from __future__ import annotations

from collections.abc import Iterator

from torchstickcal.losses import ReprojectionLoss
from torchstickcal.model.objective import Objective
from torchstickcal.pipeline.scale import height_sets_scale
from torchstickcal.quality.evidence import Evidence
from torchstickcal.quality.finding import Finding, Severity
from torchstickcal.quality.registry import findings
from torchstickcal.solvers.elimination.normal_equations import NormalEquations

_WRONG_LENGTH_SHARE, _WRONG_LENGTH_SIGMAS = 0.02, 4.0
"""Deviation of a stick's length from the given one, as a share of it and in tolerances, beyond which it is not the stick."""
_FEW_FRAMES = 10
_IMPRECISE_SCALE, _UNKNOWN_SCALE = 0.01, 0.1
_WORSE_END = 3.0
"""Noise of one end over that of the other."""
_INSIDE_SHARE, _LEAST_LENGTHS = 0.7, 20
"""Share of lengths inside their 95 % intervals, below which the lengths contradict their own deviations."""
_WRONG_SHARE = 0.5
"""Share of lengths that are wrong by more than 6 standard deviations, from which on they are not those of a stick: 20 % at most
in sound sessions."""


@findings("sticks", "lengths that contradict each other, and a scale that little determines")
def sticks(evidence: Evidence) -> Iterator[Finding]:
    """Findings about sticks and the scale."""
    if len(evidence.measurements.sticks) > 1:
        yield from _contradicted(evidence)
    yield from _scale(evidence)
    yield from _offsets(evidence)
    yield from _ends(evidence)
    yield from _lengths(evidence)


def _contradicted(evidence: Evidence) -> Iterator[Finding]:
    """Sticks whose given lengths contradict each other: by the keypoints alone, they have others."""
    kept = evidence.kept
    reprojection = Objective(kept, {"reprojection": ReprojectionLoss(evidence.ended.last.sigma_px[:, None, None])})
    step = NormalEquations(reprojection, evidence.state, cameras_free=False).step()
    lengths_m = kept.stick_lengths_m(evidence.state.points + step.points)[0].nanmedian(0).values.tolist()
    for ends, given, sigma, length in zip(
        kept.sticks.tolist(), kept.lengths_m[0].tolist(), kept.stick_sigma_m.tolist(), lengths_m, strict=True
    ):
        limit = max(_WRONG_LENGTH_SHARE * given, _WRONG_LENGTH_SIGMAS * sigma)
        if abs(length - given) > limit:
            names = tuple(map(evidence.point, ends))
            yield Finding(
                "stick_lengths_contradict",
                Severity.SERIOUS,
                f"The stick {' - '.join(names)} is {length:.4g} m long by the keypoints, but {given:.4g} m was given.",
                "Check the lengths of all sticks, and which points are their ends. If a point lies inside the end of its "
                "stick, as a grip that the hands hide, give its offset, or say that it is unknown (--stick-offset).",
                points=names,
                figure=abs(length - given),
                limit=limit,
                unit="m",
                is_cause=True,
            )


def _scale(evidence: Evidence) -> Iterator[Finding]:
    """A scale that few frames determine, that is not known well, or for which a body height was given in vain."""
    kept, config = evidence.kept, evidence.config
    if config.height_m is not None and not height_sets_scale(config, len(kept.sticks)):
        yield Finding(
            "height_unused",
            Severity.NOTE,
            f"A length that is known better sets the scale: the body height of {config.height_m:g} m is not used.",
            "Leave the height out.",
        )
    if len(kept.sticks):
        frames = int(kept.stick_active[0].any(-1).sum())
        if frames < _FEW_FRAMES < kept.frames:
            yield Finding(
                "scale_from_few_frames",
                Severity.CAUTION,
                f"The scale comes from {frames} of {kept.frames} frames: in the others no two cameras see both ends "
                "of a stick.",
                "Check the keypoints of the stick's ends, and lower the detector's threshold for them.",
                figure=frames,
                limit=_FEW_FRAMES,
                unit="frames",
            )
    std = evidence.scale_std
    if std > _IMPRECISE_SCALE:
        unknown = std > _UNKNOWN_SCALE
        yield Finding(
            "scale_imprecise",
            Severity.SERIOUS if unknown else Severity.CAUTION,
            f"The scale has a standard deviation of {100 * std:.1f} %: all distances are uncertain by this share.",
            "Measure the stick's length better (Stick.sigma_m), and record it for longer and closer to the cameras."
            if len(kept.sticks)
            else "Record a stick of known length: nothing else gives a scale that is better than a few per cent.",
            figure=std,
            limit=_UNKNOWN_SCALE if unknown else _IMPRECISE_SCALE,
            unit="share",
        )


def _offsets(evidence: Evidence) -> Iterator[Finding]:
    """Ends that are detected inside their stick by an unknown distance: what it is, or that nothing tells."""
    observations = evidence.observations
    known = any(stick.unknown_end is None for stick in observations.sticks)
    for stick in observations.sticks:
        if not isinstance(stick.unknown_end, int):
            continue
        name = evidence.point(stick.unknown_end)
        if not known:
            yield Finding(
                "stick_offset_undetermined",
                Severity.SERIOUS,
                f"How far {name} lies inside the end of its stick is not known, and no other length is: the offset and the "
                "length are one number, the scale. The offset is taken for 0. Each centimetre of it makes all distances "
                f"{1 / stick.between_m:.2g} % too long.",
                "Give a second length: a mark on the stick and its distance from the other end, or another stick.",
                points=(name,),
            )
            continue
        start, end = evidence.points[..., list(stick.ends)].unbind(-1)
        lengths = (end - start).norm(dim=0)
        lengths = lengths[lengths.isfinite()]
        if len(lengths) < 2:
            continue
        offset = stick.between_m - float(lengths.median())
        variance = (evidence.scale_std * stick.between_m) ** 2 + stick.sigma_m**2 + float(lengths.var()) / len(lengths)
        yield Finding(
            "stick_offset",
            Severity.NOTE,
            f"{name} is detected {offset:.4f} m inside the end of its stick, with a standard deviation of "
            f"{variance**0.5:.4f} m.",
            f"Give this offset for recordings of this stick alone (--stick-offset {name} {offset:.4f}).",
            points=(name,),
            figure=offset,
            unit="m",
        )


def _ends(evidence: Evidence) -> Iterator[Finding]:
    """Sticks of which one end is seen much worse than the other."""
    for start, end in evidence.kept.sticks.tolist():
        noise = evidence.sigma_px[[start, end]]
        ratio = float(noise.max() / noise.min().clamp_min(1e-9))
        if ratio > _WORSE_END:
            worse = evidence.point((start, end)[int(noise.argmax())])
            yield Finding(
                "stick_end_noisy",
                Severity.NOTE,
                f"The end {worse} of the stick has {ratio:.2g} times the noise of the other end, and determines how well the "
                "scale is known.",
                "Mark it better, or use a stick both ends of which the detector finds well.",
                points=(worse,),
                figure=ratio,
                limit=_WORSE_END,
            )


def _lengths(evidence: Evidence) -> Iterator[Finding]:
    """Lengths, predicted by cameras that did not see them, that contradict their own deviations."""
    for errors in evidence.acceptance.lengths if evidence.acceptance else ():
        share = errors.wrong / max(1, errors.frames)
        if errors.frames >= _LEAST_LENGTHS and share > _WRONG_SHARE:
            yield Finding(
                "stick_not_rigid",
                Severity.SERIOUS,
                f"{100 * share:.0f} % of the lengths of {errors.stick} in frames that took no part are wrong by more than 6 "
                "standard deviations: what was detected as its ends does not keep its distance.",
                "Look at the videos with the keypoints drawn into them: does the detector follow the ends of the stick?",
                points=tuple(errors.stick.split(" - ")),
                figure=share,
                limit=_WRONG_SHARE,
                unit="share",
                is_cause=True,
            )
        elif errors.frames >= _LEAST_LENGTHS and errors.inside < _INSIDE_SHARE:
            yield Finding(
                "lengths_outside",
                Severity.CAUTION,
                f"Of the lengths of {errors.stick} in frames that took no part, {100 * errors.inside:.0f} % are inside their "
                f"95 % intervals; their standard deviation is {1000 * errors.std_m:.3g} mm.",
                "The keypoints of its ends have errors that last, or the cameras are less precise than is said.",
                points=tuple(errors.stick.split(" - ")),
                figure=errors.inside,
                limit=_INSIDE_SHARE,
                unit="share",
            )
