"""Poses that were computed elsewhere, in the benchmark."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from torchstickcal.benchmark import METHODS
from torchstickcal.cli import main
from torchstickcal.io import Rig, write_calibration, write_npz
from torchstickcal.io.rig import RigCamera
from torchstickcal.simulate import Noise, golf_session

MOVED = torch.linalg.matrix_exp(torch.tensor([[0.0, -0.3, 0.2], [0.3, 0.0, -0.9], [-0.2, 0.9, 0.0]], dtype=torch.float64))
"""The axes of another world."""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two sessions with truth, and their true cameras in other formats, units, orders and worlds."""
    (tmp_path / "sessions").mkdir()
    for number in range(2):
        observations, truth = golf_session(cameras=3, frames=20, noise=Noise(0.5), seed=number)
        write_npz(tmp_path / "sessions" / f"swing{number}.npz", observations, truth)
        poses = zip(truth.rotations.double() @ MOVED, truth.translations.double(), observations.camera_labels, strict=True)
        cameras = [
            RigCamera(name, observations.cameras.matrix[0], rotation=rotation, translation=translation)
            for rotation, translation, name in poses
        ]
        for kind, unit in (("metric", "m"), ("small", None), ("wrong", "m")):
            factor = {"metric": 1.0, "small": 0.01, "wrong": 1.1}[kind]
            (tmp_path / kind).mkdir(exist_ok=True)
            scaled = [
                RigCamera(one.name, one.matrix, rotation=one.rotation, translation=factor * one.translation)
                for one in reversed(cameras)
            ]
            name, format = (f"swing{number}", "colmap") if unit is None else (f"swing{number}.toml", "pose2sim")
            write_calibration(tmp_path / kind / name, Rig.of(scaled, "m"), format)
    return tmp_path


def measured(folder: Path, *options: str) -> dict:
    command = ["benchmark", str(folder / "sessions"), "--json", str(folder / "b.json"), *options]
    assert main(command) == 0
    return json.loads((folder / "b.json").read_text())


def test_poses_of_any_format_are_scored_beside_ours(folder: Path, capsys: pytest.CaptureFixture[str]):
    names = ("metric", "small", "wrong")
    scores = measured(folder, *(word for name in names for word in ("--external", f"{name}={folder / name}")))
    assert [one["name"] for one in scores["sequences"]] == ["swing0", "swing1"]
    found = scores["external"]
    assert found["metric"]["mean_translation_m"] < 1e-6
    assert found["metric"]["mean_rotation_deg"] < 1e-5
    assert found["small"]["mean_translation_m"] < 1e-6  # a size that nobody states is fitted
    assert found["wrong"]["mean_translation_m"] > 0.1  # one that is stated is not
    assert {one["status"] for one in found["small"]["sequences"]} == {"size fitted to the truth"}
    assert {one["status"] for one in found["metric"]["sequences"]} == {"metric"}
    shown = capsys.readouterr().out
    for name in names:
        assert f"{name}, computed elsewhere:" in shown


def test_a_unit_that_is_said_makes_them_metric(folder: Path):
    found = measured(folder, "--external", f"small={folder / 'small'}", "--units", "m")["external"]["small"]
    assert found["mean_translation_m"] > 1
    assert {one["status"] for one in found["sequences"]} == {"metric"}


def test_a_session_without_poses_is_said(folder: Path, capsys: pytest.CaptureFixture[str]):
    (folder / "metric" / "swing1.toml").unlink()
    first, second = measured(folder, "--external", f"metric={folder / 'metric'}")["external"]["metric"]["sequences"]
    assert first["status"] == "metric"
    assert second["translation_m"] is None
    assert "no calibration of this session" in second["status"]


def test_they_are_in_the_tables(folder: Path):
    command = ["benchmark", str(folder / "sessions"), "--out", str(folder / "out"), "--methods", "stick_only"]
    command += ["--external", f"COLMAP={folder / 'small'}", "--external", f"other={folder / 'wrong'}"]
    assert main(command) == 0
    page = (folder / "out" / "benchmark.md").read_text()
    assert "COLMAP (elsewhere; size fitted to the truth)" in page
    assert "other (elsewhere)" in page
    assert not {"COLMAP", "other"} & set(METHODS)
    rows = [json.loads(line) for line in (folder / "out" / "rows.jsonl").read_text().splitlines()]
    assert {row["method"]: row["seconds"] is None for row in rows} == {"stick_only": False, "COLMAP": True, "other": True}
    for file in (folder / "wrong").iterdir():  # poses that changed are compared again
        file.write_bytes((folder / "metric" / file.name).read_bytes())
    assert main(command) == 0
    results = json.loads((folder / "out" / "results.json").read_text())
    errors = [row["translation_m"] for row in results["rows"] if row["method"] == "other"]
    assert len(errors) == 2
    assert max(errors) < 1e-6


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ("x", "not a name and a folder"),
        ("=metric", "not a name and a folder"),
        ("x=absent", "no poses from elsewhere"),
        ("x=sessions/swing0.npz", "no poses from elsewhere"),
        ("x=empty", "no calibration of any session"),
        ("default=metric", "two methods of one name"),
        ("kineo=metric", "two methods of one name"),
        ("x=twice", "several calibrations of one session"),
        ("x=broken", "broken"),
        ("x=other", "cameras"),
    ],
)
@pytest.mark.parametrize("out", [[], ["--out", "out", "--methods", "stick_only"]])
def test_what_cannot_be_compared_is_refused(
    option: str, message: str, out: list[str], folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.chdir(folder)
    for name in ("empty", "twice", "broken", "other"):
        Path(name).mkdir()
    for name in ("swing0.toml", "swing0.txt"):
        Path("twice", name).write_bytes(Path("metric/swing0.toml").read_bytes())
    Path("broken/swing0.toml").write_text("[cam]\nmatrix = 1\n")
    matrix = [[500, 0, 320], [0, 500, 240], [0, 0, 1]]
    two = [RigCamera(name, matrix, rotation=torch.eye(3), translation=torch.zeros(3)) for name in ("a", "b")]
    write_calibration("other/swing0.toml", Rig.of(two, "m"), "pose2sim")
    status = main(["benchmark", "sessions", "--count", "1", "--external", option, *out])
    shown = capsys.readouterr()
    if option == "x=other":  # a failure of one session is a row
        assert status == 0
        assert message in (shown.out + Path("out/benchmark.md").read_text() if out else shown.out)
        return
    assert status == 2
    assert message in shown.err
    assert shown.err.count("\n") == 1
    assert not Path("out").exists()


def test_one_configuration_and_all_methods_is_a_contradiction(folder: Path, capsys: pytest.CaptureFixture[str]):
    for more in (["--config", "paper"], ["--set", "relabel=false"]):
        assert main(["benchmark", str(folder / "sessions"), "--out", str(folder / "out"), *more]) == 2
        assert "named by --methods" in capsys.readouterr().err
