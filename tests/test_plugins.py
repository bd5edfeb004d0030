"""What a user's own module registers, on the command line: formats, a loss, a camera unknown, a sport, a baseline."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from torchstickcal.benchmark import METHODS
from torchstickcal.benchmark.run import CONVERGED, read_rows
from torchstickcal.cli import main
from torchstickcal.config import config_names
from torchstickcal.io import CALIBRATION_READERS, CALIBRATION_WRITERS, KEYPOINT_READERS, SESSION_READERS, write_npz
from torchstickcal.losses import LOSSES
from torchstickcal.model.unknowns import REFINEMENTS
from torchstickcal.quality.registry import FAMILIES
from torchstickcal.simulate import PRESETS, SPORTS, golf_session

pytestmark = pytest.mark.usefixtures("own_parts")

OWN = '''
"""One thing of each kind."""

from dataclasses import dataclass, replace

from torchstickcal import calibrate
from torchstickcal.benchmark import Estimate, Listing, baseline
from torchstickcal.files import atomic_path
from torchstickcal.io import calibration_reader, calibration_writer, read_camera_toml, read_npz, session_reader
from torchstickcal.losses import LossSettings, StickLengthLoss, register_loss
from torchstickcal.model.unknowns import LensUnknown, Sharing, register_unknown
from torchstickcal.simulate import SPORTS


@session_reader("toy_session", "a folder with a session", recognises=lambda path, head: (path / "toy.npz").is_file())
def read_toy(path):
    return read_npz(path / "toy.npz")


@calibration_reader("toy_rig", "a camera file behind a mark", recognises=lambda path, head: head.startswith(b"# toy"))
def read_toy_rig(path):
    return read_camera_toml(path)


@calibration_writer("toy_names", "names of the cameras", file_name="names.txt")
def write_toy(path, calibration):
    with atomic_path(path) as temporary:
        temporary.write_text(" ".join(calibration.camera_names))


@calibration_writer("toy_report", "a file that is there already", file_name="report.json")
def write_report(path, calibration):
    raise NotImplementedError


@register_loss("toy_length")
@dataclass(frozen=True)
class ToySettings(LossSettings):
    """A stick that is known badly. It is a toy."""

    sigma_m: float = 0.1

    loss = StickLengthLoss

    def build(self, context):
        return StickLengthLoss(self.sigma_m, 1.0)


@register_unknown
class Skew(LensUnknown):
    """The skew of the image axes."""

    name = "toy_skew"
    label = "toy skew"
    unit = "px"
    components = ("skew",)
    variants = {"toy_skew": Sharing.OWN}

    def prior(self, cameras):
        return cameras.focal_px.unsqueeze(-1) * 0 + 1e-3

    def applied(self, cameras, deviations):
        matrix = cameras.matrix.clone()
        matrix[..., 0, 1] = matrix[..., 0, 1] + deviations[..., 0] * matrix[..., 0, 0]
        return replace(cameras, matrix=matrix)

    def values(self, cameras):
        return cameras.matrix[..., 0, 1].unsqueeze(-1)


SPORTS.register("toy_tennis", replace(SPORTS["golf"], stick_m=0.69, stick_names=("racket_butt", "racket_tip")))


@baseline("toy_method", Listing("Toy", {"sota": None}))
def toy_method(inputs):
    """The stick alone. It is a toy."""
    return Estimate.of_calibration(calibrate(inputs.observations, "stick_only"))
'''


@pytest.fixture
def plugin(tmp_path: Path) -> str:
    (tmp_path / "my_things.py").write_text(OWN)
    return str(tmp_path / "my_things.py")


@pytest.fixture
def session(tmp_path: Path) -> Path:
    folder = tmp_path / "session"
    folder.mkdir()
    write_npz(folder / "toy.npz", *golf_session(cameras=3, frames=20))
    return folder


def test_formats(plugin: str, session: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    out = tmp_path / "out"
    assert main(["calibrate", str(session), "--out", str(out), "--write", "toy_names"]) == 2
    assert "no session format is recognised" not in capsys.readouterr().err
    command = ["calibrate", str(session), "--out", str(out), "--write", "toy_names", "--plugin", plugin]
    assert main(command) == 0
    assert "calibration.toml, names.txt, points.npz, report.json, report.html in" in capsys.readouterr().out
    assert (out / "names.txt").read_text() == "cam01 cam02 cam03"
    assert main([*command, "--format", "toy_session"]) == 0
    marked = tmp_path / "marked.txt"
    marked.write_text("# toy\n" + (out / "calibration.toml").read_text())
    assert main(["evaluate", str(marked), str(session), "--plugin", plugin]) == 0


def test_a_session_of_one_s_own_format_is_measured(plugin: str, session: Path, tmp_path: Path):
    folder = tmp_path / "sessions"
    folder.mkdir()
    (folder / "notes.txt").write_text("not a session")
    session.rename(folder / "swing")
    assert main(["benchmark", str(folder), "--json", str(tmp_path / "b.json"), "--plugin", plugin]) == 0
    assert [score["name"] for score in json.loads((tmp_path / "b.json").read_text())["sequences"]] == ["swing"]


def test_two_files_of_one_name_are_refused(plugin: str, session: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    out = tmp_path / "out"
    assert main(["calibrate", str(session), "--out", str(out), "--write", "toy_report", "--plugin", plugin]) == 2
    assert "two files of one name (--write toy_report): got report.json" in capsys.readouterr().err
    assert not out.exists()


def test_a_loss_and_a_camera_unknown(plugin: str, session: Path, tmp_path: Path):
    config = tmp_path / "own.toml"
    config.write_text('extends = "default"\n[stages.refined]\nstick_length = false\ntoy_length = { sigma_m = 0.2 }\n')
    out = tmp_path / "out"
    command = ["calibrate", str(session / "toy.npz"), "--out", str(out), "--config", str(config), "--refine", "toy_skew"]
    assert main(command) == 2
    assert main([*command, "--plugin", plugin]) == 0
    assert "toy_skew" in json.loads((out / "report.json").read_text())["refined"]


def test_a_sport(plugin: str, tmp_path: Path):
    assert main(["simulate", "toy_tennis", "--out", str(tmp_path / "out"), "--plugin", plugin]) == 0
    assert [file.name for file in (tmp_path / "out").iterdir()] == ["toy_tennis_0.npz"]


@pytest.mark.parametrize("jobs", ["1", "2"])
def test_a_baseline(jobs: str, plugin: str, tmp_path: Path):
    """With more than one job the processes that measure have to import the plugin."""
    command = ["benchmark", "sports-stick-syn", "--count", "1", "--out", str(tmp_path / "out"), "--methods", "toy_method"]
    assert main([*command, "--jobs", jobs, "--plugin", plugin]) == 0
    rows = read_rows(tmp_path / "out" / "rows.jsonl")
    assert [(row.method, row.outcome) for row in rows] == [("toy_method", CONVERGED)]


def listed(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> dict[str, dict[str, str]]:
    """The lines of `list` by kind and name."""
    assert main(["list", *arguments]) == 0
    sections = [section.splitlines() for section in capsys.readouterr().out.split("\n\n")]
    return {lines[0].split(":")[0]: dict(line.strip().split(maxsplit=1) for line in lines[1:]) for lines in sections}


def test_everything_that_is_registered_is_listed(plugin: str, capsys: pytest.CaptureFixture[str]):
    lists = listed(["--plugin", plugin], capsys)
    assert {kind: list(names) for kind, names in lists.items()} == {
        "losses": list(LOSSES),
        "unknowns": list(REFINEMENTS),
        "findings": list(FAMILIES),
        "formats": list(dict.fromkeys([*SESSION_READERS, *KEYPOINT_READERS, *CALIBRATION_READERS, *CALIBRATION_WRITERS])),
        "sports": list(SPORTS),
        "presets": list(PRESETS),
        "baselines": [name for name in METHODS if name not in config_names()],
        "configs": config_names(),
    }
    assert lists["losses"]["toy_length"] == "A stick that is known badly; settings: sigma_m"
    assert lists["unknowns"]["toy_skew"] == "toy skew (px); each camera has its own value"
    assert lists["unknowns"]["radial"].startswith("radial distortion; ")
    assert lists["formats"]["toy_session"] == "reads sessions: a folder with a session"
    assert lists["formats"]["toy_rig"] == "reads calibrations: a camera file behind a mark"
    assert lists["formats"]["toy_names"] == "writes names.txt: names of the cameras"
    assert lists["sports"]["toy_tennis"].startswith("stick of 0.69 m from racket_butt to racket_tip")
    assert lists["baselines"]["toy_method"] == "Toy: The stick alone"
    assert lists["baselines"]["kineo"].endswith("; needs height_m")
    assert lists["presets"]["hard"].startswith("60 sessions of golf, ")
    assert lists["configs"]["stick_only"] == "The default, from the stick's ends alone"


def test_one_kind_is_listed(capsys: pytest.CaptureFixture[str]):
    assert list(listed(["sports"], capsys)) == ["sports"]
    with pytest.raises(SystemExit):
        main(["list", "sprots"])


def test_a_plugin_by_its_dotted_name(plugin: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    monkeypatch.syspath_prepend(Path(plugin).parent)
    assert "toy_method" in listed(["baselines", "--plugin", "my_things"], capsys)["baselines"]


def test_a_plugin_is_imported_once(plugin: str, capsys: pytest.CaptureFixture[str]):
    for _ in range(2):
        assert main(["list", "sports", "--plugin", plugin, "--plugin", plugin]) == 0


def test_a_plugin_that_takes_a_name_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "taken.py").write_text('from torchstickcal.simulate import SPORTS\nSPORTS.register("golf", SPORTS["golf"])')
    for _ in range(2):
        assert main(["list", "--plugin", str(tmp_path / "taken.py")]) == 2
        assert "error: the name is taken (register: sport)" in capsys.readouterr().err
