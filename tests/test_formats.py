"""File formats found by name and by content: the shipped ones, those of a user's own module, a new file in the folder."""

from __future__ import annotations

import importlib
import json
import os
import pickle
import shutil
import subprocess
import sys
import textwrap
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from torchstickcal import CalibrationError, ConfigError, FileFormatError, calibrate, io
from torchstickcal.io import (
    CALIBRATION_READERS,
    CALIBRATION_WRITERS,
    SESSION_READERS,
    find_reader,
    read_calibration,
    read_session,
    write_calibration,
    write_npz,
)
from torchstickcal.registry import Registry
from torchstickcal.simulate import golf_session

READERS = (SESSION_READERS, CALIBRATION_READERS)

OWN = '''
"""Sessions as folders with one text file per camera; points as text."""

from torchstickcal import Observations, Stick
from torchstickcal.files import atomic_path
from torchstickcal.io import calibration_writer, session_reader


@session_reader("toy", "a folder with a .track file per camera", recognises=lambda path, head: any(path.glob("*.track")))
def read_toy(path):
    tracks = [file.read_text().split() for file in sorted(path.glob("*.track"))]
    keypoints = [[[[float(x), float(y)] for x, y in zip(words[::2], words[1::2])]] for words in tracks]
    return Observations(keypoints, None, Stick(0, 1, 1.0), image_size=(640, 480)), None


@calibration_writer("toy", "one line per point", file_name="points.txt")
def write_toy(path, calibration):
    with atomic_path(path) as temporary:
        temporary.write_text("\\n".join(str(point) for point in calibration.points.flatten(0, 1).tolist()))
'''

FILE = '''
"""A calibration of one file that contains another one."""

from torchstickcal.io.formats import calibration_reader
from torchstickcal.io.rig import Rig


@calibration_reader("wrapped", "a calibration.toml behind a line of its own", recognises=lambda path, head: head[:4] == b"WRAP")
def read_wrapped(path) -> Rig:
    raise RuntimeError("no idea")
'''


BUILT_ON = """
from torchstickcal.io.camera_toml import read_camera_toml
from torchstickcal.io.formats import calibration_reader, session_reader
from torchstickcal.io.npz import read_npz

session_reader("aaa", "as npz", recognises=lambda path, head: False)(read_npz)
calibration_reader("aaa", "as pose2sim", recognises=lambda path, head: False)(read_camera_toml)
"""


