"""Files from anywhere, and sets of files: damaged and hostile ones are refused, and results are written whole."""

from __future__ import annotations

import io
import json
import os
import pickle
import signal
import struct
import subprocess
import sys
import tracemalloc
import zipfile
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from torchstickcal import Calibration, CalibrationError, FileFormatError, calibrate, files
from torchstickcal.archives import save_arrays
from torchstickcal.files import atomic_path, atomic_set, json_text, try_writing
from torchstickcal.io import (
    Rig,
    Truth,
    read_calibration,
    read_camera_toml,
    read_session,
    safe_pickle,
    write_camera_toml,
    write_npz,
)
from torchstickcal.simulate import golf_session

READERS = [read_session, read_calibration, read_camera_toml, Calibration.load, safe_pickle.load]


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    return calibrate(golf_session(cameras=3, frames=10)[0])


@pytest.fixture(params=["session", "calibration"])
def good(
    request: pytest.FixtureRequest, tmp_path: Path, calibration: Calibration
) -> tuple[Path, Callable[[Path], object], str]:
    """A whole ``.npz`` file, its reader, and the name of one of its arrays."""
    if request.param == "calibration":
        calibration.save(tmp_path / "c.npz")
        return tmp_path / "c.npz", Calibration.load, "points"
    write_npz(tmp_path / "s.npz", *golf_session(cameras=3, frames=10))
    return tmp_path / "s.npz", read_session, "keypoints"


def archive(path: Path, arrays: Mapping[str, Any], raw: Mapping[str, bytes], method: int = zipfile.ZIP_DEFLATED) -> Path:
    """An ``.npz`` file of arrays and of bytes that stand in the place of an array's file."""
    with zipfile.ZipFile(path, "w", method) as file:
        for name, array in arrays.items():
            if name not in raw:
                stream = io.BytesIO()
                np.lib.format.write_array(stream, np.asarray(array))
                file.writestr(f"{name}.npy", stream.getvalue())
        for name, content in raw.items():
            file.writestr(f"{name}.npy", content)
    return path


def npy(descr: str, shape: str, data: bytes = b"") -> bytes:
    header = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}".encode().ljust(117) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + data


# --- .npz --------------------------------------------------------------------------------------------------------------------


def test_a_damaged_npz_is_refused_wherever_the_damage_is(good):
    path, read, _ = good
    whole, rng = path.read_bytes(), np.random.default_rng(0)
    for place in (*rng.integers(0, len(whole), 60), *range(len(whole) - 300, len(whole), 7)):
        damaged = bytearray(whole)
        damaged[place] ^= 255
        path.write_bytes(damaged)
        with suppress(FileFormatError):  # a byte that nobody needs may change
            read(path)
    for length in (0, 1, 4, 30, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:length])
        with pytest.raises(FileFormatError):
            read(path)


@pytest.mark.parametrize(
    ("descr", "shape"),
    [
        ("'<f8'", "(1000000000000,)"),
        ("'<f8'", "(1000000000000, 0)"),
        ("'<U0'", "(1000000000000,)"),
        ("'<f8'", "(-1,)"),
        ("'|O'", "(3,)"),
        ("[('a', '<f8')]", "(3,)"),
        ("('<f8', (1000000,))", "(1000000,)"),
        ("(" * 3000, "(3,)"),
    ],
)
def test_an_array_that_declares_nonsense_is_refused(good, descr: str, shape: str, tmp_path: Path):
    path, read, name = good
    with np.load(path) as arrays:
        bad = archive(tmp_path / "bad.npz", arrays, {name: npy(descr, shape)})
    with pytest.raises(FileFormatError, match=r"bad\.npz"):
        read(bad)


