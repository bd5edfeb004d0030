"""The command line as a user meets it."""

from __future__ import annotations

import dataclasses
import json
import os
import signal
import subprocess
import sys
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch

from torchstickcal import Calibration, Stick, calibrate
from torchstickcal.cli import main
from torchstickcal.io import read_camera_toml, write_npz
from torchstickcal.simulate import Noise, golf_session


def test_calibrating_leaves_torchs_threads_alone(noisy):
    count = torch.get_num_threads()
    calibrate(noisy[0])
    assert torch.get_num_threads() == count


@pytest.fixture
def session(tmp_path: Path) -> Path:
    path = tmp_path / "swing.npz"
    write_npz(path, *golf_session(cameras=3, frames=30, noise=Noise(0.5)))
    return path


def test_calibrate_then_evaluate(session: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    out = tmp_path / "results"
    assert main(["calibrate", str(session), "--out", str(out)]) == 0
    shown = capsys.readouterr().out
    for word in ("verdict: good", "cam01", "position", "reprojection", "keypoints", "club_grip - club_head", "report.html"):
        assert word in shown
    assert sorted(file.name for file in out.iterdir()) == ["calibration.toml", "points.npz", "report.html", "report.json"]
    report = json.loads((out / "report.json").read_text())
    assert report["converged"] is True
    assert [camera["name"] for camera in report["cameras"]] == ["cam01", "cam02", "cam03"]
    calibration = Calibration.load(out / "points.npz")
    assert read_camera_toml(out / "calibration.toml").translations.tolist() == calibration.translations.tolist()

    assert main(["evaluate", str(out), str(session), "--json", str(tmp_path / "e.json")]) == 0
    errors = json.loads((tmp_path / "e.json").read_text())
    assert errors["mean_translation_m"] < 5e-3
    assert len(errors["cameras"]) == 3
    assert "mean" in capsys.readouterr().out
    assert main(["evaluate", str(out), str(out)]) == 0


def test_cameras_are_matched_by_name(session: Path, tmp_path: Path):
    out = tmp_path / "results"
    main(["calibrate", str(session), "--out", str(out)])
    first, second, third, metadata = (out / "calibration.toml").read_text().split("\n\n")
    tables = [table.split("\n", 1)[1] for table in (third, first, second)]
    renamed = [f"[cam_{number}]\n{table}" for number, table in enumerate(tables)]
    (tmp_path / "shuffled.toml").write_text("\n\n".join([*renamed, metadata]))
    main(["evaluate", str(tmp_path / "shuffled.toml"), str(out), "--json", str(tmp_path / "e.json")])
    errors = json.loads((tmp_path / "e.json").read_text())
    assert errors["mean_translation_m"] < 1e-12
    assert [camera["name"] for camera in errors["cameras"]] == ["cam03", "cam01", "cam02"]


def test_benchmark_scores_what_it_cannot_read_as_failed(session: Path, tmp_path: Path):
    folder = tmp_path / "sessions"
    folder.mkdir()
    session.rename(folder / session.name)
    (folder / "broken.pkl").write_bytes(b"\x80\x04 nonsense")
    assert main(["benchmark", str(folder), "--json", str(tmp_path / "b.json")]) == 1
    broken, swing = json.loads((tmp_path / "b.json").read_text())["sequences"]
    assert broken["rotation_deg"] is None
    assert "damaged" in broken["status"]
    assert swing["status"] == "converged"


def test_stick_length_scales_the_rig(session: Path, tmp_path: Path):
    for length in ("1.0", "2.0"):
        main(["calibrate", str(session), "--out", str(tmp_path / length), "--stick-length", length])
    one, two = (Calibration.load(tmp_path / length / "points.npz").translations for length in ("1.0", "2.0"))
    assert (2 * one - two).abs().max() < 0.02


def test_stick_sigma_is_the_uncertainty_of_the_scale(session: Path, tmp_path: Path):
    for sigma in ("0.001", "0.05"):
        main(["calibrate", str(session), "--out", str(tmp_path / sigma), "--stick-sigma", sigma, "--refine", "none"])
    known, guessed = (Calibration.load(tmp_path / sigma / "points.npz") for sigma in ("0.001", "0.05"))
    assert guessed.sticks[0].sigma_m == 0.05
    assert guessed.scale_std > 10 * known.scale_std


def test_a_calibration_file_or_a_session_of_any_name_is_evaluated(session: Path, tmp_path: Path):
    out = tmp_path / "results"
    main(["calibrate", str(session), "--out", str(out)])
    (out / "calibration.toml").rename(tmp_path / "cameras.txt")
    session.rename(tmp_path / "truth")
    assert main(["evaluate", str(tmp_path / "cameras.txt"), str(tmp_path / "truth")]) == 0
    assert main(["evaluate", str(tmp_path / "cameras.txt"), str(tmp_path / "truth"), "--format", "npz"]) == 0


def test_the_earlier_name_of_write_still_works(session: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert main(["calibrate", str(session), "--out", str(tmp_path), "--export", "trc", "--refine", "none"]) == 0
    assert (tmp_path / "points.trc").is_file()
    with pytest.raises(SystemExit):
        main(["calibrate", "--help"])
    assert "--export" not in capsys.readouterr().out


def test_tensorboard_log(session: Path, tmp_path: Path):
    main(["calibrate", str(session), "--out", str(tmp_path / "out"), "--tensorboard", str(tmp_path / "log")])
    assert len(list((tmp_path / "log").iterdir())) == 1


def test_benchmark(session: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    folder = tmp_path / "sessions"
    folder.mkdir()
    session.rename(folder / session.name)
    observations, _ = golf_session(cameras=3, frames=30)
    write_npz(folder / "no_truth.npz", observations)
    assert main(["benchmark", str(folder), "--json", str(tmp_path / "b.json"), "--config", "paper"]) == 0
    scores = json.loads((tmp_path / "b.json").read_text())
    assert [sequence["name"] for sequence in scores["sequences"]] == ["swing"]
    assert scores["sequences"][0].keys() == {"name", "rotation_deg", "translation_m", "seconds", "status"}
    assert scores["mean_translation_m"] == scores["sequences"][0]["translation_m"] < 0.05
    shown = capsys.readouterr()
    assert "1 of 1 converged" in shown.out
    assert "no_truth" in shown.err


def test_demo(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert main(["demo", "--out", str(tmp_path / "demo")]) == 0
    assert Calibration.load(tmp_path / "demo" / "points.npz").world.name == "athlete"
    shown = capsys.readouterr().out
    assert "Against the truth" in shown
    assert (tmp_path / "demo" / "rig.png").read_bytes().startswith(b"\x89PNG")


def test_the_same_command_writes_the_same_cameras(session: Path, tmp_path: Path):
    for name in ("a", "b"):
        main(["calibrate", str(session), "--out", str(tmp_path / name)])
    assert (tmp_path / "a" / "calibration.toml").read_bytes() == (tmp_path / "b" / "calibration.toml").read_bytes()


BROKEN_WRITER = """
from torchstickcal.io import calibration_writer

@calibration_writer("broken", "fails", file_name="broken.txt")
def write(path, calibration):
    path.write_text("half")
    raise ZeroDivisionError("by zero")
"""


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["calibrate", "absent.npz", "--out", "out"], "No such file"),
        (["calibrate", "SESSION", "--out", "out", "--config", "papr"], "Did you mean 'paper'"),
        (["calibrate", "SESSION", "--out", "out", "--stick-length", "1150"], "millimetres"),
        (["calibrate", "SESSION", "--out", "out", "--stick-sigma", "-1"], "not a length (Stick.sigma_m): got -1"),
        (["calibrate", "TWO", "--out", "out", "--stick-sigma", "0.01"], "with one stick (--stick-sigma): got 2 sticks"),
        (["calibrate", "SESSION", "--out", "out", "--refine", "focal,redial"], "Did you mean 'radial'"),
        (["calibrate", "SESSION", "--out", "out", "--refine", "time_offset", "--no-sync"], "got --refine time_offset"),
        (["calibrate", "SESSION", "--out", "out", "--format", "npx"], "Did you mean 'npz'"),
        (["calibrate", "SESSION", "--out", "out", "--format", "sports-stick-syn"], "a pickle file is damaged"),
        (["calibrate", "SESSION", "--out", "out", "--write", "pose3sim"], "Did you mean 'pose2sim'"),
        (["calibrate", "empty", "--out", "out"], "no session format is recognised (empty): got a folder"),
        (["evaluate", "SESSION", "broken.py"], "no calibration format or session format is recognised"),
        (["list", "--plugin", "absent.py"], "a plugin cannot be imported (--plugin absent.py): got FileNotFoundError"),
        (["list", "--plugin", "absent.module"], "got ModuleNotFoundError: No module named 'absent'"),
        (["list", "--plugin", "broken.py"], "got ZeroDivisionError: division by zero; expected"),
        (["list", "--plugin", "script.py"], "got SystemExit: 3; expected"),
        (["evaluate", "SESSION", "FOUR"], "number of cameras differs"),
        (["benchmark", "EMPTY"], "no sessions"),
        (["calibrate", "SESSION", "--out", "broken.py"], "results cannot be written (--out broken.py): got FileExistsError"),
        (["calibrate", "SESSION", "--out", "broken.py/x"], "results cannot be written"),
        (["evaluate", "SESSION", "SESSION", "--json", "absent/e.json"], "a file cannot be written (--json)"),
        (["evaluate", "SESSION", "SESSION", "--json", "empty"], "which is not a file"),
        (["demo", "--out", "out", "--seed", "-1"], "negative seed"),
        (["simulate", "golf", "--out", "out", "--seed", "-1"], "negative seed"),
        (["simulate", "golf", "--out", "out", "--count", "1000000000000"], "too many sessions to simulate (count)"),
        (["simulate", "golf", "--out", "broken.py"], "results cannot be written"),
        (["benchmark", "EMPTY", "--count", "0"], "no sessions to measure"),
        (["benchmark", "hard", "--out", "out", "--jobs", "1000000"], "more processes than this machine can run (--jobs)"),
        (["calibrate", "SESSION", "--out", "out", "--write", "broken", "--plugin", "writer.py"], "ZeroDivisionError: by zero"),
    ],
)
def test_errors_are_one_line_and_leave_nothing(
    arguments: list[str],
    message: str,
    session: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    own_parts: object,
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    (tmp_path / "broken.py").write_text("1 / 0")
    (tmp_path / "script.py").write_text("import sys; sys.exit(3)")
    (tmp_path / "writer.py").write_text(BROKEN_WRITER)
    observations, truth = golf_session(cameras=3, frames=5)
    sticks = [*observations.sticks, Stick("right_knee", "right_ankle", 0.42)]
    write_npz(tmp_path / "two.npz", dataclasses.replace(observations, sticks=sticks), truth)
    write_npz(tmp_path / "four.npz", *golf_session(cameras=4, frames=5))
    places = {"SESSION": str(session), "FOUR": "four.npz", "TWO": "two.npz", "EMPTY": "empty"}
    assert main([places.get(argument, argument) for argument in arguments]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ")
    assert message in error
    assert error.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_help_and_usage_errors_do_not_wait_for_torch():
    code = (
        "import sys\nfrom torchstickcal.cli import main\n"
        "for arguments in (['--help'], ['calibrate', '--help'], ['list', '--help'], ['nonsense']):\n"
        "    try:\n        main(arguments)\n    except SystemExit:\n        pass\n"
        "assert not {'torch', 'numpy', 'kornia', 'cv2', 'matplotlib'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)


def test_calibrating_imports_neither_kornia_nor_tensorboard():
    code = (
        "import sys, torchstickcal\nfrom torchstickcal.simulate import golf_session\n"
        "torchstickcal.calibrate(golf_session(cameras=3, frames=10)[0])\n"
        "assert not {'kornia', 'tensorboard', 'matplotlib'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)


def command(*arguments: object, **more: Any) -> subprocess.Popen[str]:
    """A command in a process of its own."""
    line = [sys.executable, "-m", "torchstickcal", *map(str, arguments)]
    return subprocess.Popen(line, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, encoding="latin-1", **more)


def test_a_usage_error_is_one_line(capsys: pytest.CaptureFixture[str]):
    for arguments in ([], ["nonsense"], ["calibrate"], ["demo", "--seed", "x\ny"], ["list", "--out"], ["demo", "--out", ""]):
        with pytest.raises(SystemExit, match="2"):
            main(arguments)
        error = capsys.readouterr().err
        assert error.startswith("error: ")
        assert error.count("\n") == 1


def test_an_unexpected_error_is_one_line_and_its_traceback_on_request(
    session: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    def broken(*_: object) -> None:
        raise RuntimeError("two\nlines")

    monkeypatch.setattr("torchstickcal.metrics.pose_errors", broken)
    assert main(["evaluate", str(session), str(session)]) == 2
    assert capsys.readouterr().err.startswith("error: unexpected RuntimeError: two lines (--debug shows where)")
    monkeypatch.setenv("TORCHSTICKCAL_TRACEBACK", "1")
    assert main(["evaluate", str(session), str(session)]) == 2
    assert "in broken" in capsys.readouterr().err


def test_a_console_shows_what_it_can(tmp_path: Path):
    observations, truth = golf_session(cameras=3, frames=8)
    write_npz(tmp_path / "a.npz", dataclasses.replace(observations, camera_names=("カメラ", "a\nb", "\x1b[31m")), truth)
    running = [
        command("evaluate", tmp_path / "a.npz", tmp_path / "a.npz", env=os.environ | {"PYTHONIOENCODING": encoding})
        for encoding in ("ascii", "cp1252")
    ]
    for process in running:
        out, error = process.communicate()
        assert (process.returncode, error) == (0, "")
        for name in ("\\u30ab\\u30e1\\u30e9", "a\\nb", "\\x1b[31m"):
            assert f"\n{name} " in out


@pytest.mark.skipif(os.name == "nt", reason="needs a POSIX shell")
@pytest.mark.parametrize(("redirection", "status"), [("| true", 0), (">&-", 0), (">&- 2>&-", 0), ("> /dev/full", 2)])
def test_a_console_that_is_gone_changes_nothing(redirection: str, status: int):
    line = f"set -o pipefail; '{sys.executable}' -m torchstickcal list configs {redirection}"
    done = subprocess.run(["bash", "-c", line], capture_output=True, text=True, check=False)
    assert done.returncode == status
    assert done.stderr.count("\n") == (1 if status else 0)


@pytest.mark.skipif(os.name == "nt", reason="needs POSIX signals")
def test_an_interrupted_command_ends_at_once_with_one_line(tmp_path: Path):
    (tmp_path / "plugin.py").write_text("import time; print('started', flush=True); time.sleep(60)")
    heard = partial(signal.signal, signal.SIGINT, signal.default_int_handler)  # a job in the background inherits deafness
    process = command("list", "--plugin", tmp_path / "plugin.py", preexec_fn=heard)
    assert process.stdout is not None
    assert process.stdout.readline() == "started\n"
    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=20)
    assert (process.returncode, error) == (130, "interrupted\n")


@pytest.mark.skipif(os.name == "nt", reason="needs POSIX limits")
def test_a_full_disk_leaves_the_old_results(session: Path, tmp_path: Path):
    out = tmp_path / "out"
    assert main(["calibrate", str(session), "--out", str(out), "--refine", "none"]) == 0
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    program = """
import resource, sys
from torchstickcal.cli import main
hard = resource.getrlimit(resource.RLIMIT_FSIZE)[1]
for limit_bytes in (0, 2500, 6000):
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit_bytes, hard))
    print(main(["calibrate", sys.argv[1], "--out", sys.argv[2], "--refine", "none", "--stick-length", "2", "--quiet"]))
"""
    ended = subprocess.run([sys.executable, "-c", program, session, out], capture_output=True, text=True, check=True)
    assert ended.stdout.split() == ["2", "2", "2"], ended.stderr
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before