@pytest.fixture
def toy(own_parts, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A session of a format that a module of the user registers."""
    (tmp_path / "my_formats.py").write_text(OWN)
    monkeypatch.syspath_prepend(tmp_path)
    importlib.import_module("my_formats")
    session = tmp_path / "session"
    session.mkdir()
    for name in ("a", "b"):
        (session / f"{name}.track").write_text("1 2 3 4")
    return session


@pytest.fixture
def shipped(tmp_path: Path) -> dict[str, tuple[Registry, Path]]:
    """A file of each shipped format, with an extension that says nothing."""
    session = golf_session(cameras=3, frames=10)
    write_npz(tmp_path / "a.dat", *session)
    (tmp_path / "b.dat").write_bytes(pickle.dumps({"num_cameras": 3}))
    write_calibration(tmp_path / "c.dat", calibrate(session[0]), "pose2sim")
    return {
        "npz": (SESSION_READERS, tmp_path / "a.dat"),
        "sports-stick-syn": (SESSION_READERS, tmp_path / "b.dat"),
        "pose2sim": (CALIBRATION_READERS, tmp_path / "c.dat"),
    }


def test_each_shipped_format_is_recognised_by_its_content(shipped: dict[str, tuple[Registry, Path]]):
    """And by its reader alone, so that the order of the readers does not matter."""
    assert set(shipped) <= {*SESSION_READERS, *CALIBRATION_READERS}
    for name, (registry, path) in shipped.items():
        head = path.read_bytes()[:4096]
        readers = [(kind, other) for kind in READERS for other in kind if kind[other].recognises(path, head)]
        assert readers == [(registry, name)]
        assert find_reader(path, SESSION_READERS, CALIBRATION_READERS) is registry[name]
    observations, _ = read_session(shipped["npz"][1])
    assert observations.num_cameras == 3
    assert read_calibration(shipped["pose2sim"][1]).names == ("cam01", "cam02", "cam03")


@pytest.mark.parametrize(
    ("text", "recognised"),
    [
        ('[cam_0]\nname = "a"\nmatrix = [[1.0]]\n', True),
        ("[metadata]\r\nerror = 0.0\r\n\r\n[1]\r\nsize = [ 1.0, 2.0]\r\nmatrix = [[1.0]]\r\n", True),
        ("[cameras.0]\ncam_id = 0\nmatrix = [[1.0]]\n", False),
        ("[tool.ruff]\nline-length = 128\n[matrix]\nmatrix_size = 3\n", False),
    ],
)
def test_a_calibration_toml_has_top_level_tables_with_a_matrix(text: str, recognised: bool, tmp_path: Path):
    assert CALIBRATION_READERS["pose2sim"].recognises(tmp_path, text.encode()) is recognised


def test_a_format_can_be_forced(shipped: dict[str, tuple[Registry, Path]]):
    assert read_session(shipped["npz"][1], "npz")[0].num_cameras == 3
    with pytest.raises(FileFormatError, match=r"a pickle file is damaged .*a\.dat"):
        read_session(shipped["npz"][1], "sports-stick-syn")
    with pytest.raises(ConfigError, match=r"unknown session format.*'npx'.*sports-stick-syn.*Did you mean 'npz'"):
        read_session(shipped["npz"][1], "npx")
    with pytest.raises(ConfigError, match=r"unknown calibration format.*'npz'.*pose2sim"):
        read_calibration(shipped["npz"][1], "npz")
    with pytest.raises(ConfigError, match=r"unknown output format.*'trk'.*pose2sim"):
        write_calibration("out", calibrate(golf_session(cameras=3, frames=10)[0]), "trk")


def test_a_reader_of_one_s_own_reads_a_folder(toy: Path):
    observations, truth = read_session(toy)
    assert observations.keypoints.tolist() == [[[[1, 2], [3, 4]]], [[[1, 2], [3, 4]]]]
    assert truth is None


def test_a_reader_of_one_s_own_may_take_a_special_case_of_a_shipped_format(shipped, own_parts):
    def read(path: Path) -> io.Session:
        observations, truth = io.read_npz(path)
        return observations.with_stick_length(2.0), truth

    io.session_reader("double", "an .npz with a long stick", recognises=lambda path, head: head[:2] == b"PK")(read)
    assert read_session(shipped["npz"][1])[0].sticks[0].length_m == 2.0
    assert read_session(shipped["npz"][1], "npz")[0].sticks[0].length_m == 1.0


def test_what_a_reader_of_one_s_own_does_not_expect_is_an_error_about_the_file(toy: Path):
    (toy / "a.track").write_text("1 2 three 4")
    with pytest.raises(
        FileFormatError, match=r"not of the expected format .*session\).*'three'; expected a folder with a \.track"
    ):
        read_session(toy)
    (toy / "a.track").write_text("1 2 3 4 5 6")
    with pytest.raises(CalibrationError):
        read_session(toy)


def test_a_writer_of_one_s_own_writes(toy: Path, tmp_path: Path):
    calibration = calibrate(golf_session(cameras=3, frames=10)[0])
    write_calibration(tmp_path / "points.txt", calibration, "toy")
    lines = (tmp_path / "points.txt").read_text().splitlines()
    assert len(lines) == 10 * 21
    assert json.loads(lines[0]) == calibration.points[0, 0].tolist()


def test_a_new_file_in_the_folder_is_found(own_parts, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "wrapped.py").write_text(FILE)
    monkeypatch.setattr(io, "__path__", [*io.__path__, str(tmp_path)])
    for registry in (*READERS, CALIBRATION_WRITERS):
        monkeypatch.setattr(registry, "_imported", False)
    (tmp_path / "a.txt").write_text("WRAP")
    with pytest.raises(FileFormatError, match=r"a\.txt.*RuntimeError: no idea; expected a calibration.toml behind a line"):
        read_calibration(tmp_path / "a.txt")


def test_a_new_file_may_build_on_shipped_formats(tmp_path: Path):
    """Whichever of the package's modules is imported first."""
    package = Path(io.__file__).parents[1]
    shutil.copytree(package, tmp_path / "torchstickcal", ignore=shutil.ignore_patterns("__pycache__"))
    (tmp_path / "torchstickcal" / "io" / "aaa.py").write_text(BUILT_ON)
    for module in ("io", "io.npz", "io.camera_toml", "io.aaa"):
        code = f"import torchstickcal.{module}; from torchstickcal.io import SESSION_READERS as S; print(list(S))"
        run = subprocess.run(
            [sys.executable, "-c", code],
            cwd=tmp_path,
            env=os.environ | {"PYTHONPATH": str(tmp_path)},
            capture_output=True,
            text=True,
            check=False,
        )
        assert "aaa" in run.stdout, run.stderr


def test_a_name_is_registered_once(own_parts):
    def write(path: Path, calibration: object) -> None:
        raise NotImplementedError

    with pytest.raises(ConfigError, match=r"the name is taken .*output format"):
        io.calibration_writer("pose2sim", "again", file_name="b.toml")(write)
    io.calibration_writer("pose2sim", "again", file_name="b.toml", replace=True)(write)
    assert CALIBRATION_WRITERS["pose2sim"].file_name == "b.toml"


def example(decorator: Callable) -> None:
    """Run the example in the description of a decorator."""
    assert decorator.__doc__
    exec(textwrap.dedent(decorator.__doc__.partition("Example::")[2]), {})


def test_the_examples_of_the_decorators(own_parts, tmp_path: Path):
    for decorator in (io.session_reader, io.keypoint_reader, io.camera_reader, io.calibration_reader, io.calibration_writer):
        example(decorator)
    (tmp_path / "d").write_text('{"tiny": {"left": [[[10, 20], [30, 40]]], "right": [[[50, 60], [70, 80]]]}}')
    assert [view.name for view in io.read_recording(tmp_path / "d").views] == ["left", "right"]
    (tmp_path / "e").mkdir()
    for name in ("left", "right"):
        (tmp_path / "e" / name).write_text("words\n1 2 3 4\n5 6 7 8\n")
    assert io.read_recording(tmp_path / "e").views[1].keypoints[1, :, :2].tolist() == [[5, 6], [7, 8]]
    (tmp_path / "a").write_text('{"toy": [[[[10, 20], [30, 40]]], [[[50, 60], [70, 80]]]]}')
    assert read_session(tmp_path / "a")[0].keypoints.shape == (2, 1, 2, 2)
    calibration = calibrate(golf_session(cameras=3, frames=10)[0])
    with (tmp_path / "b").open("wb") as file:
        np.save(file, torch.cat([calibration.intrinsics, calibration.rotations, calibration.translations[..., None]], dim=2))
    assert read_calibration(tmp_path / "b").translations.equal(calibration.translations)
    write_calibration(tmp_path / "c", calibration, "toy")
    assert (tmp_path / "c").read_text() == "cam01\ncam02\ncam03"
