"""Configurations: found by name, extended, and refused with the key at fault."""

from __future__ import annotations

import itertools
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
        (
            {"stages": {"metric": {"reprojection": {"sigma_px": "guess"}}}},
            r"sigma_px.*'guess'.*number above 0 and at most 1e9 or 'estimated'",
        ),
        ({"stages": {"metric": {"stick_length": {"sigma_m": -1}}}}, r"sigma_m.*-1"),
        ({"stages": {"metric": {"rescale": 1}}}, r"rescale.*true or false"),
        ({"stages": {"metric": {"stick_length": 3}}}, "a table or false"),
        ({"stages": 3}, "stages.*3"),
        ({"scale": {"start": ["a"], "length_m": 1.0}}, r"missing key.*scale.*expected end"),
        ({"scale": {"start": "a", "end": ["b"], "length_m": 1.0}}, r"scale.start"),
        ({"extends": "defualt"}, r"unknown configuration.*Did you mean 'default'\?"),
        ({"extends": 3}, "extends"),
        ({"stages": {"refind": {}}}, r"unknown stage.*'refind'.*Did you mean 'refined'\?"),
        ({"stages": {1: {}}}, "stages.*whose keys are texts"),
        ({"refine": ["focl"]}, r"refine.0.*'focl'.*Did you mean 'focal'\?"),
        ({"max_offset_s": 10**400}, "max_offset_s.*a number above 0"),
        ({"max_offset_s": 10**5000}, "max_offset_s.*a number above 0"),
        ({"max_offset_s": float("nan")}, "max_offset_s.*nan"),
        ({"precision": "x" * 1000}, r"precision.*x\.\.\.; expected"),
        ({1: 2}, "unknown key.*1"),
    ],
)
def test_bad_configurations_are_refused(keys: dict, message: str):
    with pytest.raises(ConfigError, match=message):
        load_config({"extends": "default"} | keys)


@pytest.mark.parametrize("config", [None, [], 3])
def test_what_is_no_configuration_is_refused(config):
    with pytest.raises(ConfigError, match="not a configuration"):
        load_config(config)


def test_a_file_extends_another_one_beside_it(tmp_path: Path):
    (tmp_path / "base.toml").write_text('extends = "default"\nsolver = "lbfgs"\n')
    (tmp_path / "mine.toml").write_text('extends = "base.toml"\nmax_offset_s = 1.0\n')
    mine = load_config(tmp_path / "mine.toml")
    assert (mine.solver, mine.max_offset_s) == ("lbfgs", 1.0)


@pytest.mark.parametrize("names", [("a", "a"), ("a", "b", "a")])
def test_circles_are_refused(tmp_path: Path, names: tuple[str, ...]):
    for name, base in itertools.pairwise(names):
        (tmp_path / f"{name}.toml").write_text(f'extends = "{base}.toml"\n')
    with pytest.raises(ConfigError, match=r"in a circle.*a\.toml -> .*a\.toml"):
        load_config(tmp_path / "a.toml")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ('extends = "default"'.encode("utf-16"), "position 0 that is not UTF-8"),
        ("# caf\xe9\nextends = 'default'".encode("latin-1"), "position 5 that is not UTF-8"),
        (b"a = " + b"[" * 5000 + b"]" * 5000, "brackets within brackets"),
        (b"max_offset_s = " + b"1" * 5000, "digits"),
    ],
)
def test_files_that_no_editor_should_write_are_refused(tmp_path: Path, content: bytes, message: str):
    file = tmp_path / "odd.toml"
    file.write_bytes(content)
    with pytest.raises(ConfigError, match=f"not TOML.*{message}"):
        load_config(file)


def test_a_byte_order_mark_is_passed_over(tmp_path: Path):
    file = tmp_path / "windows.toml"
    file.write_bytes(b'\xef\xbb\xbfextends = "lbfgs"')
    assert load_config(file).solver == "lbfgs"


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
