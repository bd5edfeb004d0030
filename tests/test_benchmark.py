"""The benchmark: the bound, tables of rows with known means, repeated runs, files, and methods of one's own."""

from __future__ import annotations

import csv
import dataclasses
import json
import signal
import subprocess
import sys
import time
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
import torch

from torchstickcal import CalibrationError, calibrate
from torchstickcal.benchmark import (
    BASELINES,
    METHODS,
    Baseline,
    Case,
    Listing,
    Row,
    camera_bound,
    method,
    run_benchmark,
    sources,
    write_results,
)
from torchstickcal.benchmark.memory import memory_needed
from torchstickcal.benchmark.page import markdown
from torchstickcal.benchmark.run import CONVERGED, FAILED, LACKS_INPUT, ROWS_FILE, measure, read_rows
from torchstickcal.benchmark.tables import (
    ablation,
    by_cameras,
    by_frames,
    efficiency,
    failures,
    inputs,
    memory,
    run_time,
    state_of_the_art,
    success,
    tables,
)
from torchstickcal.cli import main
from torchstickcal.config import config_names
from torchstickcal.errors import FileFormatError
from torchstickcal.io import write_npz
from torchstickcal.metrics import pose_errors
from torchstickcal.simulate import SessionSpec, write_simulated
from torchstickcal.simulate.regimes import GaussianNoise

SPEC = SessionSpec("circle_golf_noise0.5_cam3", "golf", cameras=3, frames=12, fps=10.0, regimes=(GaussianNoise(0.5),))


def row(**changes) -> Row:
    made = Row(
        place="here", case="a", regime="0.1 px", cameras=3, frames=50, noise_px=0.1, method="default", outcome=CONVERGED,
        status="converged", rotation_deg=0.01, translation_m=0.001, bound_rotation_deg=0.005, bound_translation_m=0.0005,
        seconds=0.1, input_bytes=50_000, peak_resident_bytes=4_000_000, peak_tensor_bytes=1_000_000,
    )  # fmt: skip
    return dataclasses.replace(made, **changes)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    place = tmp_path / "sessions"
    place.mkdir()
    write_simulated(place / f"{SPEC.name}.npz", SPEC.generate())
    return place


def case_of(spec: SessionSpec) -> Case:
    session = spec.generate()
    return Case(session.name, session.observations, session.truth, session.inliers, session.sigma_px)


# --- the bound ---------------------------------------------------------------------------------------------------------------


def test_maximum_likelihood_attains_the_bound():
    """Over drawn noise: the mean error of the default over the bound is 1, within three standard errors."""
    errors, bound = [], camera_bound(case_of(SPEC))
    assert bound is not None
    truth = SPEC.generate().truth

    perfect = dataclasses.replace(SPEC, regimes=()).generate().observations
    for seed in range(25):
        noise = 0.5 * np.random.default_rng(seed).standard_normal(perfect.keypoints.shape)
        given = dataclasses.replace(perfect, keypoints=perfect.keypoints.numpy() + noise)
        found = calibrate(given)
        error = pose_errors(found.rotations, found.translations, truth.rotations, truth.translations)
        errors.append((error.mean_rotation_deg / bound.rotation_deg, error.mean_translation_m / bound.translation_m))
    mean, standard_error = np.mean(errors, axis=0), np.std(errors, axis=0) / np.sqrt(len(errors))
    assert (np.abs(mean - 1) < 3 * standard_error + 0.05).all()


def test_the_bound_grows_with_the_noise_and_falls_with_the_frames():
    case = case_of(SPEC)
    assert case.sigma_px is not None
    one, twice = camera_bound(case), camera_bound(dataclasses.replace(case, sigma_px=2 * case.sigma_px))
    assert one is not None
    assert twice is not None
    assert twice.rotation_deg == pytest.approx(2 * one.rotation_deg, rel=0.01)
    assert twice.translation_m == pytest.approx(2 * one.translation_m, rel=0.01)
    few = camera_bound(case.first(3))
    assert few is not None
    assert few.translation_m > 1.4 * one.translation_m


def test_outliers_do_not_count_for_the_bound():
    case = case_of(SPEC)
    assert case.inliers is not None
    half = np.ones_like(case.inliers)
    half[:, ::2] = False
    cut = dataclasses.replace(case.observations, keypoints=np.where(half[..., None], case.observations.keypoints, np.nan))
    assert camera_bound(dataclasses.replace(case, inliers=half)) == camera_bound(dataclasses.replace(case, observations=cut))


