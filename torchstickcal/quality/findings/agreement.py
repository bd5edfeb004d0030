"""Cameras that contradict the others, cameras at one place, and cameras whose place is not known."""

from __future__ import annotations

from collections.abc import Iterator

import torch

from torchstickcal.geometry.vectors import directions
from torchstickcal.quality.evidence import DOUBTFUL_SHARE, Evidence, median_distances
from torchstickcal.quality.finding import Finding, Severity
from torchstickcal.quality.registry import findings

_AGREEING_SHARE = 0.55
"""Sound cameras keep 84 % of their keypoints and more, with 20 % of wrong ones 66 %; mirrored or alien ones 27 to 43 %."""
_EVENLY, _LIKE_OTHERS = 0.25, 0.8
"""Largest standard deviation between points of the share that agrees, of cameras whose keypoints are often wrong and not of
something else: those have up to 0.15, mirrored, alien and late ones 0.35 and more. And their least share, relative to the
median of all cameras."""
_SAME_VIEW_RAD = 0.005
"""Mean angle between the rays of two cameras to the same points, below which they see one and the same view."""
_LEAST_PARALLAX_DEG = 3.0
"""Largest mean angle between the rays of two cameras below which depth is hardly known."""
_IMPRECISE_RIG_SHARE, _LOST_RIG_SHARE = 0.02, 0.06
"""Standard deviation of a camera's centre as a share of the rig."""


@findings("agreement", "cameras that contradict the others, that see one view, or of which little is known")
def agreement(evidence: Evidence) -> Iterator[Finding]:
    """Findings about single cameras and pairs of them."""
    if evidence.left_out:
        yield Finding(
            "cameras_left_out",
            Severity.CAUTION,
            "Not calibrated, because they share too few points with the other cameras: " + ", ".join(evidence.left_out) + ".",
            cameras=evidence.left_out,
        )
    if evidence.start_contradicted:
        yield Finding(
            "start_contradicted",
            Severity.NOTE,
            "The keypoints contradict the poses that were given as a start, which were not used.",
            "Check that they are of the same cameras, and that none has been moved since.",
        )
    yield from _stops(evidence)
    yield from _shares(evidence)
    yield from _same_views(evidence)
    yield from _precision(evidence)


def _stops(evidence: Evidence) -> Iterator[Finding]:
    """Stages that did not converge."""
    if not evidence.ended.converged:
        yield Finding(
            "not_converged",
            Severity.FATAL,
            f"The adjustment did not converge: {evidence.ended.status(0)}.",
            "Look at the other findings; without them, allow more iterations (max_iterations).",
        )


def _shares(evidence: Evidence) -> Iterator[Finding]:
    """Cameras of whose keypoints too few agree with those of the other cameras."""
    unknown = ~evidence.ended.agreeing_cameras[0]
    median = float(evidence.agreement.median())
    counts = [m.visible[0].sum(-1).tolist() for m in (evidence.measurements, evidence.kept)]
    for camera, (share, own, left) in enumerate(zip(evidence.agreement.tolist(), *counts, strict=True)):
        name = evidence.camera(camera)
        common = {"cameras": (name,), "figure": share, "unit": "share"}
        if bool(unknown[camera]):
            yield Finding(
                "camera_unknown",
                Severity.FATAL,
                f"{name}: {left} of {own} keypoints agree with the other cameras, so that nothing is known of where it is.",
                "Check that it shows the same athlete at the same time, and that its intrinsics are right.",
                limit=_AGREEING_SHARE,
                **common,
            )
        elif share < _AGREEING_SHARE and float(evidence.uneven[camera]) < _EVENLY and share > _LIKE_OTHERS * median:
            yield Finding(
                "camera_contradicts",
                Severity.CAUTION,
                f"{name}: only {100 * share:.0f} % of its keypoints agree with the other cameras. The others are spread over "
                "all points, as those of a detector that often fails.",
                "Look at its video with the keypoints drawn into it.",
                limit=_AGREEING_SHARE,
                **common,
            )
        elif share < _AGREEING_SHARE:
            yield Finding(
                "camera_contradicts",
                Severity.SERIOUS,
                f"{name}: only {100 * share:.0f} % of its keypoints agree with the other cameras; of a sound camera it is more "
                "than 80 %.",
                "Check that it shows the same athlete at the same time, that the video is not mirrored or turned, and that its "
                "intrinsics are right.",
                limit=_AGREEING_SHARE,
                **common,
            )
        elif bool(evidence.doubtful[camera]):
            yield Finding(
                "camera_doubtful",
                Severity.CAUTION,
                f"{name}: {100 * share:.0f} % of its keypoints agree with the other cameras, clearly fewer than of the others "
                f"({100 * median:.0f} %).",
                "Look at its video with the keypoints drawn into it.",
                limit=DOUBTFUL_SHARE,
                **common,
            )


def _same_views(evidence: Evidence) -> Iterator[Finding]:
    """Pairs of cameras that see the points from the same place, and rigs that have no baseline at all."""
    rays = directions(evidence.state.points - evidence.centres[..., None], dim=1)
    angles = median_distances(rays, evidence.measurements.visible[0])
    same = {pair: angle for pair, angle in angles.items() if angle < _SAME_VIEW_RAD}
    for (first, second), angle in same.items():
        names = (evidence.camera(first), evidence.camera(second))
        yield Finding(
            "same_view",
            Severity.CAUTION if evidence.cameras > 2 else Severity.FATAL,
            f"{names[0]} and {names[1]} see the scene from the same place, so that the pair has no depth.",
            "Check whether the same video was taken for both.",
            cameras=names,
            figure=1000 * angle,
            limit=1000 * _SAME_VIEW_RAD,
            unit="mrad",
            is_cause=True,
        )
    largest = max((min(angle, torch.pi - angle) for angle in angles.values()), default=torch.inf)
    if evidence.cameras > 2 and largest < torch.pi / 180 * _LEAST_PARALLAX_DEG:
        yield Finding(
            "no_baseline",
            Severity.FATAL if largest < _SAME_VIEW_RAD else Severity.SERIOUS,
            "All cameras see the scene from nearly the same place: their rays meet at "
            f"{largest * 180 / torch.pi:.2g} degrees at most, so that depth is hardly known.",
            "Move the cameras apart.",
            figure=largest * 180 / torch.pi,
            limit=_LEAST_PARALLAX_DEG,
            unit="deg",
            is_cause=True,
        )


def _precision(evidence: Evidence) -> Iterator[Finding]:
    """Cameras whose centres are not known well."""
    stds, rig = evidence.centre_std_m, max(evidence.rig_m, 1e-9)
    agreeing = evidence.ended.agreeing_cameras[0]
    for camera, std in enumerate(stds.tolist()):
        if bool(agreeing[camera]) and std > _IMPRECISE_RIG_SHARE * rig:
            lost = std > _LOST_RIG_SHARE * rig
            yield Finding(
                "camera_imprecise",
                Severity.SERIOUS if lost else Severity.CAUTION,
                f"{evidence.camera(camera)}: its centre has a standard deviation of {1000 * std:.3g} mm, "
                f"{100 * std / rig:.1f} % of the size of the rig.",
                "Record a longer motion that fills more of the images, or add cameras.",
                cameras=(evidence.camera(camera),),
                figure=std / rig,
                limit=_LOST_RIG_SHARE if lost else _IMPRECISE_RIG_SHARE,
                unit="share of the rig",
            )