def test_a_small_file_gets_little_memory(good, tmp_path: Path):
    """64 MB of zeros in a file of about 100 kB: not read where nobody needs them, refused where they are needed."""
    path, read, name = good
    zeros = npy("'<f8'", f"({2**23},)", bytes(2**26))
    with np.load(path) as arrays:
        unneeded = archive(tmp_path / "a.npz", arrays, {"other": zeros})
        needed = archive(tmp_path / "b.npz", arrays, {name: zeros})
    del zeros
    tracemalloc.start()
    read(unneeded)
    with pytest.raises(FileFormatError, match="times the size of the file"):
        read(needed)
    assert tracemalloc.get_traced_memory()[1] < 50 * 2**20
    tracemalloc.stop()


def test_only_compressions_of_numpy_are_read(good, tmp_path: Path):
    path, read, _ = good
    with np.load(path) as arrays:
        read(archive(tmp_path / "a.npz", arrays, {}, zipfile.ZIP_STORED))
        with pytest.raises(FileFormatError, match="compressed by method 14"):
            read(archive(tmp_path / "b.npz", arrays, {}, zipfile.ZIP_LZMA))


def test_a_session_of_another_byte_order_is_the_same(tmp_path: Path):
    write_npz(tmp_path / "a.npz", *golf_session(cameras=3, frames=10))
    with np.load(tmp_path / "a.npz") as arrays:
        other = {name: array.astype(array.dtype.newbyteorder(">")) for name, array in arrays.items()}
    (one, _), (two, _) = (read_session(path) for path in (tmp_path / "a.npz", archive(tmp_path / "b.npz", other, {})))
    assert torch.equal(one.keypoints, two.keypoints)


@pytest.mark.parametrize("change", [{"fisheye": 1}, {"stages": []}, {"seconds": None}, {"camera_names": ["a"]}, {"fps": "x"}])
def test_every_value_of_a_saved_calibration_is_checked(calibration: Calibration, tmp_path: Path, change: dict[str, Any]):
    calibration.save(tmp_path / "c.npz")
    with np.load(tmp_path / "c.npz") as arrays:
        meta = json.loads(str(arrays["meta"])) | change
        path = archive(tmp_path / "d.npz", {**arrays, "meta": json.dumps(meta)}, {})
    with pytest.raises(FileFormatError, match="not a saved calibration"):
        Calibration.load(path)


# --- what is no file ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("read", READERS)
def test_only_regular_files_are_opened(read: Callable[[Any], object], tmp_path: Path):
    (tmp_path / "empty").touch()
    places: list[Any] = [tmp_path, tmp_path / "empty", tmp_path / "empty" / "x", tmp_path / ("n" * 5000), "a\0b"]
    if hasattr(os, "mkfifo"):
        os.mkfifo(tmp_path / "fifo")
        places += [tmp_path / "fifo", "/dev/zero", "/dev/null"]
    for place in places:
        with pytest.raises(FileFormatError):
            read(place)
    with pytest.raises(FileNotFoundError):
        read(tmp_path / "absent")


# --- pickles -----------------------------------------------------------------------------------------------------------------


def text(value: str) -> bytes:
    return b"X" + struct.pack("<I", len(value)) + value.encode()


def laughs(depth: int) -> bytes:
    """A list of ten references to a list of ten references to ..."""
    lists = [b"]\x94(" + b"K\x01" * 10 + b"e"]
    lists += [b"]\x94(" + 10 * (b"h" + bytes([level])) + b"e" for level in range(depth)]
    return b"(" + b"".join(lists) + b"t."


TYPE_WITH_STATE = b"cnumpy\ndtype\n(" + text("f8") + b"\x89\x88tR(K\x03" + text("|") + b"NNNJ\x00\x10\x00\x00K\x08K\x00tb."
HOSTILE = {
    "memo of 2**31 entries": b"Nr\xff\xff\xff\x7f0.",
    "bytes of 2**62": b"\x8e" + struct.pack("<Q", 2**62) + b"abc.",
    "byte array of 10 GB": b"\x96" + struct.pack("<Q", 10**10) + b"abc.",
    "text of 1 TB": b"\x8d" + struct.pack("<Q", 10**12) + b".",
    "objects": b"cnumpy\ndtype\n(" + text("O8") + b"\x89\x88tR.",
    "type with a state": TYPE_WITH_STATE,
    "list in itself": b"]\x94h\x00a.",
    "billions of references": laughs(12),
    "system": b"cos\nsystem\n(" + text("true") + b"tR.",
    "a class": b"cnumpy\nndarray\n.",
    "an object": b"cnumpy\nndarray\n)\x81.",
    "empty stack": b".",
    "no end": b"N",
}


