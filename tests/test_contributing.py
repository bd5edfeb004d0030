"""The recipes in CONTRIBUTING.md, followed word for word with --plugin."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from torchstickcal.cli import main
from torchstickcal.result import Calibration
from torchstickcal.simulate import golf_session
from torchstickcal.simulate.session import read_simulated

TEXT = (Path(__file__).parents[1] / "CONTRIBUTING.md").read_text("utf-8")
RECIPES = dict(re.findall(r"`[\w/]+/(\w+)\.py`:\n\n```python\n(.*?)```", TEXT, flags=re.DOTALL))

NAMES = {"equal_forearms", "aspect", "aspect_shared", "low_frame_rate", "tracks", "positions", "tennis", "stick_and_height"}


@pytest.fixture(autouse=True)
def not_registered(own_parts, monkeypatch: pytest.MonkeyPatch) -> None:
    """Forget the parts of the recipes, in case they are in their folders."""
    for registry in own_parts:
        monkeypatch.setattr(registry, "_things", {name: thing for name, thing in registry.items() if name not in NAMES})


def plugin(name: str, folder: Path) -> list[str]:
    (folder / f"{name}.py").write_text(RECIPES[name])
    return ["--plugin", str(folder / f"{name}.py")]


def calibrated(tmp_path: Path, *options: str) -> Calibration:
    from torchstickcal.io import write_npz

    write_npz(tmp_path / "session.npz", *golf_session(cameras=3, frames=20))
    assert main(["calibrate", str(tmp_path / "session.npz"), "--out", str(tmp_path / "out"), *options]) == 0
    return Calibration.load(tmp_path / "out" / "points.npz")


def test_there_are_six():
    assert set(RECIPES) == {"equal_forearms", "aspect", "low_frame_rate", "tracks", "tennis", "stick_and_height"}


def test_finding(tmp_path: Path):
    calibration = calibrated(tmp_path, *plugin("low_frame_rate", tmp_path))
    assert [finding.code for finding in calibration.quality.reasons] == ["low_frame_rate"]


def test_loss(tmp_path: Path):
    config = tmp_path / "mine.toml"
    config.write_text('extends = "default"\n[stages.refined.equal_forearms]\nsigma_m = 0.003\n')
    calibration = calibrated(tmp_path, *plugin("equal_forearms", tmp_path), "--config", str(config))
    assert {record.stage for record in calibration.iterations if "equal_forearms" in record.terms} == {"refined"}


def test_camera_unknown(tmp_path: Path):
    aspect = calibrated(tmp_path, *plugin("aspect", tmp_path), "--refine", "aspect").unknowns["aspect"]
    assert aspect.value.sub(1).abs().max() < 1e-9
    assert aspect.std.min() > 0


def test_format(tmp_path: Path):
    folder = tmp_path / "recording"
    folder.mkdir()
    observations, _ = golf_session(cameras=3, frames=20)
    for camera, keypoints in zip("abc", observations.keypoints, strict=True):
        np.savetxt(folder / f"{camera}.track", keypoints[:, [*range(15), -2, -1]].flatten(1))
    out = tmp_path / "results"
    arguments = ["calibrate", str(folder), "--out", str(out), "--write", "positions", *plugin("tracks", tmp_path)]
    main(arguments)
    calibration = Calibration.load(out / "points.npz")
    assert calibration.camera_names == ("a", "b", "c")
    positions = -(calibration.rotations.mT @ calibration.translations[..., None])[..., 0]
    np.testing.assert_allclose(np.loadtxt(out / "positions.txt"), positions)


def test_sport(tmp_path: Path):
    assert main(["simulate", "tennis", "--out", str(tmp_path), *plugin("tennis", tmp_path)]) == 0
    assert read_simulated(tmp_path / "tennis_0.npz").observations.sticks[0].length_m == 0.69


def test_comparison_method(tmp_path: Path):
    methods = ["--methods", "stick_and_height", *plugin("stick_and_height", tmp_path)]
    assert main(["benchmark", "sports-stick-syn", "--count", "1", "--out", str(tmp_path / "results"), *methods]) == 0
    assert "Stick as long as the athlete is tall" in (tmp_path / "results" / "benchmark.md").read_text()
