"""What is written for other programs is read back as the same rig, whatever it was converted from; so are points."""

from __future__ import annotations

import csv
import io
import itertools
import runpy
import subprocess
import sys
import types
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from torchstickcal import Calibration, CalibrationError, calibrate
from torchstickcal.cli import main
from torchstickcal.io import CALIBRATION_WRITERS, Motion, Rig, RigCamera, read_calibration, write_calibration
from torchstickcal.io.about import about, generator
from torchstickcal.simulate import Noise, golf_session
from torchstickcal.world import World

SIZE = (1280, 720)
CAMERA_FORMATS = sorted(
    name for name, writer in CALIBRATION_WRITERS.items() if writer.writes == "cameras" and name != "blender"
)
UNITS = {"pose2sim": "m", "anipose": "m", "freemocap": "mm", "caliscope": "m", "easymocap": "m", "opencap": "mm"}
"""What a reader knows without being told; COLMAP, nerfstudio and OpenCV do not say it."""


def rig(names: tuple[str, ...] = ("cam2", "cam9", "cam10"), lens: int = 5, fisheye: bool = False) -> Rig:
    rng = np.random.default_rng(len(names) + lens)
    count = 4 if fisheye else lens
    return Rig.of([
        RigCamera(
            name,
            [[900.0 + n, 0, 640.5 + n], [0, 905.0 + n, 350.25 - n], [0, 0, 1]],
            rng.normal(0, 0.01, count),
            fisheye,
            SIZE,
            rng.normal(0, 1.2, 3),
            rng.normal(0, 2, 3),
        )
        for n, name in enumerate(names)
    ])  # fmt: skip


def written(rig: Rig, format: str, folder: Path) -> Path:
    path = folder / CALIBRATION_WRITERS[format].file_name
    write_calibration(path, rig, format)
    return path


def unit_of(format: str) -> str | None:
    return None if format in UNITS else "m"


def check_same(found: Rig, expected: Rig, digits: float = 1e-9) -> None:
    assert found.names == expected.names
    rotations, translations = found.poses("m" if found.unit is None else None)
    assert (rotations - expected.rotations).abs().max() < digits
    assert (translations - expected.translations).abs().max() < digits
    assert (found.intrinsics - expected.intrinsics).abs().max() < 1e-9
    assert found.fisheye == expected.fisheye
    assert torch.equal(found.image_size, expected.image_size)
    for mine, theirs in zip(found.distortion, expected.distortion, strict=True):
        padded = torch.nn.functional.pad(theirs, (0, max(0, len(mine) - len(theirs))))
        assert (mine - padded).abs().max() < 1e-12


@pytest.mark.parametrize(("first", "second"), list(itertools.product(CAMERA_FORMATS, CAMERA_FORMATS)))
def test_every_format_is_converted_into_every_other(first: str, second: str, tmp_path: Path):
    """Names, intrinsics, lenses, poses and units, exact but for rounding of the last digit."""
    given = rig()
    source = written(given, first, tmp_path / "a" if (tmp_path / "a").mkdir() is None else tmp_path)
    check_same(read_calibration(source), given)
    units = [] if first in UNITS else ["--units", "m"]
    target = tmp_path / "b" / CALIBRATION_WRITERS[second].file_name
    assert main(["convert", str(source), str(target), "--to", second, *units]) == 0
    found = read_calibration(target)
    assert found.unit == UNITS.get(second)
    check_same(found, given)


@pytest.mark.parametrize("format", ["pose2sim", "anipose", "caliscope", "opencv", "colmap", "nerfstudio"])
def test_fisheye_lenses_stay_fisheye(format: str, tmp_path: Path):
    given = rig(fisheye=True)
    check_same(read_calibration(written(given, format, tmp_path)), given)


@pytest.mark.parametrize(("format", "lens"), [("pose2sim", 14), ("opencv", 12), ("colmap", 8), ("nerfstudio", 5)])
def test_long_lens_models_are_kept(format: str, lens: int, tmp_path: Path):
    given = rig(lens=lens)
    check_same(read_calibration(written(given, format, tmp_path)), given)


@pytest.mark.parametrize("format", ["anipose", "freemocap", "caliscope", "easymocap", "opencap", "nerfstudio"])
def test_a_lens_that_a_format_cannot_hold_is_refused(format: str, tmp_path: Path):
    with pytest.raises(CalibrationError, match=r"a lens that the format cannot hold.*cam2.*8 distortion coefficients"):
        written(rig(lens=8), format, tmp_path)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("format", ["freemocap", "easymocap", "opencap", "blender"])