@pytest.mark.parametrize("program", HOSTILE.values(), ids=HOSTILE)
def test_hostile_pickles_are_refused(program: bytes, tmp_path: Path):
    (tmp_path / "x.pkl").write_bytes(b"\x80\x04" + program)
    tracemalloc.start()
    with pytest.raises(FileFormatError, match="more than plain data"):
        safe_pickle.load(tmp_path / "x.pkl")
    assert tracemalloc.get_traced_memory()[1] < 2**20
    tracemalloc.stop()


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_plain_data_of_every_protocol_and_numpy_is_read(protocol: int, tmp_path: Path):
    arrays = [np.arange(6.0).reshape(2, 3), np.asfortranarray(np.arange(6).reshape(2, 3)), np.zeros((0, 3)), np.array([True])]
    data = {"a": arrays, "big": np.arange(3, dtype=">i4"), "one": np.float64(3.5), "rest": [1, 2**100, None, (b"", {"x": {1}})]}
    content = pickle.dumps(data, protocol)
    modules = (b"numpy._core", b"numpy.core")
    for old, new in (modules, modules[::-1]):
        renamed = content.replace(old, new) if protocol < 4 else content  # later protocols write the length before the name
        (tmp_path / "x.pkl").write_bytes(renamed)
        back = safe_pickle.load(tmp_path / "x.pkl")
        for one, other in zip([*back["a"], back["big"]], [*data["a"], data["big"]], strict=True):
            np.testing.assert_array_equal(one, other)
        assert (back["one"], back["rest"]) == (data["one"], data["rest"])


# --- cameras -----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("rotation", "[nan, nan, nan]"),
        ("rotation", "[[1, 0, 0], [0, 1, 0], [0, 0, 1]]"),
        ("translation", "[inf, 0.0, 0.0]"),
        ("translation", "1" + "0" * 400),
        ("translation", "[" + "1" + "0" * 5000 + ", 0, 0]"),
        ("matrix", "[[nan, 0, 0], [0, 1, 0], [0, 0, 1]]"),
        ("distortions", "[[0.0]]"),
        ("distortions", "'x'"),
        ("size", "[1.0]"),
        ("fisheye", "'no'"),
        ("name", "[" * 3000 + "]" * 3000),
    ],
)
def test_cameras_that_are_none_are_refused(calibration: Calibration, tmp_path: Path, key: str, value: str):
    write_camera_toml(tmp_path / "c.toml", calibration)
    lines = (tmp_path / "c.toml").read_text().splitlines()
    changed = [f"{key} = {value}" if line.startswith(f"{key} =") else line for line in lines]
    (tmp_path / "c.toml").write_text("\n".join(changed))
    with pytest.raises(FileFormatError, match=r"c\.toml"):
        read_calibration(tmp_path / "c.toml")


@pytest.mark.parametrize(
    "names", [("a\x7fb", "\x00", "\x9f"), ('"', "\\", "\r\n"), ("", "[x] # y", "カメラ\u2028"), ("\ufeff", "\\n", "'''")]
)
def test_every_name_is_read_back(calibration: Calibration, tmp_path: Path, names: tuple[str, ...]):
    write_camera_toml(tmp_path / "c.toml", replace(calibration, camera_names=names))
    assert read_camera_toml(tmp_path / "c.toml").names == names


