"""Recorded sessions: the paper's data and two real ones. Skipped where the recordings are absent."""

from __future__ import annotations

import statistics
from pathlib import Path

import pytest

from torchstickcal import calibrate, load_config
from torchstickcal.benchmark import Source, score_sequence, sources, summarise
from torchstickcal.io import read_session
from torchstickcal.metrics import pose_errors

LIMIT_DEG, LIMIT_M = 0.00488, 0.000370
"""Maximum likelihood on these 36 sequences."""


@pytest.fixture(scope="module")
def sequences(data: Path) -> tuple[Source, ...]:
    return sources(str(data / "sports_stick_syn"))


@pytest.mark.parametrize(
    ("config", "rotation_deg", "translation_m"),
    [
        ("default", 1.02 * LIMIT_DEG, 1.03 * LIMIT_M),
        pytest.param("lbfgs", 1.02 * LIMIT_DEG, 1.03 * LIMIT_M, marks=pytest.mark.slow),
        ("paper", 1.1 * LIMIT_DEG, 1.1 * LIMIT_M),
        ("stick_only", 0.018, 0.001),
        ("human_only", 0.0062, 0.015),
    ],
)
def test_sports_stick_syn(sequences: tuple[Source, ...], config: str, rotation_deg: float, translation_m: float):
    settings = load_config(config)
    summary = summarise([score for source in sequences if (score := score_sequence(source, settings))])
    assert summary["converged"] == len(sequences)
    assert summary["mean_rotation_deg"] <= rotation_deg
    assert summary["mean_translation_m"] <= translation_m


@pytest.mark.parametrize("config", ["default", "paper"])
def test_both_solvers_agree(sequences: tuple[Source, ...], config: str):
    for source in sequences[::4]:
        case = source.load()
        assert case is not None
        observations = case.observations
        settings = {"extends": config, "stages": {name: {"reject_sigmas": False} for name in load_config(config).stages}}
        ours, theirs = calibrate(observations, settings), calibrate(observations, settings | {"solver": "lbfgs"})
        cost, other = (calibration.stages[-1].iterations[-1].cost for calibration in (ours, theirs))
        assert cost == pytest.approx(other, rel=1e-5)  # several times the tolerance of the last stage


def test_wand(data: Path):
    """Three lights on a rod; the middle one is no part of the stick, and its distances were never fitted."""
    observations, truth = read_session(data / "real" / "ewand.npz")
    calibration = calibrate(observations)
    assert calibration.converged
    lights = calibration.points
    for first, second, length_m in ((0, 1, 0.130), (1, 2, 0.260)):
        measured = (lights[:, first] - lights[:, second]).norm(dim=-1).nanmean().item()
        assert measured == pytest.approx(length_m, rel=0.005)
    assert truth is not None
    errors = pose_errors(calibration.rotations, calibration.translations, truth.rotations, truth.translations)
    assert errors.mean_rotation_deg < 0.2
    assert errors.mean_translation_m < 0.021


def test_board_and_person(data: Path):
    """Two corners of a board are the stick; two others, never fitted, are as far apart."""
    observations, _ = read_session(data / "real" / "caliscope_board_and_person.npz")
    calibration = calibrate(observations)
    assert calibration.converged
    corners = calibration.points[:, [2, 9]]
    measured = [length for length in (corners[:, 0] - corners[:, 1]).norm(dim=-1).tolist() if length == length]
    assert statistics.mean(measured) == pytest.approx(observations.sticks[0].length_m, rel=0.01)
