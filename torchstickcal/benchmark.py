"""The paper's measure over a folder of sessions with known truth."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from torchstickcal.config import Config
from torchstickcal.errors import CalibrationError, FileFormatError
from torchstickcal.io import read_session
from torchstickcal.metrics import pose_errors
from torchstickcal.pipeline import calibrate

_SUFFIXES = {".npz", ".pkl"}


@dataclass(frozen=True)
class SequenceScore:
    """One session's errors; None where it could not be calibrated."""

    name: str
    rotation_deg: float | None
    translation_m: float | None
    seconds: float
    status: str


def session_files(folder: Path) -> list[Path]:
    """The sessions of a folder, by name.

    Raises:
        FileFormatError: if there is none.
    """
    files = sorted(path for path in folder.iterdir() if path.suffix in _SUFFIXES)
    if not files:
        raise FileFormatError("no sessions", where=str(folder), got="no such file", expected="files .npz or .pkl")
    return files


def score_sequence(path: Path, config: Config) -> SequenceScore | None:
    """Calibrate a session and compare with its truth; None if it carries none.

    A session that cannot be read or calibrated is scored without errors, its status saying why.
    """
    try:
        observations, truth = read_session(path)
        if truth is None:
            return None
        calibration = calibrate(observations, config)
    except CalibrationError as error:
        return SequenceScore(path.stem, None, None, 0.0, f"{type(error).__name__}: {error}")
    errors = pose_errors(calibration.rotations, calibration.translations, truth.rotations, truth.translations)
    seconds = calibration.seconds["total"]
    return SequenceScore(path.stem, errors.mean_rotation_deg, errors.mean_translation_m, seconds, calibration.status)


def summarise(scores: list[SequenceScore]) -> dict[str, Any]:
    """All scores and their means over the sessions that could be calibrated, as JSON can hold them."""
    rotations = [score.rotation_deg for score in scores if score.rotation_deg is not None]
    translations = [score.translation_m for score in scores if score.translation_m is not None]
    return {
        "sequences": [vars(score) for score in scores],
        "mean_rotation_deg": _mean(rotations),
        "mean_translation_m": _mean(translations),
        "median_seconds": float(torch.tensor([score.seconds for score in scores]).median()) if scores else None,
        "converged": sum(score.status == "converged" for score in scores),
    }


def _mean(values: list[float]) -> float | None:
    return sum(values) / len(values) if values else None
