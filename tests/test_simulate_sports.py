"""Sports found by name: a module of one's own, a new file in the folder; and presets that no new sport changes."""

from __future__ import annotations

import doctest
import hashlib
import importlib
import pkgutil
from pathlib import Path

import numpy as np
import pytest

from torchstickcal import CalibrationError, simulate
from torchstickcal.benchmark.cases import sources
from torchstickcal.cli import main
from torchstickcal.errors import ConfigError
from torchstickcal.simulate import PRESETS, SPORTS, SessionSpec, action, motions, preset, read_simulated, write_simulated

TENNIS = '''
"""Tennis: a forehand."""

from torchstickcal.simulate import SPORTS, Action, Posture, tilted_plane

SPORTS.register(
    "NAME",
    Action(
        stick_m=0.69,
        stick_names=("racket_butt", "racket_tip"),
        grips_m={"right": 0.08},
        plane=tilted_plane(80),
        keys=((0.0, Posture(arms_angle=-60)), (0.5, Posture(arms_angle=50)), (1.0, Posture())),
        period_s=2.0,
        walk_s=(1.1, 1.9),
    ),
)
'''

FINGERPRINTS = {
    "sports-stick-syn": "7b79c826a27a5719",
    "sports-stick-syn-random": "05e8dc20b3e9daca",
    "hard": "8e5728b5eb2176c0",
    "breakdown": "97a261ebe8305ad9",
    "regimes": "bc580f993765560b",
}
"""Of the specifications of each preset."""

KEYPOINTS = [
    ("sports-stick-syn", 100, 1039, (550.6053053882, 604.2832198797), (25, 1), (537.5601902717, 500.3099202616)),
    ("sports-stick-syn-random", 33, 1043, (611.4732854854, 553.1752465499), (24, 19), (676.7857606229, 306.4126315824)),
    ("hard", 7, 1008, (1002.8204965682, 554.9245416901), (30, 9), (1039.7259596691, 544.0534894182)),
    ("hard", 49, 2648, (1036.3705583666, 501.4664134714), (92, 6), (1077.0813094794, 280.3622412824)),
    ("regimes", 5, 5382, (830.7012343410, 545.2693926138), (150, 7), (726.6646402185, 503.0111010781)),
]
"""Of camera 1 of some sessions: preset, session, detected keypoints, their mean, and the keypoint of a frame and point."""


def fingerprint(name: str) -> str:
    lines = (
        f"{s.name} {s.sport} {s.seed} {s.cameras} {s.frames} {s.fps} {s.layout} {s.path} {s.height_m:.6f}" for s in preset(name)
    )
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()[:16]


@pytest.fixture
def tennis(own_parts, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Tennis, registered by a module of the user."""
    (tmp_path / "my_tennis.py").write_text(TENNIS.replace("NAME", "padel"))
    monkeypatch.syspath_prepend(tmp_path)
    importlib.import_module("my_tennis")


def test_a_sport_of_one_s_own_is_simulated(tennis: None, tmp_path: Path):
    assert action("padel").stick_m == 0.69
    out = tmp_path / "sessions"
    assert main(["simulate", "padel", "--out", str(out), "--seed", "3"]) == 0
    session = read_simulated(out / "padel_3.npz")
    assert session.observations.sticks[0].length_m == 0.69
    assert session.observations.point_names is not None
    assert session.observations.point_names[-1] == "racket_tip"


def test_a_sport_of_one_s_own_is_measured(tennis: None, tmp_path: Path):
    """The benchmark finds the regime of a session in front of the sport in its name."""
    write_simulated(tmp_path / "windy2_padel_ring.npz", SessionSpec("any", "padel", cameras=3, frames=10).generate())
    case = sources(str(tmp_path))[0].load()
    assert case is not None
    assert case.regime == "windy"


def test_a_new_file_in_the_folder_is_found(own_parts, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "badminton.py").write_text(TENNIS.replace("NAME", "badminton"))
    monkeypatch.setattr(motions, "__path__", [*motions.__path__, str(tmp_path)])
    monkeypatch.setattr(SPORTS, "_imported", False)
    assert "badminton" in SPORTS
    assert SessionSpec("b", "badminton", cameras=3, frames=5).generate().observations.num_points == 21


def test_an_unknown_sport_is_refused_with_the_known_ones():
    with pytest.raises(ConfigError, match=r"unknown sport.*'golv'.*golf.*wand.*Did you mean 'golf'") as raised:
        action("golv")
    assert isinstance(raised.value, CalibrationError)
    with pytest.raises(CalibrationError, match="unknown sport"):
        SessionSpec("x", "curling").generate()


def test_a_new_sport_changes_no_preset(tennis: None):
    assert "padel" in SPORTS
    assert {name: fingerprint(name) for name in PRESETS} == FINGERPRINTS
    assert not any(spec.sport == "padel" for name in PRESETS for spec in preset(name))


def test_a_new_sport_changes_no_regime(own_parts):
    """Names of layouts, paths and regimes may be names of sports too."""
    case = sources("hard", 3)[2].load()
    assert case is not None
    assert case.name == "hard02_hockey_ring_cam2"
    SPORTS.register("ring", action("golf"))
    assert case.regime == "hard"


@pytest.mark.parametrize(("name", "number", "detected", "mean", "which", "keypoint"), KEYPOINTS)
def test_sessions_of_presets_stay_the_same(
    name: str,
    number: int,
    detected: int,
    mean: tuple[float, float],
    which: tuple[int, int],
    keypoint: tuple[float, float],
):
    pixels = preset(name)[number].generate().observations.keypoints.numpy()[1]
    assert np.isfinite(pixels[..., 0]).sum() == detected
    np.testing.assert_allclose(np.nanmean(pixels, axis=(0, 1)), mean, rtol=0, atol=1e-6)
    np.testing.assert_allclose(pixels[which], keypoint, rtol=0, atol=1e-6)


@pytest.mark.parametrize("name", ["", *(module.name for module in pkgutil.walk_packages(simulate.__path__, "."))])
def test_examples_in_docstrings(name: str):
    assert doctest.testmod(importlib.import_module(f"torchstickcal.simulate{name}")).failed == 0