def test_a_fisheye_lens_that_a_format_cannot_hold_is_refused(format: str, tmp_path: Path):
    with pytest.raises(CalibrationError, match=r"cannot hold.*a fisheye lens"):
        written(rig(fisheye=True), format, tmp_path)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("format", CAMERA_FORMATS)
def test_awkward_names_of_cameras_stay_inside_the_folder(format: str, tmp_path: Path):
    given = rig(("../left", "c:\\x", 'the "wide" one'))
    (tmp_path / "in").mkdir()
    path = written(given, format, tmp_path / "in")
    assert [file.name for file in tmp_path.iterdir()] == ["in"]
    found = read_calibration(path)
    assert (found.intrinsics - given.intrinsics).abs().max() < 1e-9
    assert len(set(found.names)) == 3


def test_a_pose_of_half_a_turn_is_written_exactly(tmp_path: Path):
    """Rotation vectors and quaternions are at their limits there."""
    turns = [[np.pi, 0, 0], [0, np.pi, 0], [0, 0, np.pi], [np.pi / np.sqrt(2), np.pi / np.sqrt(2), 0], [0, 0, 0]]
    names = tuple(f"cam{number}" for number in range(5))
    cameras = rig(names)
    given = replace(
        cameras, rotations=torch.stack([torch.from_numpy(cv2.Rodrigues(np.array(turn, dtype=float))[0]) for turn in turns])
    )
    for format in CAMERA_FORMATS:
        (tmp_path / format).mkdir()
        check_same(read_calibration(written(given, format, tmp_path / format)), given, 1e-7)


# --- what files say of themselves --------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    return calibrate(golf_session(cameras=3, frames=30, noise=Noise(0.5, missing=0.05))[0]).in_world("athlete")


def files_of(path: Path) -> list[Path]:
    return sorted(file for file in ([path] if path.is_file() else path.rglob("*")) if file.is_file())


@pytest.mark.parametrize("format", sorted(set(CALIBRATION_WRITERS) - {"c3d"}))
def test_the_same_calibration_gives_the_same_bytes(format: str, calibration: Calibration, tmp_path: Path):
    contents = []
    for name in "ab":
        (tmp_path / name).mkdir()
        path = tmp_path / name / CALIBRATION_WRITERS[format].file_name
        write_calibration(path, calibration, format)
        contents.append([(file.relative_to(tmp_path / name), file.read_bytes()) for file in files_of(path)])
    assert contents[0] == contents[1]
    assert contents[0]


@pytest.mark.parametrize("format", sorted(set(CALIBRATION_WRITERS) - {"c3d", "npz", "trc", "opencap"}))
def test_a_file_says_what_wrote_it_and_in_which_axes(format: str, calibration: Calibration, tmp_path, monkeypatch):
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1700000000")
    path = tmp_path / CALIBRATION_WRITERS[format].file_name
    write_calibration(path, calibration, format)
    text = files_of(path)[0].read_text()
    for said in (generator(), "below the feet of the athlete", "2023-11-14T22:13:20+00:00"):
        assert said in text
    assert "metres" in text or "millimetres" in text or '"m"' in text or '"mm"' in text


def test_a_date_that_is_none_is_not_written(monkeypatch):
    for text in ("", "-1", "yesterday", "9" * 30):
        monkeypatch.setenv("SOURCE_DATE_EPOCH", text)
        assert "date" not in about("metres", World())


# --- points ------------------------------------------------------------------------------------------------------------------


def motion(world: str = "athlete", rate: float | None = 50.0) -> Motion:
    points = np.arange(24, dtype=float).reshape(4, 2, 3) / 10
    points[2, 1] = np.nan
    times = None if rate is None else np.arange(4) / rate
    return Motion(points, ("left ankle", "head"), rate, times, np.full((4, 2), 0.002), World(world, up="z"))


def read_trc(path: Path) -> tuple[dict[str, str], list[str], np.ndarray]:
    lines = [line.split("\t") for line in path.read_text().splitlines()]
    header = dict(zip(lines[1], lines[2], strict=True))
    rows = np.array([[float(cell) if cell else np.nan for cell in line] for line in lines[5:]])
    return header, [name for name in lines[3][2:] if name], rows


