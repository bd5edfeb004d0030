"""The scene: motion in a plane, an athlete who is small or stands still, cameras in a line, turned images."""

from __future__ import annotations

from collections.abc import Iterator

import torch

from torchstickcal.quality.evidence import Evidence
from torchstickcal.quality.finding import Finding, Severity
from torchstickcal.quality.registry import findings

_FLAT = 0.02
"""Extent of all points in their thinnest direction over that in the next, below which they lie in a plane."""
_LINE = 0.02
_SMALL = 0.1
"""Height of the athlete as a share of the image."""
_STILL = 0.02
"""Extent of the motion as a share of the athlete's size."""
_TURNED_SHARE = 0.8


@findings("scene", "planar motion, a small or still athlete, cameras in a line, images that are upside down")
def scene(evidence: Evidence) -> Iterator[Finding]:
    """Findings about the scene. What they do to the precision is in the deviations already."""
    points = evidence.points
    known = points.isfinite().all(0)
    if int(known.sum()) < 10:
        return
    cloud = points[:, known]
    extents = torch.linalg.svdvals(cloud - cloud.mean(1, keepdim=True)) / cloud.shape[1] ** 0.5
    if float(extents[2]) < _FLAT * float(extents[1]):
        yield Finding(
            "motion_planar",
            Severity.NOTE,
            "All points lie nearly in one plane, which determines the cameras badly.",
            "Let the athlete turn, and move towards and away from the cameras.",
            figure=float(extents[2] / extents[1]),
            limit=_FLAT,
        )
    if evidence.cameras > 2:
        spread = torch.linalg.svdvals(evidence.centres - evidence.centres.mean(0))
        if float(spread[1]) < _LINE * float(spread[0]):
            yield Finding(
                "cameras_in_line",
                Severity.NOTE,
                "All cameras are nearly on one line: points on this line have no depth.",
                "Put one camera elsewhere, if points near the line matter.",
                figure=float(spread[1] / spread[0]),
                limit=_LINE,
            )
    yield from _size(evidence)
    centred = points - points.nanmean(1, keepdim=True)
    motion = centred.square().nanmean().sqrt()
    if float(motion) < _STILL * float(extents[0]):
        yield Finding(
            "athlete_still",
            Severity.NOTE,
            "The athlete hardly moves, so that every frame says the same again.",
            "Record a motion that fills the volume in which is to be measured.",
            figure=float(motion / extents[0]),
            limit=_STILL,
        )
    yield from _upside_down(evidence)


def _size(evidence: Evidence) -> Iterator[Finding]:
    """Cameras in whose images the athlete is small. Sticks alone do not say how large the athlete is."""
    size = evidence.observations.image_size
    ends = {end for stick in evidence.observations.sticks for end in stick.ends}
    if size is None or len(ends) == evidence.observations.keypoints.shape[2]:
        return
    m = evidence.measurements
    y = m.by_frame(m.pixels[0])[:, 1].double().where(m.by_frame(m.visible[0]), torch.nan)
    heights = y.nan_to_num(-torch.inf).amax(-1) - y.nan_to_num(torch.inf).amin(-1)
    for camera, tall in enumerate(heights):
        share = (
            float(tall[tall > 0].median() / size.double().expand(evidence.cameras, 2)[camera, 1])
            if bool((tall > 0).any())
            else 1.0
        )
        if share < _SMALL:
            name = evidence.camera(camera)
            yield Finding(
                "athlete_small",
                Severity.NOTE,
                f"{name}: the athlete fills {100 * share:.0f} % of the height of the image, so that pixels are worth little.",
                "Move the camera closer, or use a longer focal length.",
                cameras=(name,),
                figure=share,
                limit=_SMALL,
                unit="share",
            )


def _upside_down(evidence: Evidence) -> Iterator[Finding]:
    """Images in which the head is below the feet."""
    names = evidence.observations.point_names or ()
    heads = [i for i, name in enumerate(names) if name in ("nose", "head", "head_top", "neck")]
    feet = [i for i, name in enumerate(names) if name.endswith(("ankle", "heel", "toe"))]
    if not heads or not feet:
        return
    observations = evidence.observations
    heights = observations.keypoints[..., 1].double().where(observations.visible & ~observations.at_corner, torch.nan)
    below = heights[..., heads].nanmean(-1) - heights[..., feet].nanmean(-1)
    for camera, own in enumerate(below):
        own = own[own.isfinite()]
        share = float((own > 0).double().mean()) if len(own) else 0.0
        if share > _TURNED_SHARE:
            name = evidence.camera(camera)
            yield Finding(
                "image_upside_down",
                Severity.NOTE,
                f"{name}: the head is below the feet in {100 * share:.0f} % of the frames: the camera is upside down.",
                "If the video was turned after the intrinsics were estimated, turn their principal point and distortion too.",
                cameras=(name,),
                figure=share,
                limit=_TURNED_SHARE,
                unit="share",
            )
