"""The recording for the Rerun viewer: what is in it, and what happens without the package."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from torchstickcal import Calibration, CalibrationError, ResultFiles, calibrate
from torchstickcal.cli import main
from torchstickcal.io import write_npz
from torchstickcal.show.rerun import write_rerun
from torchstickcal.simulate import Noise, golf_session

OBSERVATIONS, _ = golf_session(cameras=3, frames=12, noise=Noise(sigma_px=1.0, missing=0.2, outliers=0.1))


class Columns(dict[str, Any]):
    """Columns of one entity; ``lengths`` has the number of entries of each frame."""

    def partition(self, lengths: Any) -> Columns:
        self.lengths = list(lengths)
        return self


class Thing:
    """Whatever is logged: its kind and its arguments."""

    def __init__(self, *args: Any, **values: Any) -> None:
        self.args, self.values = args, values

    @classmethod
    def from_fields(cls, **values: Any) -> Thing:
        return cls(**values)

    @classmethod
    def columns(cls, **values: Any) -> Columns:
        return Columns(values)


class FakeRerun(ModuleType):
    """Takes what the package takes, and remembers it."""

    def __init__(self) -> None:
        super().__init__("rerun")
        self.static: dict[str, list[Thing]] = {}
        self.sent: dict[str, tuple[Any, Columns]] = {}
        fake = self

        class Stream:
            def __init__(self, *args: Any, **values: Any) -> None:
                pass

            def save(self, path: Path) -> None:
                Path(path).write_bytes(b"RRF2")

            def log(self, path: str, thing: Any, static: bool = False) -> None:
                assert static
                fake.static.setdefault(path, []).append(thing)

            def send_columns(self, path: str, indexes: Any, columns: Columns) -> None:
                fake.sent[path] = (indexes, columns)

            def disconnect(self) -> None:
                pass

        class TimeColumn:
            def __init__(self, name: str, **values: Any) -> None:
                self.name, ((self.kind, self.values),) = name, values.items()

        kinds = ("Points3D", "Points2D", "LineStrips3D", "Transform3D", "Pinhole")
        kinds += ("AnnotationInfo", "ClassDescription", "AnnotationContext")
        for name in kinds:
            setattr(self, name, type(name, (Thing,), {}))
        self.RecordingStream, self.TimeColumn = Stream, TimeColumn
        self.ViewCoordinates = type("Axes", (), {"RIGHT_HAND_Z_UP": "z up", "RIGHT_HAND_Y_DOWN": "y down", "RDF": "RDF"})
        self.new_entity_path = "/".join


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    return calibrate(OBSERVATIONS)


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch) -> FakeRerun:
    module = FakeRerun()
    monkeypatch.setitem(sys.modules, "rerun", module)
    return module


def test_the_recording_has_everything_where_it_is(calibration: Calibration, fake: FakeRerun, tmp_path: Path):
    write_rerun(tmp_path / "scene.rrd", calibration)
    assert (tmp_path / "scene.rrd").exists()
    frames = len(calibration.points)
    for indexes, columns in fake.sent.values():
        assert [(index.name, index.kind, len(index.values)) for index in indexes] == [
            ("frame", "sequence", frames),
            ("time", "duration", frames),
        ]
        assert len(columns.lengths) == frames
        assert len(next(iter(columns.values()))) == sum(columns.lengths)
    known = calibration.points.isfinite().all(-1)
    assert np.allclose(fake.sent["world/athlete"][1]["positions"], calibration.points[known].numpy(), atol=1e-5)
    (_, stick), *more = (sent for path, sent in fake.sent.items() if path.startswith("world/sticks/"))
    assert not more
    lengths = [float(np.linalg.norm(ends[1] - ends[0])) for ends in stick["strips"]]
    assert np.allclose(lengths, calibration.stick_lengths_m[:, 0][calibration.stick_lengths_m[:, 0].isfinite()], atol=1e-5)
    for camera, name in enumerate(calibration.camera_names):
        (pose,), (lens,) = fake.static[f"world/cameras/{name}"], fake.static[f"world/cameras/{name}/image"]
        assert np.allclose(pose.values["translation"], calibration.camera_centres[camera])
        assert np.allclose(pose.values["mat3x3"], calibration.rotations[camera].T)
        assert np.allclose(lens.values["image_from_camera"], calibration.intrinsics[camera])
        used = fake.sent[f"world/cameras/{name}/image/used"][1]
        straight = calibration.inliers[camera] & ~calibration.relabelled[camera]
        assert np.allclose(used["positions"], OBSERVATIONS.keypoints[camera][straight], atol=1e-2)
        assert used["keypoint_ids"].tolist() == straight.nonzero()[:, 1].tolist()


def without_times(calibration: Calibration) -> Calibration:
    return replace(calibration, times=None, fps=None)


def without_names(calibration: Calibration) -> Calibration:
    return replace(calibration, point_names=None, image_size=None, camera_names=("a/b", "left <1>", ""))


def without_sticks(calibration: Calibration) -> Calibration:
    return replace(calibration, sticks=(), stick_lengths_m=calibration.stick_lengths_m[:, :0])


@pytest.mark.parametrize("change", [without_times, without_names, without_sticks])
def test_any_calibration_can_be_written(change: Any, calibration: Calibration, tmp_path: Path, fake: FakeRerun):
    write_rerun(tmp_path / "scene.rrd", change(calibration))
    assert "world/athlete" in fake.sent
    names = [index.name for index in fake.sent["world/athlete"][0]]
    assert names == (["frame"] if change is without_times else ["frame", "time"])


@pytest.mark.parametrize("up", ["z", None])
def test_up_is_up(up: str | None, calibration: Calibration, tmp_path: Path, fake: FakeRerun):
    write_rerun(tmp_path / "scene.rrd", replace(calibration, world=replace(calibration.world, up=up)))
    assert fake.static["world"][0] == ("z up" if up else "y down")


def test_the_commands_write_it_where_they_are_asked_to(tmp_path: Path, fake: FakeRerun, capsys: pytest.CaptureFixture[str]):
    write_npz(tmp_path / "swing.npz", OBSERVATIONS)
    out = tmp_path / "out"
    assert main(["calibrate", str(tmp_path / "swing.npz"), "--out", str(out)]) == 0
    assert not (out / "scene.rrd").exists()
    assert main(["report", str(out), "--rrd"]) == 0
    (out / "scene.rrd").unlink()
    assert main(["calibrate", str(tmp_path / "swing.npz"), "--out", str(out), "--rrd"]) == 0
    assert (out / "scene.rrd").exists()
    assert "report.html, scene.rrd in" in capsys.readouterr().out


@pytest.mark.parametrize("command", ["calibrate", "calibrate-many", "report"])
def test_without_the_package_one_error_says_so_before_anything_is_done(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], calibration: Calibration
):
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(CalibrationError, match=r"rerun-sdk.*pip install"):
        ResultFiles(rerun=True)
    write_npz(tmp_path / "swing.npz", OBSERVATIONS)
    out = tmp_path / "out"
    if command == "report":
        out.mkdir()
        calibration.save(out / "points.npz")
        words = [command, str(out)]
    else:
        words = [command, str(tmp_path / "swing.npz"), "--out", str(out)]
    assert main([*words, "--rrd"]) == 2
    assert 'pip install "torchstickcal[rerun]"' in capsys.readouterr().err
    assert not out.exists() or [path.name for path in out.iterdir()] == ["points.npz"]


def test_the_package_reads_what_was_written(calibration: Calibration, tmp_path: Path):
    pytest.importorskip("rerun", reason="needs rerun-sdk")
    write_rerun(tmp_path / "scene.rrd", replace(calibration, camera_names=("a/b", "left <1>", "c")))
    content = (tmp_path / "scene.rrd").read_bytes()
    assert content.startswith(b"RRF")
    assert len(content) > 10_000
