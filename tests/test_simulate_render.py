"""Pictures of simulated sessions, and the command that makes both."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from torchstickcal.cli import main
from torchstickcal.simulate import Lens, SessionSpec, SimulatedSession, read_simulated
from torchstickcal.simulate.regimes import Outliers
from torchstickcal.simulate.render import View, camera_frames, contact_sheet, scene_frames, write_film, write_png


@pytest.fixture(scope="module")
def session() -> SimulatedSession:
    return SessionSpec(
        "kendo", "kendo", cameras=3, frames=12, fps=10, lens=Lens((640, 480)), regimes=(Outliers(0.1),)
    ).generate()


def test_the_athlete_is_drawn_and_moves(session: SimulatedSession):
    view = View(size=(320, 240))
    pictures = list(scene_frames(session, view))
    assert len(pictures) == 12
    assert all(picture.shape == (240, 320, 3) for picture in pictures)
    empty = view.draw(np.full((21, 3), [0.0, 0, -50]), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3, 3)))
    drawn = (pictures[0] != empty).any(-1)
    assert 0.005 < drawn.mean() < 0.2
    assert drawn[40:200, 120:200].mean() > drawn.mean()
    assert (pictures[0] != pictures[9]).any(-1).sum() > 100


def test_a_camera_s_picture_has_ink_at_its_keypoints_and_none_far_from_them(session: SimulatedSession):
    picture = next(iter(camera_frames(session, 1, width=640)))
    assert picture.shape == (480, 640, 3)
    ink = (picture != picture[0, 0]).any(-1)
    pixels = session.observations.keypoints[1, 0].numpy()
    pixels = pixels[np.isfinite(pixels).all(-1)]
    for x, y in np.round(pixels).astype(int):
        assert ink[max(0, y - 10) : y + 11, max(0, x - 10) : x + 11].any()
    rows, columns = np.nonzero(ink)
    assert pixels[:, 1].min() - 12 < rows.min()
    assert columns.max() < pixels[:, 0].max() + 12


def test_pictures_in_files(session: SimulatedSession, tmp_path: Path):
    write_film(tmp_path / "film.gif", session, View(size=(160, 120)))
    with Image.open(tmp_path / "film.gif") as film:
        assert (film.format, getattr(film, "n_frames", 1), film.size, film.info["duration"]) == ("GIF", 12, (160, 120), 100)
    sheet = contact_sheet(list(scene_frames(session, View(size=(160, 120))))[:5], columns=3)
    assert sheet.shape == (240, 480, 3)
    write_png(tmp_path / "sheet.png", sheet)
    with Image.open(tmp_path / "sheet.png") as picture:
        np.testing.assert_array_equal(np.array(picture), sheet)


def test_simulate_writes_sessions_that_can_be_calibrated(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    out = tmp_path / "sessions"
    assert main(["simulate", "sports-stick-syn", "--out", str(out), "--count", "2", "--seed", "7", "--gif"]) == 0
    shown = capsys.readouterr()
    assert "2 sessions in" in shown.out
    assert shown.err == ""  # progress is for terminals
    stems = ["circle_golf_noise0.1_cam3", "circle_golf_noise0.1_cam4"]
    assert sorted(file.name for file in out.iterdir()) == sorted(f"{stem}.{kind}" for stem in stems for kind in ("npz", "gif"))
    assert read_simulated(out / f"{stems[0]}.npz").name == stems[0]
    assert main(["benchmark", str(out), "--json", str(tmp_path / "scores.json")]) == 0
    assert "2 of 2 converged" in capsys.readouterr().out


def test_simulate_lists_what_there_is(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert main(["simulate", "curling", "--out", str(tmp_path)]) == 2
    shown = capsys.readouterr().err
    for name in ("sports-stick-syn", "hard", "regimes", "golf", "baseball", "hockey", "kendo", "wand"):
        assert name in shown
