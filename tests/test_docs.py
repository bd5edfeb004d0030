"""Documents and docstrings are true: examples run, every public name has one, commands parse, links lead somewhere."""

from __future__ import annotations

import ast
import dataclasses
import doctest
import importlib
import importlib.util
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import torchstickcal
from torchstickcal.cli.arguments import parser
from torchstickcal.layer.result import LayerResult
from torchstickcal.result import Calibration, CameraParameter
from torchstickcal.simulate import Noise, golf_session

PROTOCOLS_AND_ERRORS = {"Callback", "GradientMode", "ConfigError", "FileFormatError", "ObservationError", "RigError"}
PACKAGE = Path(torchstickcal.__file__).parent
ROOT = Path(__file__).parents[1]
PAGES = sorted(page for pattern in ("*.md", "docs/**/*.md", "examples/**/*.md") for page in ROOT.glob(pattern))
RUNNABLE = [page for page in PAGES if page.parent in (ROOT / "docs", ROOT) and "```python" in page.read_text("utf-8")]
RUNNABLE.remove(ROOT / "CONTRIBUTING.md")  # its recipes are run by tests/test_contributing.py
GUIDES = [page for page in PAGES if page.parent == ROOT / "docs"]
PRIVATE_WORDS = {
    "late (ms)": "time offset",
    "told": "said, given or known",
    "reckoned": "estimated or computed",
    "resting": "held fixed",
    "nearer": "closer",
    "settled": "converged",
    "data want": "keypoints suggest",
}
"""Words that are not those of the field, and what to write instead (docs/glossary.md)."""
RESULTS: dict[str, type] = {"calibration": Calibration, "result": LayerResult, "focal": CameraParameter}
"""What the variables in the blocks of Python are."""


def modules() -> list[str]:
    """Every module of the package that has an example."""
    folders = [PACKAGE, PACKAGE / "losses"]
    files = {file for folder in folders for file in folder.rglob("*.py") if ">>> " in file.read_text("utf-8")}
    return sorted(".".join(("torchstickcal", *file.relative_to(PACKAGE).with_suffix("").parts)) for file in files)


@pytest.mark.parametrize("module", modules())
def test_examples_of_a_module_run(module: str, own_parts: object):
    results = doctest.testmod(importlib.import_module(module.removesuffix(".__init__")))
    assert results.attempted
    assert not results.failed


@pytest.mark.parametrize("name", sorted(set(torchstickcal.__all__) - PROTOCOLS_AND_ERRORS))
def test_every_public_name_has_an_example(name: str):
    assert ">>> " in (getattr(torchstickcal, name).__doc__ or "")


def of(page: Path) -> str:
    return str(page.relative_to(ROOT))


def python_blocks(page: Path) -> list[str]:
    return re.findall(r"```python\n(.*?)```", page.read_text("utf-8"), flags=re.DOTALL)


def commands(page: Path, program: str) -> list[str]:
    """Command lines of a program in blocks of code, with their continuation lines."""
    found = re.findall(rf"^( {{4,}}){program} (.*(?:\n\1 +.*)*)", page.read_text("utf-8"), flags=re.MULTILINE)
    return [" ".join(command.replace("\\\n", " ").split()) for _, command in found]


def inline_commands(page: Path) -> list[str]:
    """Command lines of torchstickcal within a text, if they are more than the name of a command."""
    found = [" ".join(command.split()) for command in re.findall(r"`torchstickcal\s([^`]+)`", page.read_text("utf-8"))]
    return [command for command in found if " " in command]


@pytest.mark.parametrize("page", PAGES, ids=of)
def test_python_of_a_page_names_what_exists(page: Path):
    for block in python_blocks(page):
        for node in ast.walk(ast.parse(block)):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("torchstickcal"):
                module = importlib.import_module(str(node.module))
                assert [alias.name for alias in node.names if not hasattr(module, alias.name)] == []
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in RESULTS:
                kind = RESULTS[node.value.id]
                assert node.attr in {field.name for field in dataclasses.fields(kind)} | set(dir(kind))


