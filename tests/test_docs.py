"""Examples in docstrings run, and every public name has one."""

from __future__ import annotations

import doctest
import importlib
from pathlib import Path

import pytest

import torchstickcal

PROTOCOLS_AND_ERRORS = {"Callback", "GradientMode", "ConfigError", "FileFormatError", "ObservationError", "RigError"}
PACKAGE = Path(torchstickcal.__file__).parent


def modules() -> list[str]:
    """Every module of the package that has an example."""
    folders = [PACKAGE, PACKAGE / "losses"]
    files = {file for folder in folders for file in folder.rglob("*.py") if ">>> " in file.read_text("utf-8")}
    return sorted(".".join(("torchstickcal", *file.relative_to(PACKAGE).with_suffix("").parts)) for file in files)


@pytest.mark.parametrize("module", modules())
def test_examples_of_a_module_run(module: str):
    results = doctest.testmod(importlib.import_module(module.removesuffix(".__init__")))
    assert results.attempted
    assert not results.failed


@pytest.mark.parametrize("name", sorted(set(torchstickcal.__all__) - PROTOCOLS_AND_ERRORS))
def test_every_public_name_has_an_example(name: str):
    assert ">>> " in (getattr(torchstickcal, name).__doc__ or "")
