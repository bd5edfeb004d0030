"""Figures, tables and texts of a calibration."""

from __future__ import annotations

import doctest
import re
import subprocess
import sys
from dataclasses import replace
from html import unescape

import numpy as np
import pytest
import torch
from mpl_toolkits.mplot3d import proj3d

from torchstickcal import Calibration, ObservationError, Stick, calibrate
from torchstickcal.geometry import se3
from torchstickcal.io.skeletons import SKELETONS
from torchstickcal.show import look, skeleton, tables
from torchstickcal.show.page import packing, page
from torchstickcal.show.report import summary, table
from torchstickcal.show.space import plot_rotation
from torchstickcal.show.tables import Column, Table, camera_facts, camera_table
from torchstickcal.simulate import Noise, golf_session

OBSERVATIONS, TRUTH = golf_session(cameras=4, frames=20, noise=Noise(sigma_px=1.0, outliers=0.05))


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    return calibrate(OBSERVATIONS)


def in_another_frame(calibration: Calibration, turn: torch.Tensor) -> Calibration:
    """The same rig in a frame that is turned and moved."""
    offset = torch.tensor([3.0, -2.0, 5.0], dtype=torch.float64)
    rotations = calibration.rotations @ turn.mT
    return replace(
        calibration,
        rotations=rotations,
        translations=calibration.translations - (rotations @ offset),
        points=calibration.points @ turn.mT + offset,
        judgement=calibration.quality,
    )


@pytest.mark.parametrize("degrees", [[0, 0, 0], [90, 0, 0], [0, 0, 130], [-40, 70, 20]])
def test_the_scene_is_drawn_in_its_own_axes_and_upright(calibration: Calibration, degrees: list[float]):
    tangent = torch.tensor([0, 0, 0, *degrees], dtype=torch.float64).deg2rad()
    turn = se3.exp(tangent)[0]
    turned = in_another_frame(calibration, turn)
    figure = turned.plot(5)
    figure.canvas.draw()
    axes = figure.axes[0]
    body = next(one for one in axes.collections if hasattr(one, "_offsets3d"))
    drawn = np.stack([np.asarray(one) for one in body._offsets3d], axis=1)
    assert np.abs(drawn - turned.points[5].numpy()).max() < 1e-9

    up = plot_rotation(turned)[2].numpy()
    middle = turned.camera_centres.mean(0).numpy()
    x, y, _ = proj3d.proj_transform(*np.stack([middle, middle + 0.5 * up], axis=1), axes.get_proj())
    angle = np.degrees(np.arctan2(x[1] - x[0], y[1] - y[0]))
    assert abs(angle) < 1.0, "up in the scene is up in the figure"


def test_plots_of_what_is_not_there(calibration: Calibration):
    with pytest.raises(ObservationError, match="a number from 0 to 19"):
        calibration.plot(20)
    assert len(calibration.plot_residuals().axes) == 5
    errors = calibration.plot_stick().axes[0].lines[1].get_ydata()
    assert np.allclose(errors, 1000 * (calibration.stick_lengths_m[:, 0].numpy() - 1.0))
    without = replace(calibration, sticks=(), stick_lengths_m=calibration.stick_lengths_m[:, :0], judgement=calibration.quality)
    assert without.plot_stick().texts[0].get_text() == "no stick"
    two = calibrate(replace(OBSERVATIONS, sticks=(OBSERVATIONS.sticks[0], Stick("left_knee", "left_ankle", 0.4, sigma_m=0.05))))
    assert [axes.get_title() for axes in two.plot_stick().axes] == [
        "club_grip - club_head, 1 m",
        "left_knee - left_ankle, 0.4 m",
    ]


@pytest.mark.parametrize("what", ["no athlete", "one frame", "nothing"])
def test_figures_of_little(calibration: Calibration, what: str):
    if what == "no athlete":
        found = calibrate(OBSERVATIONS, "stick_only")
    elif what == "one frame":
        found = calibrate(replace(OBSERVATIONS, keypoints=OBSERVATIONS.keypoints[:, :1]))
    else:
        nothing = {
            name: torch.full_like(getattr(calibration, name), torch.nan)
            for name in ("points", "residuals_px", "stick_lengths_m")
        }
        found = replace(calibration, **nothing, inliers=calibration.inliers & False, judgement=calibration.quality)
    for figure in (found.plot(), found.plot_residuals(), found.plot_stick()):
        figure.canvas.draw()
    assert found.quality.verdict in page.report_page(found)