def test_a_name_that_no_file_can_hold_is_refused(calibration: Calibration, tmp_path: Path):
    with pytest.raises(CalibrationError, match="a text that cannot be written"):
        write_camera_toml(tmp_path / "c.toml", replace(calibration, camera_names=("a", "b", "\ud800")))
    write_npz(tmp_path / "a.npz", *golf_session(cameras=3, frames=10))
    with np.load(tmp_path / "a.npz") as arrays:
        path = archive(tmp_path / "b.npz", {**arrays, "camera_names": np.array(["a", "b", "\udcff"])}, {})
    with pytest.raises(FileFormatError, match="a text that cannot be written"):
        read_session(path)


def test_truths_and_rigs_are_checked():
    eye, zeros = torch.eye(3).expand(2, 3, 3), torch.zeros(2, 3)
    assert Truth(eye.numpy(), zeros.tolist()).translations.dtype == torch.float64
    for rotations, translations in (
        (eye, torch.zeros(3)),
        (eye, zeros * torch.nan),
        (2 * eye, zeros),
        (-eye, zeros),
        (zeros, zeros),
        (eye, "ab"),
        (eye * 1j, zeros),
    ):
        with pytest.raises(CalibrationError, match="Truth"):
            Truth(rotations, translations)
        with pytest.raises(CalibrationError, match="Rig"):
            Rig(("a", "b"), eye, (torch.zeros(5),) * 2, (False,) * 2, zeros[:, :2] + 1, rotations, translations)
    with pytest.raises(CalibrationError, match="not one value for each camera"):
        Rig(("a",), eye, (torch.zeros(5),) * 2, (False,) * 2, zeros[:, :2] + 1, eye, zeros)


def test_a_truth_of_another_session_is_refused(tmp_path: Path):
    observations, truth = golf_session(cameras=3, frames=10)
    write_npz(tmp_path / "a.npz", observations, replace(truth, points=None))
    with np.load(tmp_path / "a.npz") as arrays:
        path = archive(tmp_path / "b.npz", {**arrays, "points": np.zeros((9, 21, 3))}, {})
    with pytest.raises(FileFormatError, match="got 9 frames; expected 10 frames"):
        read_session(path)


# --- sets of files -----------------------------------------------------------------------------------------------------------

WRITE = """
import os, signal, sys, time
from torchstickcal.files import atomic_set
import torchstickcal.files as files
from pathlib import Path
count = 0
rename = Path.rename
def counted(self, target):
    global count
    if count == int(sys.argv[2]):
        os.kill(os.getpid(), signal.SIGKILL)
    count += 1
    return rename(self, target)
Path.rename = counted
with atomic_set(sys.argv[1]) as folder:
    for name in "abc":
        (folder / name).write_text("new")
"""


def contents(folder: Path) -> dict[str, str]:
    return {path.name: path.read_text() for path in folder.iterdir() if path.is_file()}


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="the system cannot kill")
def test_a_set_is_never_mixed_whenever_the_process_is_killed(tmp_path: Path):
    for moves in range(7):
        folder = tmp_path / str(moves)
        folder.mkdir()
        for name in "abc":
            (folder / name).write_text("old")
        (folder / "mine").write_text("mine")
        subprocess.run([sys.executable, "-c", WRITE, str(folder), str(moves)], check=False)
        found = contents(folder)
        assert found.pop("mine") == "mine"
        assert len(set(found.values())) <= 1, "old and new files side by side"
        assert {0: "old", 6: "new"}.get(moves) in {None, *found.values()}
        everything = [path.read_text() for path in folder.rglob("*") if path.is_file()]
        assert everything.count("new") == 3, "the new files are still there"


def test_a_set_that_fails_changes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    old = {"a": "old", "b": "old", "mine": "mine"}
    for name, content in old.items():
        (tmp_path / name).write_text(content)
    rename, moves = Path.rename, []

    def failing(self: Path, target: Path) -> Path:
        moves.append(self)
        if len(moves) == 4:
            raise OSError(28, "no space left")
        return rename(self, target)

    def write(fail: bool) -> None:
        with atomic_set(tmp_path) as folder:
            for name in "abc":
                (folder / name).write_text("new")
            if fail:
                raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write(fail=True)
    assert contents(tmp_path) == old
    monkeypatch.setattr(Path, "rename", failing)
    with pytest.raises(OSError, match="no space left"):
        write(fail=False)
    assert contents(tmp_path) == old
    assert len(list(tmp_path.iterdir())) == 3, "no temporary files are left"
    with pytest.raises(ZeroDivisionError), atomic_set(tmp_path / "new" / "folder"):
        _ = 1 / 0
    assert not (tmp_path / "new").exists()


