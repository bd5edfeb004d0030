"""Images and intrinsics that do not belong together, and the same video for two cameras."""

from __future__ import annotations

import math
from collections.abc import Iterator

import torch

from torchstickcal.quality.evidence import Evidence, median_distances
from torchstickcal.quality.finding import Finding, Severity
from torchstickcal.quality.registry import findings

_OFF_CENTRE = 0.25
"""Distance of the principal point from the middle of the image, as a share of half the image, from which on the intrinsics
belong to other images: lenses are centred to a few per cent."""
_SQUARE = 1.1
"""Ratio of the focal lengths of x and y, either way, up to which pixels are square: careful calibrations differ by 1 %."""
_OUTSIDE_SHARE = 0.05
_SAME_PX = 1.0
"""Median distance of the keypoints of two cameras below which it is one video. Different cameras have different noise."""


@findings("images", "intrinsics of other images, and the same video twice", direct=True)
def images(evidence: Evidence) -> Iterator[Finding]:
    """Findings about images and intrinsics."""
    yield from _intrinsics(evidence)
    yield from _proportions(evidence)
    yield from _off_centre(evidence)
    yield from _same_video(evidence)


@findings("outside", "keypoints outside the image")
def outside(evidence: Evidence) -> Iterator[Finding]:
    """Cameras many of whose keypoints lie outside the image: those of other images, or of another scene."""
    observations = evidence.observations
    if observations.image_size is None or not observations.intrinsics_known:
        return
    size = observations.image_size.double().expand(evidence.cameras, 2)
    keypoints = observations.keypoints.double()
    far = ((keypoints < -0.1 * size[:, None, None]) | (keypoints > 1.1 * size[:, None, None])).any(-1) & observations.visible
    share = far.flatten(1).sum(1) / observations.visible.flatten(1).sum(1).clamp_min(1)
    for camera in (share > _OUTSIDE_SHARE).nonzero().flatten().tolist():
        name = evidence.camera(camera)
        yield Finding(
            "keypoints_outside_image",
            Severity.SERIOUS,
            f"{name}: {100 * float(share[camera]):.0f} % of its keypoints lie far outside its images.",
            "Check the image size, and the resolution at which the detector ran.",
            cameras=(name,),
            figure=float(share[camera]),
            limit=_OUTSIDE_SHARE,
            unit="share",
            is_cause=True,
        )


def _intrinsics(evidence: Evidence) -> Iterator[Finding]:
    observations = evidence.observations
    size = observations.image_size
    if size is None or not observations.intrinsics_known:
        return
    size = size.double().expand(evidence.cameras, 2)
    centre = observations.cameras.matrix[:, :2, 2]
    off = (2 * centre / size - 1).abs().amax(-1)
    turned = (2 * centre / size.flip(-1) - 1).abs().amax(-1)
    for camera in (off > _OFF_CENTRE).nonzero().flatten().tolist():
        name, (width, height) = evidence.camera(camera), size[camera].long().tolist()
        x, y = centre[camera].tolist()
        factor = float((size[camera] / 2 / centre[camera].clamp_min(1e-9)).mean())
        scaled = (2 * factor * centre[camera] / size[camera] - 1).abs().amax() < _OFF_CENTRE / 2
        if float(turned[camera]) < _OFF_CENTRE / 2:
            code, what = "intrinsics_turned", "as if the image were turned by 90 degrees"
        elif bool(scaled):
            code, what = "intrinsics_other_resolution", f"as those of images {1 / factor:.3g} times as large"
        else:
            code, what = "principal_point_off_centre", "as of no usual camera, unless the images are parts of larger ones"
        yield Finding(
            code,
            Severity.CAUTION if code == "principal_point_off_centre" else Severity.SERIOUS,
            f"{name}: the principal point of its intrinsics is ({x:.0f}, {y:.0f}), but its images are {width} x {height} "
            f"pixels: {what}.",
            "Give the intrinsics of the images that the detector saw.",
            cameras=(name,),
            figure=float(off[camera]),
            limit=_OFF_CENTRE,
            unit="half images",
            is_cause=code != "principal_point_off_centre",
        )


def _proportions(evidence: Evidence) -> Iterator[Finding]:
    """Cameras whose focal lengths of x and y differ, as where images were resized to other proportions."""
    ratio = evidence.observations.cameras.matrix[:, [0, 1], [0, 1]]
    ratio = ratio[:, 0] / ratio[:, 1]
    for camera in (ratio.log().abs() > math.log(_SQUARE)).nonzero().flatten().tolist():
        name = evidence.camera(camera)
        yield Finding(
            "pixels_not_square",
            Severity.CAUTION,
            f"{name}: its focal lengths of x and y differ by a factor of {float(ratio[camera]):.3g}, as where images were "
            "resized without keeping their proportions. Nearly all cameras have square pixels.",
            "Give the intrinsics of the images that the detector saw.",
            cameras=(name,),
            figure=float(ratio[camera]),
            limit=_SQUARE,
        )


def _off_centre(evidence: Evidence) -> Iterator[Finding]:
    """Cameras whose keypoints lie where the images of their intrinsics are not: the more so where their errors last."""
    for camera in evidence.off_centre.nonzero().flatten().tolist():
        x, y = evidence.observations.cameras.matrix[camera, :2, 2].tolist()
        name, lasting = evidence.camera(camera), bool(evidence.errors_last_alone[camera])
        yield Finding(
            "keypoints_off_centre",
            Severity.SERIOUS if lasting else Severity.CAUTION,
            f"{name}: its keypoints lie to one side of the principal point of its intrinsics, ({x:.0f}, {y:.0f}), or far from "
            "it, as where the intrinsics are those of images of another size"
            + (
                ", and their errors stay alike from frame to frame, while those of the other cameras do not."
                if lasting
                else "."
            ),
            "Check that the detector saw images of the size that the intrinsics are for.",
            cameras=(name,),
        )


def _same_video(evidence: Evidence) -> Iterator[Finding]:
    """Pairs of cameras whose keypoints are the same in the image."""
    m = evidence.measurements
    frames = torch.linspace(0, m.frames - 1, min(m.frames, 200)).long()
    pixels, seen = m.by_frame(m.pixels[0])[:, :, frames].double(), m.by_frame(m.visible[0])[:, frames]
    for (first, second), distance in median_distances(pixels.flatten(2), seen.flatten(1)).items():
        if distance < _SAME_PX:
            names = (evidence.camera(first), evidence.camera(second))
            yield Finding(
                "same_video",
                Severity.FATAL if evidence.cameras == 2 else Severity.SERIOUS,
                f"{names[0]} and {names[1]} have the same keypoints within {distance:.2g} px: one video was taken for both.",
                "Give each camera its own video.",
                cameras=names,
                figure=distance,
                limit=_SAME_PX,
                unit="px",
                is_cause=True,
            )