def test_no_bound_without_truth_or_for_a_camera_without_inliers():
    case = case_of(SPEC)
    assert case.inliers is not None
    blind = case.inliers.copy()
    blind[2] = False
    assert camera_bound(dataclasses.replace(case, inliers=blind)) is None
    assert camera_bound(dataclasses.replace(case, sigma_px=None)) is None
    assert camera_bound(dataclasses.replace(case, truth=dataclasses.replace(case.truth, points=None))) is None


def test_the_bound_of_the_papers_data(data: Path):
    """Maximum likelihood attains 0.0049 degrees and 0.36 mm at 0.3 px, mean over all cameras and sports."""
    names = ("trajectory_circle_golf_noise0.3_cam5", "trajectory_figure8_baseball_noise0.3_cam5")
    found = [source for source in sources(str(data / "sports_stick_syn")) if source.name in names]
    bounds = [bound for source in found if (case := source.load()) and (bound := camera_bound(case))]
    assert len(bounds) == 2
    assert np.mean([bound.rotation_deg for bound in bounds]) == pytest.approx(0.0049, rel=0.15)
    assert np.mean([bound.translation_m for bound in bounds]) == pytest.approx(0.00036, rel=0.15)


# --- cases and methods -------------------------------------------------------------------------------------------------------


def test_every_configuration_and_baseline_is_a_method():
    assert set(config_names()) <= set(METHODS)
    assert {"aruco_cube", "kineo", "ewand", "human_height_in_motion"} <= set(METHODS)
    with pytest.raises(CalibrationError, match="unknown method"):
        method("magic")


def test_cases_of_a_folder_and_of_a_preset(folder: Path):
    (source,) = sources(str(folder))
    case = source.load()
    assert case is not None
    assert (case.noise_px, case.regime) == (0.5, "0.5 px")
    assert case.sigma_px is not None
    assert [source.name for source in sources("hard", 2)] == ["hard00_golf_hemisphere_cam2", "hard01_baseball_random_cam2"]
    hard = sources("hard", 1)[0].load()
    assert hard is not None
    assert (hard.noise_px, hard.regime) == (None, "hard")
    with pytest.raises(CalibrationError, match="no such folder, preset or sport"):
        sources("nowhere")


def test_a_height_in_motion_is_less_than_the_stature():
    case = dataclasses.replace(case_of(SPEC), height_m=1.76)
    assert METHODS["human_height"].inputs(case).height_m == 1.76
    in_motion = METHODS["human_height_in_motion"].inputs(case).height_m
    assert in_motion is not None
    assert 1.4 < in_motion < 1.76


def test_memory_of_a_call():
    def call():
        kept = torch.ones(2_000_000)
        return (kept * 2).sum()

    needed = memory_needed(call)
    assert 16_000_000 <= needed.tensor_bytes < 17_000_000
    assert needed.resident_bytes is None or needed.resident_bytes > 15_000_000


# --- running -----------------------------------------------------------------------------------------------------------------