def test_trc_is_upright_in_millimetres(tmp_path: Path):
    write_calibration(tmp_path / "a.trc", motion(), "trc")
    header, names, rows = read_trc(tmp_path / "a.trc")
    assert header == {
        "DataRate": "50", "CameraRate": "50", "NumFrames": "4", "NumMarkers": "2", "Units": "mm", "OrigDataRate": "50",
        "OrigDataStartFrame": "1", "OrigNumFrames": "4",
    }  # fmt: skip
    assert names == ["left_ankle", "head"]
    assert rows[:, 1].tolist() == [0, 0.02, 0.04, 0.06]
    x, y, z = np.moveaxis(motion().points, -1, 0) * 1000
    expected = np.stack([x, z, -y], axis=-1)  # forward, up, to the right
    assert np.allclose(rows[:, 2:].reshape(4, 2, 3), expected, equal_nan=True)


def test_the_frame_of_a_camera_is_turned_upright_for_trc():
    x, y, z = np.moveaxis(motion("camera").points, -1, 0)
    assert np.array_equal(motion("camera").with_y_up().points, np.stack([x, -y, -z], axis=-1), equal_nan=True)


def test_a_pause_becomes_empty_frames(tmp_path: Path):
    paused = replace(motion(), times=np.array([0, 0.02, 0.08, 0.10]))
    write_calibration(tmp_path / "a.trc", paused, "trc")
    _, _, rows = read_trc(tmp_path / "a.trc")
    assert rows[:, 0].tolist() == [1, 2, 3, 4, 5, 6]
    assert np.isfinite(rows[:, 2]).tolist() == [True, True, False, False, True, True]
    with pytest.raises(CalibrationError, match=r"not evenly spaced.*4 frames within 50001"):
        write_calibration(tmp_path / "b.trc", replace(motion(), times=np.array([0, 1, 2, 1000.0])), "trc")


@pytest.mark.parametrize("format", ["trc", "c3d"])
def test_a_format_without_times_needs_a_frame_rate(format: str, tmp_path: Path):
    if format == "c3d":
        pytest.importorskip("ezc3d")
    with pytest.raises(CalibrationError, match=r"needs a frame rate.*--fps"):
        write_calibration(tmp_path / "a", motion(rate=None), format)


def test_c3d_marks_points_that_are_not_known(tmp_path: Path):
    ezc3d = pytest.importorskip("ezc3d")
    write_calibration(tmp_path / "a.c3d", motion(), "c3d")
    file = ezc3d.c3d(str(tmp_path / "a.c3d"))
    point = file["parameters"]["POINT"]
    assert point["UNITS"]["value"] == ["mm"]
    assert point["RATE"]["value"][0] == 50
    assert point["LABELS"]["value"] == ["left ankle", "head"]
    assert [point[f"{axis}_SCREEN"]["value"] for axis in "XY"] == [["+X"], ["+Z"]]
    residuals = file["data"]["meta_points"]["residuals"][0]
    assert (residuals < 0).T.tolist() == np.isnan(motion().points[..., 0]).tolist()
    known = residuals >= 0
    expected = np.moveaxis(1000 * motion().points, -1, 0).swapaxes(1, 2)
    assert np.allclose(file["data"]["points"][:3][:, known], expected[:, known], atol=1e-3)


def test_c3d_has_events_in_minutes_and_seconds_since_its_first_frame(tmp_path: Path):
    ezc3d = pytest.importorskip("ezc3d")
    late = replace(motion(), times=70.0 + motion().times, events=(("top", 70.03), ("impact 2", 191.5)))
    write_calibration(tmp_path / "a.c3d", late, "c3d")
    event = ezc3d.c3d(str(tmp_path / "a.c3d"))["parameters"]["EVENT"]
    assert event["USED"]["value"][0] == 2
    assert event["LABELS"]["value"] == ["top", "impact 2"]
    assert np.allclose(event["TIMES"]["value"], [[0, 2], [0.03, 1.5]], atol=1e-4)
    write_calibration(tmp_path / "a.trc", late, "trc")  # a format without events leaves them out


def test_c3d_without_its_package_is_one_clear_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "ezc3d", None)
    with pytest.raises(CalibrationError, match=r"need the package ezc3d.*pip install ezc3d"):
        write_calibration(tmp_path / "a.c3d", motion(), "c3d")