def test_a_calibration_in_one_line_and_as_html(calibration: Calibration):
    line = repr(calibration)
    assert "\n" not in line
    assert len(line) < 120
    for word in ("good", "4 cameras", "20 frames", "21 points", "mm"):
        assert word in line
    names = ("<i>left</i>", "b & c", "c", "d")
    html = replace(calibration, camera_names=names, judgement=calibration.quality)._repr_html_()
    assert "<i>" not in html
    assert names[0] in unescape(html)
    assert "good" in html
    assert "<table>" in html
    assert calibration.summary() == summary(calibration)


def test_tables_explain_themselves_and_stay_aligned(calibration: Calibration):
    full, short = table(calibration), table(calibration, verbose=False)
    assert short in full
    for word in ("why it stopped", "Focal length", "club_grip - club_head", "Points"):
        assert word in full
        assert word not in short
    lines = short.splitlines()
    assert re.split(r" {2,}", lines[0].strip())[:2] == ["camera", "position x, y, z"]
    ends = {line.rindex("%") for line in lines if line.startswith("cam0")}
    assert len(ends) == 1, "columns are aligned"
    used = calibration.inliers.flatten(1).sum(1).tolist()
    assert [int(row[5]) for row in camera_table(camera_facts(calibration)).rows] == used


def test_an_unknown_of_a_module_that_is_not_imported_is_shown(calibration: Calibration):
    own = replace(calibration.unknowns["focal"], label="aspect ratio", unit="")
    with_own = replace(calibration, unknowns={**calibration.unknowns, "aspect": own}, judgement=calibration.quality)
    assert "Aspect ratio" in table(with_own)
    assert "Aspect ratio" in page.report_page(with_own)


def test_no_text_breaks_a_table():
    rows = (("a\nb", "1"), ("<x>\x1b[31m", "22"))
    made = Table("T & t", (Column("name", is_text=True), Column("n", "mm", "how 'many'")), rows)
    lines = made.text().splitlines()
    assert [lines[0], lines[1], *lines[3:]] == [
        "name            n",
        "             (mm)",
        "a\\nb            1",
        "<x>\\x1b[31m    22",
    ]
    assert "<x>" not in made.html()
    assert "T &amp; t" in made.html()


@pytest.mark.parametrize("name", SKELETONS)
def test_every_skeleton_has_bones_from_the_shoulders_to_the_feet(name: str):
    points = SKELETONS[name]
    bones = skeleton.bones_of(points)
    joined = {frozenset((points[a], points[b])) for a, b in bones}
    assert len(joined) == len(bones)
    for side in ("left", "right"):
        assert {frozenset((f"{side}_shoulder", f"{side}_elbow")), frozenset((f"{side}_elbow", f"{side}_wrist"))} <= joined
        assert any(f"{side}_ankle" in bone for bone in joined)
    assert skeleton.bones_of(None) == []


def test_showing_imports_nothing_that_is_not_needed():
    program = (
        "import sys, torchstickcal.result as r; from torchstickcal.show.report import table; "
        "import torchstickcal.show.page.page; print('matplotlib' in sys.modules)"
    )
    found = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "False"


@pytest.mark.parametrize("module", [look, skeleton, tables, packing, page])
def test_examples_run(module: object):
    assert doctest.testmod(module).failed == 0  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("columns", [1, 40, 57, 80, 118, 300])
@pytest.mark.parametrize("unit", ["%", "mm", "px", "deg", "ms"])
def test_sentences_fit_into_the_terminal_and_numbers_keep_their_units(unit: str, columns: int, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("COLUMNS", str(columns))
    sentence = " ".join(f"about {number} {unit} of it" for number in range(40))
    lines = look.wrapped(sentence, others="    ")
    assert max(map(len, lines)) <= max(40, min(118, columns))
    assert not any(re.match(rf"\s*{unit}", line) for line in lines)
    assert " ".join(line.strip() for line in lines) == sentence


def test_the_table_of_the_cameras_fits_into_80_columns(calibration: Calibration):
    far = [facts._replace(centre_m=[-12.3456, 7.0, 123.4]) for facts in camera_facts(calibration)]
    for facts, widest in ((camera_facts(calibration), 80), (far, 86)):
        lines = camera_table(facts).text().splitlines()
        assert max(map(len, lines)) <= widest
        heads = " ".join(" ".join(line.split()) for line in lines[:4])
        assert all(word in heads for word in ("position", "reprojection", "keypoints", "used", "share", "(px, median)"))


def test_a_point_without_keypoints_has_no_noise(calibration: Calibration):
    nothing = torch.zeros_like(calibration.inliers[..., :1])
    inliers = torch.cat([nothing, calibration.inliers[..., 1:]], -1)
    residuals = calibration.residuals_px.clone()
    residuals[:, :, 0] = torch.nan
    rows = tables.point_table(replace(calibration, inliers=inliers, residuals_px=residuals)).rows
    assert rows[0][1:4] == ("-", "0", "-")
    assert rows[1][1] != "-"
