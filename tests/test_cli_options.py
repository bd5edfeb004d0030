"""Options that many commands have: --set, --print-config, --version, --quiet, --debug; and the bar with the time left."""

from __future__ import annotations

import io
import json
from contextlib import redirect_stderr
from pathlib import Path

import pytest
import torch

from torchstickcal.cli import main
from torchstickcal.cli.arguments import parser
from torchstickcal.config import config_names, config_toml, load_config, with_settings
from torchstickcal.errors import ConfigError
from torchstickcal.files import parse_toml, toml_text
from torchstickcal.io import write_npz
from torchstickcal.simulate import Noise, golf_session

COMMANDS = next(action.choices for action in parser()._actions if isinstance(action.choices, dict))
CONFIGURED = ["calibrate", "calibrate-many", "triangulate", "benchmark"]


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("options") / "swing.npz"
    write_npz(path, *golf_session(cameras=3, frames=30, noise=Noise(0.5)))
    return path


# --- --set and --print-config ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", config_names())
def test_a_printed_configuration_is_read_back(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    settings = ["stages.metric.reject_sigmas=5", "refine=['focal']", "max_offset_s=1e-7", 'camera_groups=["a\\"b", "é"]']
    line = [word for setting in settings for word in ("--set", setting)] if name != "paper" else []
    assert main(["benchmark", "--print-config", "--config", name, *line]) == 0
    (tmp_path / "config.toml").write_text(capsys.readouterr().out, "utf-8")
    assert load_config(tmp_path / "config.toml") == with_settings(load_config(name), settings if line else [])


@pytest.mark.parametrize("command", CONFIGURED)
def test_a_configuration_is_printed_without_a_session(command: str, capsys: pytest.CaptureFixture[str]):
    assert main([command, "--set", "stages.refined.stick_length=false", "--quiet", "--print-config"]) == 0
    printed = parse_toml(capsys.readouterr().out.encode())
    assert "stick_length" not in printed["stages"]["refined"]
    assert "stick_length" in printed["stages"]["metric"]
    assert printed["refine"] == ("auto" if command.startswith("calibrate") else [])


def test_a_printed_configuration_has_what_other_options_say(capsys: pytest.CaptureFixture[str]):
    assert main(["calibrate", "absent", "--no-sync", "--refine", "focal,radial", "--out", "x", "--print-config"]) == 0
    printed = parse_toml(capsys.readouterr().out.encode())
    assert (printed["synchronise"], printed["refine"]) == (False, ["focal", "radial"])


@pytest.mark.parametrize("command", CONFIGURED)
@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("stages.metric.reject_sigma=5", "Did you mean 'reject_sigmas'"),
        ("stages.metric.stick_length.sigma=5", "Did you mean 'sigma_m'"),
        ("stages.metrc.reject_sigmas=5", "Did you mean 'metric'"),
        ("relable=true", "Did you mean 'relabel'"),
        ("stages.metric.reject_sigmas=-5", "a number above 0"),
        ('stages.metric.reprojection.kernel="cauch"', "or 'cauchy' or"),
        ("points=sticks", "in quotation marks"),
        ("points", "not KEY=VALUE"),
        ("", "not KEY=VALUE"),
        ("[stages]", "not KEY=VALUE"),
        ("relabel=true\npoints='all'", "not KEY=VALUE"),
        ("relabel=", "not KEY=VALUE"),
        ("extends='paper'", "unknown key"),
        ("stages=false", "a table"),
        ("scale.length_m=1.7", "missing key"),
        ("relabel=" + "9" * 5000, "--set"),
        ("relabel=" + "[" * 5000, "not KEY=VALUE"),
        ("\udcff=1", "not KEY=VALUE"),
    ],
)
def test_a_setting_is_checked_like_a_file(command: str, setting: str, message: str, capsys: pytest.CaptureFixture[str]):
    assert main([command, "--print-config", "--set", setting]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ")
    assert error.count("\n") == 1
    assert message in error


def test_a_setting_is_what_a_mapping_is():
    base = load_config("default")
    mapping = {"extends": "default", "stages": {"metric": {"stick_length": {"sigma_m": 0.003}}, "last": {"max_iterations": 3}}}
    settings = [
        "stages.metric.stick_length.sigma_m = 0.003",
        "relabel = false",
        "relabel = true",
        "stages.last = {max_iterations = 3}",
    ]
    found = with_settings(base, settings)
    assert found == load_config(mapping)
    assert list(found.stages)[-1] == "last"
    assert load_config(parse_toml(config_toml(found).encode())) == found
    assert list(load_config(parse_toml(config_toml(found).encode())).stages) == list(found.stages)
    with pytest.raises(ConfigError, match="nothing to do"):
        load_config({"stages": {}})


def test_toml_of_tables_is_read_back():
    tables = {"a b": {"é\n\x7f": [1, 2.5e-300, True, 'q"'], "empty": {}}, "x": -1, "y": {"z": {"w": {}}, "v": ""}}
    assert parse_toml(toml_text(tables).encode()) == tables


def test_what_was_set_takes_part_and_is_in_the_report(session: Path, tmp_path: Path):
    command = ["calibrate", str(session), "--out", str(tmp_path), "--quiet", "--set", "stages.trajectories.max_iterations=1"]
    assert main(command) in (0, 1, 3)
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["set"] == ["stages.trajectories.max_iterations=1"]
    assert report["configuration"]["stages"]["trajectories"]["max_iterations"] == 1


# --- --version, --quiet, --debug ---------------------------------------------------------------------------------------------


def test_version(capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit, match="0"):
        main(["--version"])
    shown = capsys.readouterr().out
    assert shown.startswith("torchstickcal 0.")
    assert f"torch {torch.__version__.split('+')[0]}" in shown


@pytest.mark.parametrize("command", list(COMMANDS))
def test_every_command_has_what_all_have(command: str):
    assert {"--quiet", "--debug", "--help"} <= set(COMMANDS[command]._option_string_actions)


def test_quiet_shows_nothing_where_all_is_well(session: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    out = str(tmp_path / "r")
    for arguments in (
        ["calibrate", str(session), "--out", out],
        ["evaluate", out, str(session)],
        ["info", str(session), "--json", str(tmp_path / "i.json")],
        ["check", out, str(session)],
        ["triangulate", str(session), "--calibration", out, "--out", str(tmp_path / "t")],
        ["convert", out, str(tmp_path / "points.trc")],
        ["report", out],
        ["simulate", "wand", "--out", str(tmp_path / "sim")],
        ["sample", str(tmp_path / "sample")],
        ["list", "configs"],
    ):
        assert main([*arguments, "--quiet"]) == 0
        shown = capsys.readouterr()
        assert (shown.out, shown.err) == ("", ""), arguments
    assert json.loads((tmp_path / "i.json").read_text())["frames"] == 30


def test_quiet_shows_what_goes_wrong(session: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert main(["--quiet", "evaluate", "absent.toml", str(session)]) == 2
    assert capsys.readouterr().err.startswith("error: ")
    observations, _ = golf_session(cameras=3, frames=30, noise=Noise(0.5), seed=3)
    observations.keypoints[2, 10:] += 300.0  # as if a camera had been pushed
    write_npz(tmp_path / "moved.npz", observations)
    assert main(["calibrate", str(session), "--out", str(tmp_path / "r"), "--quiet"]) == 0
    assert main(["check", str(tmp_path / "r"), str(tmp_path / "moved.npz"), "--quiet"]) == 3
    shown = capsys.readouterr()
    assert shown.out == ""
    assert shown.err.startswith("verdict: ")
    assert shown.err.count("\n") == 1


@pytest.mark.parametrize("line", [["--debug", "evaluate"], ["evaluate", "--debug"]])
def test_debug_shows_where_an_error_was_raised(line: list[str], capsys: pytest.CaptureFixture[str]):
    assert main([*line, "absent.toml", "absent.npz"]) == 2
    error = capsys.readouterr().err
    assert error.startswith("Traceback")
    assert "in poses_of" in error
    assert error.splitlines()[-1].startswith("error: ")


# --- the bar -----------------------------------------------------------------------------------------------------------------


class Terminal(io.StringIO):
    """A stream that says it is a terminal."""

    def isatty(self) -> bool:
        return True


@pytest.fixture
def at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """The bar is drawn from the beginning, each time."""
    monkeypatch.setattr("torchstickcal.cli.progress._AFTER_S", 0.0)
    monkeypatch.setattr("torchstickcal.cli.progress._EVERY_S", 0.0)


def shown_by(*arguments: str) -> str:
    with redirect_stderr(Terminal()) as terminal:
        assert main(arguments) in (0, 1)
    return terminal.getvalue()


@pytest.mark.parametrize("name", ["calibrate", "triangulate", "simulate", "benchmark", "benchmark --out", "demo"])
def test_a_bar_says_how_far_a_command_is(name: str, session: Path, tmp_path: Path, at_once: None):
    folder = tmp_path / "sessions"
    folder.mkdir()
    for number in range(2):
        (folder / f"{number}.npz").write_bytes(session.read_bytes())
    if name == "triangulate":
        main(["calibrate", str(session), "--out", str(tmp_path / "r")])
    arguments = {
        "calibrate": [str(session), "--out", str(tmp_path / "out")],
        "triangulate": [str(session), "--out", str(tmp_path / "out"), "--calibration", str(tmp_path / "r")],
        "simulate": ["wand", "--out", str(tmp_path / "out"), "--count", "3"],
        "benchmark": [str(folder)],
        "benchmark --out": [str(folder), "--out", str(tmp_path / "out"), "--methods", "stick_only"],
        "demo": ["--out", str(tmp_path / "out")],
    }[name]
    drawn = shown_by(name.split()[0], *arguments)
    lines = [line for line in drawn.split("\r") if line.startswith("[")]
    assert any(" left: " in line for line in lines)
    percents = [int(line.split("] ")[1].split(" %")[0]) for line in lines]
    assert percents == sorted(percents)
    assert max(percents) <= 100
    assert drawn.split("\r")[-1].strip() == ""  # it is gone at the end


@pytest.mark.parametrize("silent", ["--quiet", "--json", "pipe", "short"])
def test_there_is_no_bar_elsewhere(
    silent: str, session: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, request, capsys: pytest.CaptureFixture[str]
):
    if silent != "short":
        request.getfixturevalue("at_once")
    folder = tmp_path / "sessions"
    folder.mkdir()
    (folder / "0.npz").write_bytes(session.read_bytes())
    more = {"--quiet": ["--quiet"], "--json": ["--json", str(tmp_path / "b.json")]}.get(silent, [])
    if silent == "pipe":
        assert main(["benchmark", str(folder)]) == 0
        assert capsys.readouterr().err == ""
    else:
        assert shown_by("benchmark", str(folder), *more) == ""


def test_a_bar_makes_way_for_other_output(session: Path, tmp_path: Path, at_once: None, capsys: pytest.CaptureFixture[str]):
    folder = tmp_path / "sessions"
    folder.mkdir()
    write_npz(folder / "a.npz", golf_session(cameras=3, frames=10)[0])
    (folder / "b.npz").write_bytes(session.read_bytes())
    drawn = shown_by("benchmark", str(folder))
    before, _, _ = drawn.partition("note: a is left out")
    assert before.endswith("\r")
    assert before.split("\r")[-2].strip() == ""
