"""Configurations: found by name, extended, and refused with the key at fault."""

from __future__ import annotations

from pathlib import Path

import pytest

from torchstickcal import ConfigError, config_names, load_config
from torchstickcal.losses import SmoothnessSettings, StickLengthSettings

SHIPPED = ["default", "human_only", "lbfgs", "paper", "stick_only", "without_length", "without_smoothness"]


def test_shipped_configurations_are_found_by_name():
    assert config_names() == SHIPPED
    for name in SHIPPED:
        assert load_config(name).stages


def test_paper_has_the_papers_weights():
    stage = load_config("paper").stages["metric"]
    assert stage.losses["stick_length"] == StickLengthSettings(sigma_m=1.0, weight=0.4)
    assert stage.losses["smoothness"] == SmoothnessSettings(sigma_m=1.0, weight=0.2)
    assert stage.rescale


def test_extending_changes_only_what_is_said(tmp_path: Path):
    file = tmp_path / "mine.toml"
    file.write_text(
        'extends = "default"\n[stages.metric]\nstick_length = { sigma_m = 0.002 }\n[stages.trajectories]\nsmoothness = false\n'
    )
    mine, default = load_config(file), load_config("default")
    assert mine.stages["metric"].losses["stick_length"] == StickLengthSettings(sigma_m=0.002)
    assert mine.stages["metric"].losses["reprojection"] == default.stages["metric"].losses["reprojection"]
    assert "smoothness" not in mine.stages["trajectories"].losses
    assert list(mine.stages) == list(default.stages)
    assert mine.stages["unscaled"] == default.stages["unscaled"]


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"solvr": "lbfgs"}, r"unknown key.*solvr.*Did you mean 'solver'\?"),
        ({"stages": {"metric": {"stick_lenght": {}}}}, r"stages.metric.stick_lenght.*Did you mean 'stick_length'\?"),
        ({"solver": "newton"}, r"unusable value.*solver.*'newton'.*'gauss_newton' or 'lbfgs'"),
        ({"stages": {"metric": {"max_iterations": 1.5}}}, r"max_iterations.*1\.5.*whole number"),
        ({"stages": {"metric": {"reprojection": {"sigma_px": "guess"}}}}, r"sigma_px.*'guess'.*number above 0 or 'estimated'"),
        ({"stages": {"metric": {"stick_length": {"sigma_m": -1}}}}, r"sigma_m.*-1"),
        ({"stages": {"metric": {"rescale": 1}}}, r"rescale.*true or false"),
        ({"stages": {"metric": {"stick_length": 3}}}, "a table or false"),
        ({"stages": 3}, "stages.*3"),
        ({"scale": {"start": ["a"], "length_m": 1.0}}, r"missing key.*scale.*expected end"),
        ({"scale": {"start": "a", "end": ["b"], "length_m": 1.0}}, r"scale.start"),
        ({"extends": "defualt"}, r"unknown configuration.*Did you mean 'default'\?"),
        ({"extends": 3}, "extends"),
    ],
)
def test_bad_configurations_are_refused(keys: dict, message: str):
    with pytest.raises(ConfigError, match=message):
        load_config({"extends": "default"} | keys)


def test_files_that_are_not_toml_or_empty_are_refused(tmp_path: Path):
    file = tmp_path / "broken.toml"
    file.write_text("stages = [")
    with pytest.raises(ConfigError, match="not TOML"):
        load_config(file)
    file.write_text("[stages]")
    with pytest.raises(ConfigError, match="nothing to do"):
        load_config(file)
    file.write_text("")
    with pytest.raises(ConfigError, match=r"missing key.*stages"):
        load_config(file)
    with pytest.raises(ConfigError, match="unknown configuration"):
        load_config(tmp_path / "absent.toml")