@pytest.mark.parametrize("page", RUNNABLE, ids=of)
def test_python_of_a_page_runs(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """The blocks of a page run in their order, each with fresh inputs and with what the blocks before it have made."""
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    for block in python_blocks(page):
        observations, _ = golf_session(cameras=3, frames=40, noise=Noise(1.0))
        names |= {"observations": observations, "stick": observations.sticks[0], "confidence": None}
        names |= {"keypoints": observations.keypoints.clone().requires_grad_(), "intrinsics": observations.cameras}
        exec(block, names)


@pytest.mark.parametrize("page", PAGES, ids=of)
def test_commands_of_a_page_parse(page: Path):
    for command in [*commands(page, "torchstickcal"), *inline_commands(page)]:
        first_alternatives = re.sub(r"\|[^\s\]]+", "", command)
        with_numbers = re.sub(r"\b[MN]\b", "1", re.sub(r"[\[\]]", "", first_alternatives))
        parser().parse_args(shlex.split(with_numbers, comments=True))


@pytest.mark.parametrize("page", PAGES, ids=of)
def test_commands_of_a_page_have_options_that_exist(page: Path):
    for command in commands(page, r"\S*python"):
        script, *words = command.split()
        if script.startswith("examples/"):
            sources = [ROOT / script, *(ROOT / script).parent.glob("sessions.py")]
            text = "".join(source.read_text("utf-8") for source in sources)
            assert [word for word in words if word.startswith("--") and f'"{word}"' not in text] == []


@pytest.mark.parametrize("page", PAGES, ids=of)
def test_links_of_a_page_lead_somewhere(page: Path):
    text = re.sub(r"```.*?```|`[^`]*`", "", page.read_text("utf-8"), flags=re.DOTALL)
    for link in re.findall(r"\]\((?!https?:)([^)\s]+)\)", text):
        file, _, heading = link.partition("#")
        target = page.parent / file if file else page
        assert target.exists(), link
        assert not heading or heading in headings(target), link


@pytest.mark.parametrize("page", GUIDES, ids=of)
def test_words_of_a_page_are_those_of_the_field(page: Path):
    text = re.sub(r"```.*?```|`[^`]*`", "", page.read_text("utf-8"), flags=re.DOTALL).lower()
    found = {word: instead for word, instead in PRIVATE_WORDS.items() if re.search(rf"\b{re.escape(word)}(?!\w)", text)}
    assert found == {}


def test_each_question_has_an_answer_with_a_link():
    text = (ROOT / "docs" / "questions.md").read_text("utf-8")
    questions = re.findall(r"^(\d+)\. (.*(?:\n    ?.*)*)", text, flags=re.MULTILINE)
    assert [int(number) for number, _ in questions] == list(range(1, 31))
    assert [number for number, question in questions if "](" not in question] == []


def test_each_finding_has_a_remedy():
    text = (ROOT / "docs" / "good.md").read_text("utf-8")
    trees = [ast.parse(file.read_text("utf-8")) for file in (PACKAGE / "quality").rglob("*.py")]
    calls = [node for tree in trees for node in ast.walk(tree) if isinstance(node, ast.Call) and node.args]
    first = [call.args[0] for call in calls if isinstance(call.func, ast.Name) and call.func.id == "Finding"]
    codes = {code.value for code in first if isinstance(code, ast.Constant)}
    assert [code for code in sorted(codes) if f"`{code}`" not in text] == []


def test_each_page_is_in_the_navigation_of_the_site():
    navigation = (ROOT / "mkdocs.yml").read_text("utf-8").partition("\nnav:\n")[2]
    assert [of(page) for page in ROOT.glob("docs/**/*.md") if str(page.relative_to(ROOT / "docs")) not in navigation] == []


def test_site_builds_without_a_warning(tmp_path: Path):
    if importlib.util.find_spec("mkdocs") is None:
        pytest.skip("mkdocs is not installed: pip install '.[docs]'")
    build = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(tmp_path)]
    run = subprocess.run(
        build, cwd=ROOT, env=os.environ | {"NO_MKDOCS_2_WARNING": "1"}, capture_output=True, text=True, check=False
    )
    assert run.returncode == 0, run.stdout + run.stderr
    for formula in ('class="arithmatex"', "{{ api }}", "--8&lt;--"):
        assert not [page.name for page in tmp_path.glob("*.html") if formula in page.read_text("utf-8")]


def headings(page: Path) -> set[str]:
    """The headings of a page, as links name them."""
    found = re.findall(r"^#+ (.*)$", page.read_text("utf-8"), flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in found}