def test_existing_measurements_are_not_repeated(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    out, names = tmp_path / "out", ["default", "aruco_cube"]
    first = run_benchmark("sessions", sources(str(folder)), names, out)
    assert [(row.method, row.outcome) for row in first] == [("default", CONVERGED), ("aruco_cube", LACKS_INPUT)]
    assert first[0].translation_m is not None
    assert 0 < first[0].translation_m < 0.05
    before = (out / ROWS_FILE).read_bytes()

    measured = []
    monkeypatch.setattr("torchstickcal.benchmark.run.measure", lambda *which: measured.append(which[2]) or measure(*which))
    assert run_benchmark("sessions", sources(str(folder)), names, out) == first
    assert measured == []
    assert (out / ROWS_FILE).read_bytes() == before

    (out / ROWS_FILE).write_bytes(before[:-20])
    again = run_benchmark("sessions", sources(str(folder)), names, out)
    assert measured == ["aruco_cube"]
    assert again == first
    assert len(read_rows(out / ROWS_FILE)) == 2


def test_results_of_other_cases_are_refused(folder: Path, tmp_path: Path):
    run_benchmark("sessions", sources(str(folder)), ["aruco_cube"], tmp_path / "out")
    with pytest.raises(CalibrationError, match="results of another benchmark"):
        run_benchmark("elsewhere", sources(str(folder)), ["aruco_cube"], tmp_path / "out")
    with pytest.raises(CalibrationError, match="no process"):
        run_benchmark("sessions", sources(str(folder)), [], tmp_path / "out", jobs=0)
    (tmp_path / "out" / ROWS_FILE).write_text('{"nonsense": 1}\n')
    with pytest.raises(FileFormatError, match="not a file of measurements"):
        read_rows(tmp_path / "out" / ROWS_FILE)


def test_a_method_that_raises_has_failed(folder: Path, monkeypatch: pytest.MonkeyPatch):
    def broken(inputs):
        raise ZeroDivisionError("by zero")

    monkeypatch.setattr(BASELINES, "_things", {**BASELINES, "broken": Baseline(broken, Listing("Broken"))})
    found = measure("sessions", sources(str(folder))[0], "broken")
    assert found is not None
    assert (found.outcome, found.status, found.translation_m) == (FAILED, "ZeroDivisionError: by zero", None)
    (folder / "broken.pkl").write_bytes(b"\x80\x04 nonsense")
    damaged = measure("sessions", sources(str(folder))[0], "default")
    assert damaged is not None
    assert "damaged" in damaged.status


# --- tables ------------------------------------------------------------------------------------------------------------------


def test_means_stand_beside_the_published_ones():
    rows = [row(), row(case="b", rotation_deg=0.03, translation_m=0.003), row(method="kineo", translation_m=0.05)]
    found = {line[0]: line[1:] for line in state_of_the_art(rows).rows}
    assert found[METHODS["default"].title] == pytest.approx((0.02, 2.0, None, None, "2 of 2"))
    assert found[METHODS["kineo"].title] == pytest.approx((0.01, 50.0, 0.075, 98.0, "1 of 1"))
    assert list(found)[:2] == ["Kineo", METHODS["default"].title]
    assert found["HSfM: not run, needs images and trained weights"] == (None, None, 0.193, 117.0, None)
    assert found["VGGT: not run, needs images and trained weights"] == (None, None, None, None, None)
    assert "[Kineo] A height error of 1 % changes" in state_of_the_art(rows).note


def test_variances_of_inputs():
    rows = [row(method="human_guessed_low", translation_m=0.001), row(method="human_guessed_high", translation_m=0.003)]
    (line,) = inputs(rows).rows
    assert line[1:7] == pytest.approx((0.01, 2.0, 0.0, 2.0, 0.0, 2**0.5))
    assert line[7:] == (0.252, 43.0, 0.102, 22.0)


def test_ablation_and_effects():
    rows = [row(method="paper"), row(method="without_length", rotation_deg=0.09, translation_m=0.011)]
    assert [line[1:] for line in ablation(rows).rows] == [pytest.approx((0.01, 1.0, 0.02, 1.0)), (0.09, 11.0, 0.091, 11.0)]
    rows = [row(), row(cameras=8, translation_m=0.002), row(method="default_5_frames", frames=5, translation_m=0.006)]
    assert [line[:3] for line in by_cameras(rows).rows] == [(3, 0.01, 1.0), (8, 0.01, 2.0)]
    assert [line[:3] for line in by_frames(rows).rows] == [(5, 0.01, 6.0), (50, 0.01, 1.5)]


def test_time_and_memory_by_number_of_cameras():
    rows = [row(), row(seconds=0.3, peak_resident_bytes=8_000_000), row(seconds=0.2), row(cameras=10, peak_resident_bytes=None)]
    assert run_time(rows).rows == ((3, 0.2, 0.3, None, None, 21.0), (10, 0.1, 0.1, None, None, 39.0))
    assert memory(rows).rows == (
        (3, 0.05, 4.0, 8.0, 1.0, 1.0, 0.08, 0.2, 1.5),
        (10, 0.05, None, None, 1.0, 1.0, 0.19, 0.5, 5.6),
    )


def test_efficiency_and_success():
    rows = [
        row(),
        row(case="b", rotation_deg=0.02, translation_m=0.0001, regime="hard"),
        row(case="c", rotation_deg=None, translation_m=None, outcome=FAILED, status="no", regime="hard"),
        row(case="d", regime="hard"),
        row(method="kineo", outcome=LACKS_INPUT, status="no height", rotation_deg=None, translation_m=None),
    ]
    (line,) = efficiency(rows).rows
    assert line[1:3] == pytest.approx((0.04 / 3 / 0.005, 0.7 / 0.5))
    assert line[-1] == "3 of 4"
    table = success(rows, "regime", lambda row: row.regime)
    assert table.header == ("method", "hard", "0.1 px")
    assert table.rows == ((METHODS["default"].title, "33 %", "100 %"),)
    assert failures(rows).rows[0][1:] == (FAILED, "no", 1)


def test_without_measurements_there_are_no_tables():
    assert tables([]) == []


# --- files -------------------------------------------------------------------------------------------------------------------


class Page(HTMLParser):
    """Collects a page's tags."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.found: list[tuple[str, dict[str, str | None]]] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attrs)))


def test_the_files_hold_every_row_and_table(tmp_path: Path):
    rows = [
        row(method=name, case=case, cameras=cameras, rotation_deg=0.01 * (1 + number), frames=frames)
        for number, (case, cameras) in enumerate([("a", 3), ("b", 3), ("c", 5)])
        for name, frames in (("default", 50), ("paper", 50), ("human_height", 50), ("default_5_frames", 5))
    ]
    rows[-1] = dataclasses.replace(rows[-1], outcome=FAILED, status="a | b <c>", rotation_deg=None, translation_m=None)
    write_results(rows, tmp_path)
    with (tmp_path / "results.csv").open(newline="") as file:
        lines = list(csv.DictReader(file))
    assert len(lines) == len(rows)
    assert float(lines[0]["rotation_deg"]) == rows[0].rotation_deg
    assert lines[-1]["rotation_deg"] == ""
    record = json.loads((tmp_path / "results.json").read_text())
    assert [Row(**line) for line in record["rows"]] == rows
    assert {"sota", "inputs", "memory", "efficiency", "failures"} <= set(record["tables"])

    html = (tmp_path / "benchmark.html").read_text()
    tags = Page(html).found
    images = [attributes["src"] for tag, attributes in tags if tag == "img"]
    assert len(images) == 4
    assert all((source or "").startswith("data:image/png;base64,") for source in images)
    assert [attributes["id"] for tag, attributes in tags if tag == "table"] == list(record["tables"])
    assert "a | b &lt;c&gt;" in html
    text = (tmp_path / "benchmark.md").read_text()
    assert "![Errors by number of cameras" in text
    assert "a \\| b <c>" in text
    for name in ("errors_by_cameras", "errors_by_noise", "run_time", "frames"):
        assert (tmp_path / f"{name}.png").read_bytes().startswith(b"\x89PNG")
        assert f"({name}.png)" in text


def test_a_markdown_table_has_as_many_cells_as_its_header():
    rows = [row(), row(method="paper")]
    text = markdown(rows, tables(rows), {})
    for block in text.split("\n\n"):
        if block.startswith("|"):
            assert len({line.count(" |") for line in block.splitlines()}) == 1


# --- the command line --------------------------------------------------------------------------------------------------------


def test_the_command_writes_everything_and_can_be_repeated(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    out = tmp_path / "out"
    write_npz(folder / "no_truth.npz", SPEC.generate().observations)
    command = ["benchmark", str(folder), "--out", str(out), "--methods", "default,stick_only"]
    assert main(command) == 0
    shown = capsys.readouterr()
    assert "2 measurements" in shown.out
    assert shown.err == ""
    files = {file.name for file in out.iterdir()}
    assert {"rows.jsonl", "results.csv", "results.json", "benchmark.md", "benchmark.html", "run_time.png"} <= files
    before = (out / ROWS_FILE).read_bytes()
    assert main(command) == 0
    assert (out / ROWS_FILE).read_bytes() == before


def test_another_process_measures_the_same(folder: Path, tmp_path: Path):
    one, two = (run_benchmark("x", sources(str(folder)), ["default"], tmp_path / str(jobs), jobs) for jobs in (1, 2))
    assert [row.rotation_deg for row in one] == pytest.approx([row.rotation_deg for row in two], rel=1e-9)


START = """
import sys
from pathlib import Path
from torchstickcal.benchmark import run_benchmark, sources
if __name__ == "__main__":
    run_benchmark("x", sources("sports-stick-syn"), ["paper"], Path(sys.argv[1]), 2)
"""


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="the system cannot kill")
def test_processes_end_with_the_one_that_started_them(tmp_path: Path):
    (tmp_path / "start.py").write_text(START)
    command = [sys.executable, tmp_path / "start.py", tmp_path / "out"]
    parent = subprocess.Popen(command, start_new_session=True, stderr=subprocess.PIPE)
    rows = tmp_path / "out" / ROWS_FILE
    while not (rows.exists() and rows.read_bytes()):
        assert parent.poll() is None
        time.sleep(0.1)
    parent.kill()
    parent.communicate(timeout=20)  # ends when every process that can write to the pipe has ended


def test_a_preset_is_scored(capsys: pytest.CaptureFixture[str]):
    assert main(["benchmark", "sports-stick-syn", "--count", "2"]) == 0
    assert "2 of 2 converged" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["benchmark", "nowhere"], "one of sports-stick-syn"),
        (["benchmark", "hard", "--out", "out", "--methods", "magic"], "unknown method"),
        (["benchmark", "hard", "--out", "out", "--jobs", "0"], "no process"),
    ],
)
def test_wrong_arguments_are_one_line(
    arguments: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ")
    assert message in error
    assert error.count("\n") == 1
    assert not (tmp_path / "out").exists()