def test_a_file_of_a_set_is_whole_or_not_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Also where the block goes on after an error; and every file of the set is put on the disk once."""
    synced: list[str] = []
    monkeypatch.setattr(files, "_to_disk", lambda path: synced.append(path.name))
    with atomic_set(tmp_path / "set") as folder:
        (folder / "inner").mkdir()
        for name in ("a", "inner/b"):
            with suppress(ZeroDivisionError), atomic_path(folder / name) as path:
                path.write_text("half")
                _ = 1 / 0
            assert not (folder / name).exists()
            with atomic_path(folder / name) as path:
                path.write_text("whole")
    assert sorted(synced) == ["a", "b", "set"]
    assert contents(tmp_path / "set") | contents(tmp_path / "set" / "inner") == {"a": "whole", "b": "whole"}
    assert len(list((tmp_path / "set").iterdir())) == 2, "nothing else is left"


def test_digits_are_stored_as_they_are_and_patterns_compressed(tmp_path: Path):
    digits, rng = {}, np.random.default_rng(0)
    digits["float64"], digits["float32"] = rng.standard_normal(5000), rng.standard_normal((50, 100)).astype(np.float32)
    patterns = {"numbers": np.arange(5000), "flags": np.ones((10, 500), dtype=bool), "gaps": np.full(5000, np.nan)}
    small = {"text": np.array("a"), "nothing": np.zeros((0, 3)), "scalar": np.array(1.0)}
    with (tmp_path / "a.npz").open("wb") as file:
        save_arrays(file, digits | patterns | small)
    with zipfile.ZipFile(tmp_path / "a.npz") as archive:
        sizes = {member.filename.removesuffix(".npy"): (member.compress_size, member.file_size) for member in archive.filelist}
    assert all(sizes[name][0] == sizes[name][1] for name in digits)
    assert all(sizes[name][0] < 0.5 * sizes[name][1] for name in patterns)
    with np.load(tmp_path / "a.npz") as found:
        for name, array in (digits | patterns | small).items():
            np.testing.assert_array_equal(found[name], array)


def test_a_folder_is_tried_without_a_trace(tmp_path: Path):
    (tmp_path / "file").touch()
    (tmp_path / "taken" / "points.npz").mkdir(parents=True)
    before = sorted(tmp_path.rglob("*"))
    try_writing(tmp_path / "a" / "b", ["points.npz"])
    for folder in ("file", "file/x", "taken", "n" * 300, "a\0b"):
        with pytest.raises(CalibrationError, match="results cannot be written"):
            try_writing(tmp_path / folder, ["points.npz"])
    assert sorted(tmp_path.rglob("*")) == before


def test_json_has_no_nan():
    content = {"a": float("nan"), "b": [float("inf"), 1.0, ("x", -float("inf"))], "c": "NaN"}
    for indent in (True, False):
        found = json.loads(json_text(content, indent), parse_constant=lambda name: pytest.fail(name))
        assert found == {"a": None, "b": [None, 1.0, ["x", None]], "c": "NaN"}


def test_json_has_lines_for_what_holds_more():
    content = {"a": [1.5, "x\n", None, True], "b": [{"c": {}, "d": []}, {"\u00e9": 2}], "e": {}}
    text = json_text(content)
    assert json.loads(text) == content == json.loads(json_text(content, indent=False))
    assert text.splitlines() == [
        "{",
        '  "a": [1.5, "x\\n", null, true],',
        '  "b": [',
        "    {",
        '      "c": {},',
        '      "d": []',
        "    },",
        '    {"\\u00e9": 2}',
        "  ],",
        '  "e": {}',
        "}",
    ]