def test_tables_and_arrays_hold_the_points_exactly(calibration: Calibration, tmp_path: Path):
    write_calibration(tmp_path / "a.csv", calibration, "csv")
    lines = (tmp_path / "a.csv").read_text().splitlines(keepends=True)
    rows = list(csv.DictReader(io.StringIO("".join(line for line in lines if not line.startswith("#")))))
    points = calibration.points.numpy()
    assert len(rows) == int(np.isfinite(points).all(-1).sum())
    for row in rows[::97]:
        place = points[int(row["frame"]), calibration.point_names.index(row["point"])]
        assert [float(row[f"{axis}_m"]) for axis in "xyz"] == place.tolist()
    write_calibration(tmp_path / "a.npz", calibration, "npz")
    with np.load(tmp_path / "a.npz") as arrays:
        assert np.array_equal(arrays["points_m"], points, equal_nan=True)
        assert arrays["names"].tolist() == list(calibration.point_names)


def test_points_are_not_cameras(calibration: Calibration, tmp_path: Path):
    with pytest.raises(CalibrationError, match=r"a format that holds points.*cameras alone"):
        write_calibration(tmp_path / "a.trc", Rig.of_calibration(calibration), "trc")
    with pytest.raises(CalibrationError, match=r"a format that holds cameras.*points alone"):
        write_calibration(tmp_path / "a.toml", motion(), "pose2sim")


def test_the_script_for_blender_makes_the_cameras(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """The script runs, with what it uses of Blender in the place of Blender, and its cameras project as ours."""
    given = rig(lens=0)
    write_calibration(tmp_path / "cameras.py", given, "blender")
    made: list[tuple[types.SimpleNamespace, types.SimpleNamespace]] = []
    scene = types.SimpleNamespace(render=types.SimpleNamespace(), camera=None)

    def new(name: str, data: types.SimpleNamespace) -> types.SimpleNamespace:
        made.append((data, types.SimpleNamespace(name=name)))
        return made[-1][1]

    bpy = types.SimpleNamespace(
        data=types.SimpleNamespace(
            cameras=types.SimpleNamespace(new=lambda name: types.SimpleNamespace()), objects=types.SimpleNamespace(new=new)
        ),
        context=types.SimpleNamespace(
            scene=scene,
            collection=types.SimpleNamespace(objects=types.SimpleNamespace(link=lambda camera: None)),
        ),
    )
    monkeypatch.setitem(sys.modules, "bpy", bpy)
    monkeypatch.setitem(sys.modules, "mathutils", types.SimpleNamespace(Matrix=np.array))
    runpy.run_path(str(tmp_path / "cameras.py"))
    for camera, (data, made_object) in enumerate(made):
        assert made_object.name == given.names[camera]
        point = given.rotations[camera].numpy().T @ (np.array([0.3, -0.2, 2.0]) - given.translations[camera].numpy())
        seen = np.linalg.inv(made_object.matrix_world) @ [*point, 1]  # x right, y up, z backwards
        pixels_per_mm = SIZE[0] / data.sensor_width
        u = SIZE[0] / 2 - data.shift_x * SIZE[0] + data.lens * pixels_per_mm * seen[0] / -seen[2]
        assert abs(u - 0.5 - (given.intrinsics[camera] @ torch.tensor([0.15, -0.1, 1.0], dtype=torch.float64))[0]) < 1e-6
        v0 = SIZE[1] / 2 + data.shift_y * SIZE[0]
        assert abs(v0 - 0.5 - given.intrinsics[camera][1, 2]) < 1e-9


def test_sets_of_results_are_written_whole(calibration: Calibration, tmp_path: Path):
    """A folder of several files keeps what else is in it, and is as before where one of them cannot be written."""
    folder = tmp_path / "colmap"
    folder.mkdir()
    (folder / "mine.txt").write_text("keep")
    (folder / "images.txt").mkdir()
    with pytest.raises(OSError, match="images"):
        write_calibration(folder, calibration, "colmap")
    assert sorted(path.name for path in folder.iterdir()) == ["images.txt", "mine.txt"]
    (folder / "images.txt").rmdir()
    write_calibration(folder, calibration, "colmap")
    assert sorted(path.name for path in folder.iterdir()) == ["cameras.txt", "images.txt", "mine.txt", "points3D.txt"]


def test_an_opencap_pickle_is_read_by_any_version_of_numpy(calibration: Calibration, tmp_path: Path):
    write_calibration(tmp_path / "opencap", calibration, "opencap")
    file = next((tmp_path / "opencap").rglob("*.pickle"))
    assert b"numpy._core" not in file.read_bytes()
    script = f"import pickle; print(sorted(pickle.load(open({str(file)!r}, 'rb'))))"
    keys = subprocess.run([sys.executable, "-W", "ignore", "-c", script], capture_output=True, text=True, check=True).stdout
    assert "intrinsicMat" in keys
