"""Methods found by name: a baseline of one's own in the list of methods, on the command line and in the tables."""

from __future__ import annotations

import dataclasses
import doctest
import importlib
import pkgutil
from pathlib import Path

import pytest

from torchstickcal import benchmark
from torchstickcal.benchmark import BASELINES, METHODS, Estimate, Inputs, Listing, Row, baseline, method
from torchstickcal.benchmark.configurations import LISTINGS
from torchstickcal.benchmark.run import CONVERGED, read_rows
from torchstickcal.benchmark.tables import efficiency, failures, inputs, state_of_the_art, success
from torchstickcal.cli import main
from torchstickcal.config import config_names
from torchstickcal.errors import CalibrationError, ConfigError

OWN = '''
"""A method of one's own: the configuration for the stick alone, which also wants to know a height."""

from torchstickcal import calibrate
from torchstickcal.benchmark import Estimate, Inputs, Listing, PublishedErrors, baseline


@baseline(
    "toy",
    Listing("Toy", {"sota": PublishedErrors(0.5, 0.1), "inputs": None}, reasons=("It is a toy.",)),
    needs=("height_m",),
    title_in_motion="Toy, in motion",
)
def toy(inputs: Inputs) -> Estimate:
    return Estimate.of_calibration(calibrate(inputs.observations, "stick_only"))
'''

ROW = Row(
    place="here", case="a", regime="0.1 px", cameras=3, frames=50, noise_px=0.1, method="toy", outcome=CONVERGED,
    status="converged", rotation_deg=0.01, translation_m=0.001, bound_rotation_deg=0.005, bound_translation_m=0.0005,
    seconds=0.1, input_bytes=50_000, peak_resident_bytes=None, peak_tensor_bytes=None,
)  # fmt: skip


@pytest.fixture
def toy(own_parts, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A baseline that a module of the user registers."""
    (tmp_path / "my_baseline.py").write_text(OWN)
    monkeypatch.syspath_prepend(tmp_path)
    importlib.import_module("my_baseline")


def test_the_methods_and_their_order():
    shipped = [
        "default", "lbfgs", "paper", "without_length", "without_smoothness", "stick_only",
        "human_height", "human_guessed_low", "human_guessed_high", "human_only", "human_bones",
        "aruco_cube", "calib_person", "extra_calib", "kineo", "ewand",
        "human_height_in_motion", "calib_person_in_motion", "extra_calib_in_motion", "kineo_in_motion",
        "default_5_frames", "default_10_frames", "default_20_frames",
    ]  # fmt: skip
    assert [name for name in METHODS if name in shipped] == shipped
    assert set(LISTINGS) == set(config_names())
    assert {name for name, method in METHODS.items() if method.profiled} == {"default", "paper"}


def test_the_rows_of_the_papers_tables_and_their_order():
    rows = [dataclasses.replace(ROW, method=name) for name in METHODS]
    shipped = [
        "ArUco cube",
        "CalibPerson",
        "CalibPerson, true mean height in motion",
        "ExtraCalib",
        "ExtraCalib, true mean height in motion",
        "Kineo",
        "Kineo, true mean height in motion",
        "eWand",
        "torchstickcal, `paper` (the published method)",
        "torchstickcal, `lbfgs`",
        "torchstickcal, `default`",
    ]
    assert [line[0] for line in state_of_the_art(rows).rows if line[0] in shipped] == shipped
    shipped = [
        "Human, true stature",
        "Human, true mean height in motion",
        "Human, stature - 0.1 m and + 0.1 m",
        "Human, 1.72 m for everybody",
        "Human, true bone lengths",
        "Stick, given length",
        "torchstickcal, `paper` (the published method)",
        "torchstickcal, `default`",
    ]
    assert [line[0] for line in inputs(rows).rows if line[0] in shipped] == shipped


def test_a_baseline_of_one_s_own_is_a_method(toy: None):
    assert METHODS["toy"].title == "Toy"
    assert METHODS["toy_in_motion"].height_in_motion
    assert list(METHODS).index("toy") > list(METHODS).index("ewand")
    assert method("toy").estimate is BASELINES["toy"]


def test_a_baseline_of_one_s_own_is_in_all_tables(toy: None):
    rows = [ROW, dataclasses.replace(ROW, method="toy_in_motion"), dataclasses.replace(ROW, method="default")]
    table = state_of_the_art(rows)
    assert [line[0] for line in table.rows[:3]] == ["Toy", "Toy, in motion", METHODS["default"].title]
    assert table.rows[0][1:] == pytest.approx((0.01, 1.0, 0.5, 100.0, "1 of 1"))
    assert table.note.endswith("[Toy] It is a toy.")
    assert [line[0] for line in inputs(rows).rows] == ["Toy", "Toy, in motion", METHODS["default"].title]
    assert [line[0] for line in efficiency(rows).rows] == [METHODS["default"].title, "Toy", "Toy, in motion"]
    assert success(rows, "regime", lambda row: row.regime).rows[1] == ("Toy", "100 %")
    failed = dataclasses.replace(ROW, outcome="not converged", status="why")
    assert failures([failed]).rows == (("Toy", "not converged", "why", 1),)


def test_a_baseline_of_one_s_own_runs_from_the_command_line(toy: None, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    out = tmp_path / "out"
    assert main(["benchmark", "sports-stick-syn", "--count", "1", "--out", str(out), "--methods", "toy,toy_in_motion"]) == 0
    assert [(row.method, row.outcome) for row in read_rows(out / "rows.jsonl")] == [
        ("toy", CONVERGED),
        ("toy_in_motion", CONVERGED),
    ]
    assert "| Toy |" in (out / "benchmark.md").read_text()
    assert main(["benchmark", "hard", "--out", str(out), "--methods", "toi"]) == 2
    assert "Did you mean 'toy'?" in capsys.readouterr().err


def test_what_cannot_be_registered(own_parts):
    def estimate(inputs: Inputs) -> Estimate:
        raise NotImplementedError

    with pytest.raises(ConfigError, match=r"unknown table .*'state_of_the_art'.*sota, inputs, ablation"):
        Listing("Wrong", {"state_of_the_art": None})  # type: ignore[dict-item]
    with pytest.raises(ConfigError, match=r"unknown input .*'heigth_m'.*height_m"):
        baseline("wrong", Listing("Wrong"), needs=("heigth_m",))(estimate)
    with pytest.raises(ConfigError, match=r"the name is taken .*baseline.*'kineo'"):
        baseline("kineo", Listing("Kineo, again"))(estimate)
    baseline("kineo", Listing("Kineo, again"), replace=True)(estimate)
    assert METHODS["kineo"].title == "Kineo, again"
    baseline("default", Listing("Mine"))(estimate)
    with pytest.raises(CalibrationError, match=r"name of a configuration.*'default'"):
        method("kineo")


@pytest.mark.parametrize("name", ["", *(module.name for module in pkgutil.walk_packages(benchmark.__path__, "."))])
def test_examples_in_docstrings(name: str):
    assert doctest.testmod(importlib.import_module(f"torchstickcal.benchmark{name}")).failed == 0
