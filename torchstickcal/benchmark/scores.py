"""Errors of one configuration on sessions with known truth."""

from __future__ import annotations

from dataclasses import dataclass
from statistics import fmean, median
from typing import Any

from torchstickcal.benchmark.baselines import Estimate, Inputs
from torchstickcal.benchmark.cases import Source
from torchstickcal.benchmark.external import ExternalPoses
from torchstickcal.benchmark.run import errors_of
from torchstickcal.config import Config
from torchstickcal.errors import CalibrationError
from torchstickcal.pipeline.calibrate import calibrate


@dataclass(frozen=True)
class SequenceScore:
    """Errors of one session, averaged over its cameras; None if it could not be calibrated."""

    name: str
    rotation_deg: float | None
    translation_m: float | None
    seconds: float | None
    """run time of the calibration; None for poses from elsewhere"""
    status: str
    """``converged``, or why not"""


def score_sequence(source: Source, config: Config) -> SequenceScore | None:
    """Calibrate a session and compare the result with the truth.

    Args:
        source: of the session.
        config: the configuration.

    Returns:
        The errors; None for a session without truth. If the session cannot be read or calibrated, the errors are None and the
        status says why.
    """
    try:
        case = source.load()
        if case is None:
            return None
        calibration = calibrate(case.observations, config)
    except CalibrationError as error:
        return SequenceScore(source.name, None, None, 0.0, f"{type(error).__name__}: {error}")
    errors = errors_of(Estimate.of_calibration(calibration), case)
    seconds = calibration.seconds["total"]
    return SequenceScore(source.name, errors.mean_rotation_deg, errors.mean_translation_m, seconds, calibration.status)


def score_external(source: Source, external: ExternalPoses) -> SequenceScore | None:
    """Compare poses from elsewhere with the truth of a session; arguments and result as of :func:`score_sequence`."""
    try:
        case = source.load()
        if case is None:
            return None
        estimate = external(Inputs(case.observations, case=case.name))
    except CalibrationError as error:
        return SequenceScore(source.name, None, None, None, f"{type(error).__name__}: {error}")
    errors = errors_of(estimate, case)
    status = "size fitted to the truth" if estimate.up_to_scale else "metric"
    return SequenceScore(source.name, errors.mean_rotation_deg, errors.mean_translation_m, None, status)


def summarise(scores: list[SequenceScore]) -> dict[str, Any]:
    """All scores, and their means over the sessions that could be calibrated, as a dictionary that can be written as JSON."""
    rotations = [score.rotation_deg for score in scores if score.rotation_deg is not None]
    translations = [score.translation_m for score in scores if score.translation_m is not None]
    times = [score.seconds for score in scores if score.seconds is not None]
    return {
        "sequences": [vars(score) for score in scores],
        "mean_rotation_deg": fmean(rotations) if rotations else None,
        "mean_translation_m": fmean(translations) if translations else None,
        "median_seconds": median(times) if times else None,
        "converged": sum(score.status == "converged" for score in scores),
    }
