"""From people's files to people's files on the command line: sample, info, calibrate, triangulate, convert."""

from __future__ import annotations

import json
import shutil
import zipfile
from importlib import resources
from pathlib import Path

import numpy as np
import pytest

from torchstickcal import Calibration
from torchstickcal.cli import main
from torchstickcal.io import Rig, read_calibration, read_npz, write_npz
from torchstickcal.simulate import Noise, SessionSpec, golf_session

STICK = ["--stick", "club_grip", "club_head", "1.0"]


@pytest.fixture(scope="module")
def sample(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("files") / "sample"
    assert main(["sample", str(folder)]) == 0
    return folder


@pytest.fixture(scope="module")
def results(sample: Path) -> Path:
    out = sample.parent / "results"
    command = ["calibrate", str(sample), "--skeleton", str(sample / "skeleton.toml"), *STICK, "--out", str(out)]
    assert main([*command, "--write", "anipose,trc,swing.trc,csv,colmap,opencap"]) == 0
    return out


def errors(found: Path, truth: Path, folder: Path) -> dict[str, float]:
    assert main(["evaluate", str(found), str(truth), "--units", "m", "--json", str(folder / "e.json")]) == 0
    return json.loads((folder / "e.json").read_text())


def test_the_sample_is_small_and_in_the_package():
    content = (resources.files("torchstickcal.samples") / "golf.zip").read_bytes()
    assert len(content) < 300_000
    with zipfile.ZipFile(resources.files("torchstickcal.samples") / "golf.zip") as archive:
        assert {name.split("/")[0] for name in archive.namelist()} == {"pose", "calibration", "Config.toml", "skeleton.toml"}


def test_the_sample_is_calibrated_with_the_command_that_it_shows(sample: Path, results: Path, tmp_path, capsys):
    main(["sample", str(tmp_path / "again")])
    shown = capsys.readouterr().out.splitlines()[-1]
    assert shown.split() == [
        "torchstickcal", "calibrate", str(tmp_path / "again"), "--skeleton", str(tmp_path / "again" / "skeleton.toml"), *STICK,
        "--out", "results",
    ]  # fmt: skip
    assert errors(results, sample / "calibration" / "Calib.toml", tmp_path)["mean_translation_m"] < 0.01


def test_results_are_upright_and_complete(results: Path):
    assert sorted(path.name for path in results.iterdir()) == [
        "anipose.toml", "calibration.toml", "colmap", "opencap", "points.csv", "points.npz", "points.trc", "report.html",
        "report.json", "swing.trc",
    ]  # fmt: skip
    report = json.loads((results / "report.json").read_text())
    assert report["world"]["name"] == "athlete"
    assert report["world"]["vertical_std_deg"] < 2
    rows = [line.split("\t") for line in (results / "swing.trc").read_text().splitlines()]
    names = [name for name in rows[3][2:] if name]
    assert "left_eye" not in names  # never seen
    heights = {name: np.nanmedian([float(row[3 + 3 * n] or "nan") for row in rows[5:]]) for n, name in enumerate(names)}
    assert 1400 < heights["head"] < 1800
    assert 30 < heights["right_ankle"] < 110


def test_results_may_be_written_again(results: Path, sample: Path, tmp_path: Path):
    """Folders of several files, too, and what else is in them stays."""
    shutil.copytree(results, tmp_path / "r")
    (tmp_path / "r" / "colmap" / "mine.txt").write_text("keep")
    command = ["calibrate", str(sample), "--skeleton", str(sample / "skeleton.toml"), *STICK, "--out", str(tmp_path / "r")]
    assert main([*command, "--write", "colmap"]) == 0
    assert (tmp_path / "r" / "colmap" / "mine.txt").read_text() == "keep"
    for name in ("calibration.toml", "colmap/images.txt"):
        assert (tmp_path / "r" / name).read_bytes() == (results / name).read_bytes()


def test_info(sample: Path, tmp_path: Path, capsys):
    assert main(["info", str(sample), "--skeleton", str(sample / "skeleton.toml"), "--json", str(tmp_path / "i.json")]) == 0
    shown = capsys.readouterr().out
    for said in ("4 cameras, 90 frames, 28 points; 60 frames per second; intrinsics are known", "cam01 - cam02", "club_head"):
        assert said in shown
    found = json.loads((tmp_path / "i.json").read_text())
    assert [camera["frames"] for camera in found["cameras"]] == [90] * 4
    assert len(found["pairs"]) == 6
    seen = {point["name"]: point["seen"] for point in found["points"]}
    assert seen["left_eye"] == dict.fromkeys(["cam01", "cam02", "cam03", "cam04"], 0.0)
    assert seen["club_head"]["cam01"] > 0.9


def test_info_says_what_accuracy_to_expect(sample: Path, results: Path, tmp_path: Path, capsys):
    """From the standard deviation by some frames; all frames together do better."""
    command = ["info", str(sample), "--skeleton", str(sample / "skeleton.toml"), "--json", str(tmp_path / "i.json")]
    assert main([*command, *STICK]) == 0
    expected = json.loads((tmp_path / "i.json").read_text())["expected"]
    std_mm = f"{1000 * expected['position_std_m']:.2g} mm"
    said = f"Expected accuracy: standard deviation of the camera positions {std_mm}, by 60 of 90 frames"
    assert said in capsys.readouterr().out
    reached = float(Calibration.load(results / "points.npz").camera_std_m[1:].mean())
    assert 0.5 * expected["position_std_m"] < reached < expected["position_std_m"]
    assert main(command) == 0
    assert "Expected accuracy: not known, because no stick is given" in capsys.readouterr().out


def test_info_counts_what_is_there(tmp_path: Path):
    observations, truth = golf_session(cameras=3, frames=20)
    observations.keypoints[2] = float("nan")
    observations.keypoints[2, 4, 3] = 5.0
    write_npz(tmp_path / "s.npz", observations, truth)
    assert main(["info", str(tmp_path / "s.npz"), "--json", str(tmp_path / "i.json")]) == 0
    found = json.loads((tmp_path / "i.json").read_text())
    assert [camera["keypoints"] for camera in found["cameras"]][2] == 1
    pairs = {tuple(pair["cameras"]): pair["keypoints"] for pair in found["pairs"]}
    assert pairs[("cam01", "cam02")] == int((observations.visible[0] & observations.visible[1]).sum())
    assert pairs[("cam02", "cam03")] == 1
    assert set(found["expected"]) == {"unknown"}
    assert found["sticks"] == [{"start": "club_grip", "end": "club_head", "length_m": 1.0, "frames": 20}]


def test_another_recording_is_triangulated(results: Path, sample: Path, tmp_path: Path, capsys):
    """With the folder of results, and with a file of another program, which says nothing of deviations of the cameras."""
    command = ["triangulate", str(sample), "--skeleton", str(sample / "skeleton.toml"), "--write", "trc,csv,npz"]
    for calibration in (results, results / "anipose.toml", results / "colmap"):
        out = tmp_path / calibration.name
        units = ["--units", "m"] if calibration.name == "colmap" else []
        assert main([*command, "--calibration", str(calibration), "--out", str(out), *units]) == 0
        assert sorted(path.name for path in out.iterdir()) == ["points.csv", "points.trc", "points_m.npz", "report.json"]
        with np.load(out / "points_m.npz") as arrays:
            points = arrays["points_m"]
        expected = Calibration.load(results / "points.npz").points.numpy()
        assert np.nanmedian(np.linalg.norm(points - expected, axis=-1)) < 0.003
    assert "cam04" in capsys.readouterr().out
    report = json.loads((tmp_path / "results" / "report.json").read_text())
    assert report["world"]["name"] == "athlete"
    assert (
        main(["triangulate", str(sample), "--skeleton", "halpe-26", "--calibration", str(results / "colmap"), "--out", "x"])
        == 2
    )


def test_a_session_is_triangulated_with_the_rig_of_another(tmp_path: Path):
    spec = SessionSpec("a", "golf", seed=3, cameras=4, frames=60, regimes=(Noise(1.0),))
    for name, path in (("first", "stay"), ("second", "circle")):
        session = SessionSpec(**{**vars(spec), "path": path}).generate()
        write_npz(tmp_path / f"{name}.npz", session.observations, session.truth)
    assert main(["calibrate", str(tmp_path / "first.npz"), "--out", str(tmp_path / "rig"), "--world", "camera"]) == 0
    command = [
        "triangulate",
        str(tmp_path / "second.npz"),
        "--calibration",
        str(tmp_path / "rig"),
        "--out",
        str(tmp_path / "t"),
    ]
    assert main(command) == 0
    _, truth = read_npz(tmp_path / "second.npz")
    with np.load(tmp_path / "t" / "points_m.npz") as arrays:
        true = (truth.points @ truth.rotations[0].mT + truth.translations[0]).numpy()
        assert np.nanmedian(np.linalg.norm(arrays["points_m"] - true, axis=-1)) < 0.005


# --- frames of the world -----------------------------------------------------------------------------------------------------


@pytest.fixture
def session(tmp_path: Path) -> Path:
    write_npz(tmp_path / "s.npz", *golf_session(cameras=3, frames=30, noise=Noise(0.5)))
    return tmp_path / "s.npz"


def world_of(out: Path) -> str:
    return json.loads((out / "report.json").read_text())["world"]["name"]


def test_every_frame_can_be_chosen(session: Path, tmp_path: Path):
    for world in ("camera", "athlete", "floor"):
        assert main(["calibrate", str(session), "--out", str(tmp_path / world), "--world", world]) == 0
        assert world_of(tmp_path / world) == world
    old = ["--world", "calibration", str(tmp_path / "floor")]
    assert main(["calibrate", *old, str(session), "--out", str(tmp_path / "old")]) == 0
    floor, again = (read_calibration(tmp_path / name / "calibration.toml") for name in ("floor", "old"))
    assert (floor.translations - again.translations).abs().max() < 1e-9
    calibration = Calibration.load(tmp_path / "floor" / "points.npz")
    rows = [("head_top", 0), ("club_head", 9), ("left_knee", 20)]
    places = [calibration.points[frame, calibration.point_names.index(name)].tolist() for name, frame in rows]
    table = [f"{name},{frame},{','.join(map(str, place))}" for (name, frame), place in zip(rows, places, strict=True)]
    (tmp_path / "known.csv").write_text("\n".join(["point,frame,x,y,z", *table]))
    known = ["--world", "points", str(tmp_path / "known.csv")]
    assert main(["calibrate", str(session), "--out", str(tmp_path / "known"), *known]) == 0
    known_rig = read_calibration(tmp_path / "known" / "calibration.toml")
    assert (floor.translations - known_rig.translations).abs().max() < 1e-6


@pytest.mark.parametrize(
    "world", ["roof", "points", "calibration", "points nowhere.csv", "calibration nowhere.toml", "floor x"]
)
def test_an_unusable_frame_is_refused_before_anything_is_calculated(session: Path, tmp_path: Path, world: str, capsys):
    assert main(["calibrate", str(session), "--out", str(tmp_path / "out"), f"--world={world}"]) == 2
    assert capsys.readouterr().err.startswith("error: ")
    assert not (tmp_path / "out").exists()


def test_without_a_body_the_frame_is_that_of_the_camera_and_is_said(tmp_path: Path, capsys):
    observations, truth = golf_session(cameras=3, frames=30, noise=Noise(0.5))
    names = [f"marker {number}" for number in range(observations.num_points)]
    object.__setattr__(observations, "point_names", tuple(names))
    write_npz(tmp_path / "s.npz", observations, truth)
    assert main(["calibrate", str(tmp_path / "s.npz"), "--out", str(tmp_path / "out")]) == 0
    sentence = "The frame is that of the first camera, because no standing body is known: no head."
    assert f"note: {sentence}" in capsys.readouterr().err
    assert world_of(tmp_path / "out") == "camera"
    assert sentence in json.loads((tmp_path / "out" / "report.json").read_text())["notes"]


# --- outputs -----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("write", "problem"),
    [
        ("nonsense", "unknown output format"),
        ("a.xyz", "format of a file to be written is not known"),
        ("../a.trc", "a file in another folder"),
        ("points.npz", "two files of one name"),
        ("trc,points.trc", "two files of one name"),
    ],
)
def test_unusable_outputs_are_refused_before_anything_is_calculated(session: Path, tmp_path: Path, write, problem, capsys):
    assert main(["calibrate", str(session), "--out", str(tmp_path / "out"), "--write", write]) == 2
    assert problem in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_frame_rate_that_is_missing_is_noticed_before_anything_is_calculated(tmp_path: Path, capsys):
    observations, truth = golf_session(cameras=3, frames=10)
    object.__setattr__(observations, "fps", None)
    write_npz(tmp_path / "s.npz", observations, truth)
    assert main(["calibrate", str(tmp_path / "s.npz"), "--out", str(tmp_path / "out"), "--write", "trc"]) == 2
    assert "--fps" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    command = ["calibrate", str(tmp_path / "s.npz"), "--out", str(tmp_path / "out"), "--write", "trc", "--fps", "50"]
    assert main(command) == 0


