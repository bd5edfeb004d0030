"""Known lengths, and the closed-form scale that they give (the paper's stage 2)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchstickcal.config import Config, ScaleSettings
from torchstickcal.errors import ConfigError, ObservationError
from torchstickcal.model.measurements import Measurements
from torchstickcal.pipeline.height import BETWEEN_HEAD_AND_ANKLES, segments_of, standing_in

_OUTLIER_CUT = 3.5
_MAD_TO_SIGMA = 1.4826
_ALIKE = 0.03
"""Difference of the logarithms of two lengths that agree."""
_MAJORITY, _LEAST_SHARE, _LEAST_FRAMES = 2.0, 0.2, 5
"""Lengths that agree with each other, over those that agree with the known one, from which on they are believed instead; least
share of all lengths, and least number."""


@dataclass(frozen=True)
class Ruler:
    """A known length: the distance between the means of two groups of points, on average over the session.

    A rigid ruler has the same length in every frame, so that frames in which it seems to have another are outliers.
    """

    start: tuple[int, ...]
    end: tuple[int, ...]
    lengths_m: Tensor
    """(B,), one for each session"""
    rigid: bool

    def known(self, measurements: Measurements) -> Tensor:
        """(B, F), whether two cameras see each of its points."""
        return measurements.by_frame(measurements.active)[..., [*self.start, *self.end]].all(-1)

    def measured_m(self, measurements: Measurements, points: Tensor) -> Tensor:
        """Its length in every frame (B, F), NaN where not all its points are known, of points (B, 3, N), metres."""
        by_frame, known = measurements.by_frame(points), self.known(measurements)
        vectors = by_frame[..., list(self.end)].mean(-1) - by_frame[..., list(self.start)].mean(-1)
        return vectors.square().sum(1).where(known, 1.0).sqrt().where(known, torch.nan)


def rulers(measurements: Measurements, config: Config) -> list[Ruler]:
    """What the scale comes from: the configuration's ``scale``, else the sticks among the points that take part, else the body
    height.

    Raises:
        ConfigError: if there is neither.
        ObservationError: if ``scale`` names a point that the session does not have, or if the height says nothing of its
            points.
    """
    if config.scale is not None:
        return [_given(config.scale, measurements)]
    sticks = zip(measurements.sticks.tolist(), measurements.lengths_m.unbind(1), strict=True)
    if found := [Ruler((start,), (end,), length_m, rigid=True) for (start, end), length_m in sticks]:
        return found
    if config.height_m is not None:
        length = torch.full_like(measurements.cameras.focal_px[:, 0], config.height_m)
        parts = segments_of(measurements.point_names)
        return [Ruler(part.start, part.end, part.share * length, part.rigid) for part in parts]
    raise ConfigError(
        "nothing sets the scale",
        where="scale",
        got=f"no stick, points = {config.points!r}",
        expected="a stick among the points that take part, a body height, or a [scale] table with a known length",
        remedy="Give the stick with --stick, or the athlete's height with --height.",
    )


def _given(scale: ScaleSettings, measurements: Measurements) -> Ruler:
    """The length of a configuration; where a skeleton lacks the head or feet of its points, another point takes their place."""
    ends: list[tuple[int, ...]] = []
    higher: list[float] = []
    for names in (scale.start, scale.end):
        found = [standing_in(name, measurements.point_names) for name in names]
        ends.append(tuple(measurements.point_index(point) for point, _ in found))
        higher.append(sum(height for _, height in found) / max(len(found), 1))
    length_m = scale.length_m * (1 + (higher[0] - higher[1]) / BETWEEN_HEAD_AND_ANKLES)
    return Ruler(ends[0], ends[1], torch.full_like(measurements.cameras.focal_px[:, 0], length_m), rigid=False)


def ending_in_scale(config: Config, num_sticks: int) -> Config:
    """The configuration for a session: where a body height sets the scale, the cameras are brought to scale last."""
    if not height_sets_scale(config, num_sticks):
        return config
    free = [name for name, stage in config.stages.items() if stage.cameras == "free"]
    return replace(config, stages={n: replace(s, rescale=s.rescale or n in free[-1:]) for n, s in config.stages.items()})


def height_sets_scale(config: Config, num_sticks: int) -> bool:
    """Whether the scale comes from a body height, because there is nothing better."""
    return config.height_m is not None and config.scale is None and (num_sticks == 0 or config.points == "joints")


def check_scale(measurements: Measurements, known: Sequence[Ruler]) -> None:
    """Refuse sessions in which the rulers set no scale.

    Raises:
        ObservationError: if in some session there is no frame in which two cameras see each point of a ruler.
    """
    if not bool(torch.stack([ruler.known(measurements).any(1) for ruler in known]).any(0).all()):
        raise ObservationError(
            "the points whose distance sets the scale are never seen in the same frame",
            where="scale",
            got="no frame",
            expected="a frame in which two cameras see each of them",
        )


def scale_factors(measurements: Measurements, points: Tensor, known: Sequence[Ruler]) -> tuple[Tensor, Tensor]:
    """Known over mean reconstructed length, (B,), and whether it is reconstructed in any frame, (B,); the factor is 1 if not.

    Frames in which a rigid ruler is an outlier are left out.

    Args:
        measurements: the sessions.
        points: (B, 3, N), up to scale.
        known: the rulers.
    """
    measured, expected = points.new_zeros(measurements.sessions), points.new_zeros(measurements.sessions)
    for ruler in known:
        lengths = ruler.measured_m(measurements, points)
        if ruler.rigid:
            median = lengths.nanmedian(1, keepdim=True).values
            deviation = (lengths - median).abs()
            limit = _OUTLIER_CUT * _MAD_TO_SIGMA * deviation.nanmedian(1, keepdim=True).values + 1e-12 * median
            lengths = lengths.where(deviation <= limit, torch.nan)
        measured += lengths.nansum(1)
        expected += ruler.lengths_m * lengths.isfinite().sum(1)
    reconstructed = (measured > 0) & measured.isfinite()
    return expected.where(reconstructed, 1.0) / measured.where(reconstructed, 1.0), reconstructed


def outvoted_factors(measurements: Measurements, points: Tensor, known: Sequence[Ruler]) -> Tensor:
    """Known over reconstructed length, (B,), where clearly more lengths agree on another scale than on the present one; else 1.

    Where ends are often wrong, a robust loss of the length may have settled where a few wrong lengths are right by chance.

    Args:
        measurements: the sessions.
        points: (B, 3, N), to scale.
        known: the rulers.
    """
    ratios = [r.measured_m(measurements, points) / r.lengths_m[:, None] for r in known if r.rigid]
    if not ratios:
        return points.new_ones(measurements.sessions)
    logs = torch.cat(ratios, dim=1).log().nan_to_num(torch.inf, torch.inf, torch.inf).sort(1).values
    finite = logs.isfinite()
    first, last = (torch.searchsorted(logs, (logs + shift).contiguous()) for shift in (-_ALIKE, _ALIKE))
    votes, winner = (last - first).where(finite, 0).max(1, keepdim=True)
    alike = finite & ((logs - logs.gather(1, winner)).abs() <= _ALIKE)
    agreeing = (finite & (logs.abs() <= _ALIKE)).sum(1)
    least = (_LEAST_SHARE * finite.sum(1)).clamp_min(_LEAST_FRAMES)
    clear = (votes[:, 0] > _MAJORITY * agreeing) & (votes[:, 0] >= least)
    mean = logs.where(alike, 0.0).sum(1) / alike.sum(1).clamp_min(1)
    return (-mean).exp().where(clear, 1.0)
