"""The verdict on a calibration, with its reasons, and the acceptance test in millimetres."""

from __future__ import annotations

import enum
import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass, fields
from typing import Any

from torchstickcal.files import without_nan
from torchstickcal.quality.finding import Finding, Severity


class Verdict(enum.StrEnum):
    """Whether a result can be used.

    Example:
        >>> Verdict.USABLE.acceptable, Verdict.POOR.acceptable, str(Verdict.POOR)
        (True, False, 'poor')
    """

    GOOD = "good"
    """nothing speaks against it"""
    USABLE = "usable"
    """with the care that the findings ask for"""
    POOR = "poor"
    """probably wrong, or much less precise than it could be"""
    FAILED = "failed"
    """it, or a part of it, must not be used"""

    @property
    def acceptable(self) -> bool:
        """Whether the result can be used: good or usable."""
        return self in (Verdict.GOOD, Verdict.USABLE)


_VERDICTS = dict(zip(Severity, Verdict, strict=True))
"""The verdict on a result whose worst finding has a severity."""


@dataclass(frozen=True)
class LengthErrors:
    """Errors of the lengths of one stick, each predicted by cameras that did not see it (VDI/VDE 2634).

    Lengths are in metres.
    """

    stick: str
    """the names of its ends"""
    given_m: float
    frames: int
    """number of lengths"""
    wrong: int
    """number of them that are wrong, by more than 6 standard deviations: they are in ``inside``, but not in the errors"""
    largest_m: float
    """the error of largest absolute value"""
    mean_m: float
    std_m: float
    """standard deviation of the measured lengths, the wand deviation"""
    inside: float
    """share of the lengths inside their own 95 % interval"""
    volume_m: tuple[float, float, float]
    """extent of the volume in which the stick was, largest first"""


@dataclass(frozen=True)
class Acceptance:
    """How well lengths and keypoints are predicted that took no part in the calibration."""

    lengths: tuple[LengthErrors, ...]
    """one for each stick"""
    metre_m: float
    """half the width of the 95 % interval of a length of 1 m, measured in one frame where the sticks were, metres"""
    calibration_share: float
    """share of the calibration in the variance of that length; the rest is that of the keypoints"""
    reprojection_px: float
    """root mean square distance between projections and keypoints, pixels"""
    reprojection_mrad: float
    """the same as an angle, milliradians"""
    ray_distance_m: float
    """median distance between a point and the ray of a keypoint, metres"""
    left_out_px: tuple[float, ...]
    """root mean square distance between the keypoints of each camera and the points of all others, pixels; NaN where there are
    no others"""
    by_focal_m: float = math.nan
    """root mean square distance by which cameras are misplaced, relative to the first one, where each given focal length is
    wrong by 1 %, metres; their standard deviations do not contain it. NaN where focal lengths were estimated"""

    def __post_init__(self) -> None:
        for name in ("metre_m", "calibration_share", "reprojection_px", "reprojection_mrad", "ray_distance_m", "by_focal_m"):
            value = getattr(self, name)
            object.__setattr__(self, name, value if math.isfinite(value) else math.nan)

    @property
    def sentence(self) -> str:
        """The result in one sentence."""
        if not self.metre_m < float("inf"):
            return "How right a length is that is measured here cannot be said: no stick was seen well enough."
        calibration = round(100 * self.calibration_share)
        return (
            f"A length of 1 m measured here is right to ± {1000 * self.metre_m:.3g} mm (95 %): {calibration} % calibration, "
            f"{100 - calibration} % keypoints."
        )

    @property
    def focal_sentence(self) -> str:
        """What wrong intrinsics would do, in one sentence; empty where focal lengths were estimated."""
        if math.isnan(self.by_focal_m):
            return ""
        return (
            "The std of the cameras takes the given focal lengths as right: if they are wrong by 1 %, cameras are misplaced by "
            f"about {1000 * self.by_focal_m:.2g} mm."
        )


@dataclass(frozen=True)
class Quality:
    """Whether a calibration can be used, and why.

    Args:
        findings: what was found, causes and severe findings first.
        acceptance: errors in millimetres; None where nothing could be tested.

    Example:
        >>> from torchstickcal import calibrate
        >>> from torchstickcal.simulate import Noise, golf_session
        >>> observations, truth = golf_session(cameras=4, frames=60, noise=Noise(1.0))
        >>> quality = calibrate(observations).quality
        >>> print(quality.verdict)
        good
        >>> quality.acceptance.metre_m < 0.02
        True
    """

    findings: tuple[Finding, ...]
    acceptance: Acceptance | None = None

    @staticmethod
    def of(findings: Iterable[Finding], acceptance: Acceptance | None = None) -> Quality:
        """The findings in their order: causes of what is serious first, then the most severe."""
        every = list(findings)
        worst = max((finding.severity for finding in every), default=Severity.NOTE)
        causes = max((finding.severity for finding in every if finding.is_cause), default=Severity.NOTE)
        least = min(Severity.SERIOUS, max(causes, Severity.CAUTION)) if worst >= Severity.SERIOUS else Severity.SERIOUS

        def place(finding: Finding) -> tuple[bool, int, bool]:
            explains = finding.is_cause and finding.severity >= least
            return not explains, -finding.severity, not finding.is_cause

        return Quality(tuple(sorted(every, key=place)), acceptance)

    @property
    def verdict(self) -> Verdict:
        """By the most severe finding."""
        return _VERDICTS[max((finding.severity for finding in self.findings), default=Severity.NOTE)]

    @property
    def reasons(self) -> tuple[Finding, ...]:
        """The findings because of which the verdict is not better; none where it is good."""
        worst = max((finding.severity for finding in self.findings), default=Severity.NOTE)
        return tuple(finding for finding in self.findings if finding.severity == worst > Severity.NOTE)

    def as_json(self) -> dict[str, Any]:
        """The quality as JSON can hold it; :meth:`from_json` reads it back."""
        acceptance = None
        if self.acceptance is not None:
            acceptance = without_nan(asdict(self.acceptance)) | {"sentence": self.acceptance.sentence}
        return {
            "verdict": self.verdict.value,
            "findings": [finding.as_json() for finding in self.findings],
            "acceptance": acceptance,
        }

    @staticmethod
    def from_json(content: dict[str, Any]) -> Quality:
        """A quality from what :meth:`as_json` gave."""
        findings = tuple(map(Finding.from_json, content["findings"]))
        given = content["acceptance"]
        if given is None:
            return Quality(findings)
        values = {field.name: given.get(field.name) for field in fields(Acceptance)}
        numbers = {name: _number(value) for name, value in values.items() if name not in ("lengths", "left_out_px")}
        lengths = tuple(_length_errors(one) for one in values["lengths"])
        return Quality(findings, Acceptance(lengths=lengths, left_out_px=tuple(map(_number, values["left_out_px"])), **numbers))


def _length_errors(content: dict[str, Any]) -> LengthErrors:
    numbers = {name: _number(content[name]) for name in ("given_m", "largest_m", "mean_m", "std_m", "inside")}
    x, y, z = map(_number, content["volume_m"])
    return LengthErrors(
        stick=str(content["stick"]), frames=int(content["frames"]), wrong=int(content["wrong"]), volume_m=(x, y, z), **numbers
    )


def _number(value: Any) -> float:
    return float("nan") if value is None else float(value)
