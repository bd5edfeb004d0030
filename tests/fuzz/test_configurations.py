"""Configurations are loaded, or refused by name; what is loaded can be run."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from fuzz.configurations import odd, texts, toml, usable
from fuzz.promise import budget, case, check_calibration, check_shares
from fuzz.sessions import Spoiled
from torchstickcal import calibrate, load_config
from torchstickcal.config import Config


@budget(small=60, large=300)
@given(content=texts())
def test_files(content: bytes):
    with case("configurations, files") as ended, tempfile.TemporaryDirectory() as folder:
        Path(folder, "self.toml").write_bytes(content)
        assert isinstance(load_config(Path(folder, "self.toml")), Config)
        ended("loaded")


@budget(small=15, large=300)
@given(table=st.one_of(usable(), usable(), odd()))
def test_tables(table: dict[str, Any]):
    session = Spoiled(cameras=3, frames=8).observations()
    with case("configurations, tables") as ended:
        config = load_config(table)
        ended("loaded")
        calibration = calibrate(session, config)
        ended("converged" if calibration.converged else "not converged")
        check_calibration(calibration)


@budget(small=25, large=300)
@given(table=st.one_of(usable(), usable(), odd()))
def test_a_file_says_what_its_table_says(table: dict[str, Any]):
    text = toml(table)
    with case("configurations, tables in files") as ended, tempfile.TemporaryDirectory() as folder:
        Path(folder, "config.toml").write_text(text, "utf-8")
        assert repr(load_config(Path(folder, "config.toml"))) == repr(load_config(table))
        ended("loaded")


def test_many_are_loaded():
    check_shares("configurations, files", "loaded", at_least=0.05)
    check_shares("configurations, tables", "converged", "not converged", at_least=0.2)