def test_points_are_converted_from_a_folder_of_results(results: Path, tmp_path: Path):
    assert main(["convert", str(results), str(tmp_path / "swing.trc")]) == 0
    assert (tmp_path / "swing.trc").read_bytes() == (results / "swing.trc").read_bytes()
    assert main(["convert", str(results), str(tmp_path / "old_anipose.toml"), "--to", "anipose"]) == 0
    assert (tmp_path / "old_anipose.toml").read_bytes() == (results / "anipose.toml").read_bytes()


def test_cameras_have_no_points_to_convert(results: Path, tmp_path: Path, capsys):
    assert main(["convert", str(results / "anipose.toml"), str(tmp_path / "a.trc")]) == 2
    assert "holds points" in capsys.readouterr().err
    assert main(["convert", str(results / "anipose.toml"), str(tmp_path / "a.unknown")]) == 2
    assert "--to" in capsys.readouterr().err
    assert main(["convert", str(results / "colmap"), str(tmp_path / "a.toml")]) == 2
    assert "--units" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
    assert main(["convert", str(results / "colmap"), str(tmp_path / "a.toml"), "--units", "cm"]) == 0
    ours, theirs = read_calibration(results / "calibration.toml"), read_calibration(tmp_path / "a.toml")
    assert (ours.translations / 100 - theirs.translations).abs().max() < 1e-9


def test_a_calibration_starts_from_a_file(session: Path, tmp_path: Path):
    assert main(["calibrate", str(session), "--out", str(tmp_path / "a")]) == 0
    rig = Rig.of_calibration(Calibration.load(tmp_path / "a" / "points.npz"))
    assert main(["convert", str(tmp_path / "a"), str(tmp_path / "colmap")]) == 0
    again = ["calibrate", str(session), "--out", str(tmp_path / "b"), "--initial", str(tmp_path / "colmap")]
    assert main(again) == 0
    found = read_calibration(tmp_path / "b" / "calibration.toml")
    assert (found.translations - rig.translations).abs().max() < 1e-2
    assert main(["calibrate", str(session), "--out", str(tmp_path / "c"), "--initial", str(tmp_path / "nothing")]) == 2
