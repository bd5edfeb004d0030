"""The order of the house: nothing imports upward, and the folders are what the documents say."""

from __future__ import annotations

import ast
import tomllib
from pathlib import Path

import pytest

import torchstickcal

ROOT = Path(__file__).parents[1]
FLOORS = [
    ["errors", "workers", "processes", "inference", "lazy", "precision", "samples", "dual", "allocator"],
    ["files", "shapes", "arrays", "archives"],
    ["untrusted"],
    ["registry", "skeletons"],
    ["settings"],
    ["geometry"],
    ["losses"],
    ["stick"],
    ["observations", "model.unknowns", "extrinsics"],
    ["config"],
    ["model"],
    ["solvers.base"],
    ["solvers.elimination"],
    ["solvers"],
    ["quality.finding"],
    ["quality.verdict"],
    ["metrics", "bridges"],
    ["world"],
    ["result", "reconstruction"],
    ["io"],
    ["pipeline.inference", "pipeline.noise"],
    ["pipeline.run", "pipeline.height", "pipeline.scale"],
    ["pipeline.stage"],
    ["pipeline.settle"],
    ["pipeline.initialise", "pipeline.synchronise"],
    ["pipeline.relabel"],
    ["pipeline.adjustment", "pipeline.focal_search"],
    ["pipeline.stages"],
    ["pipeline.adjust", "pipeline.folds"],
    ["pipeline.check"],
    ["quality.linear", "quality.resection"],
    ["quality.moved", "quality.acceptance"],
    ["quality.single_points", "quality.ends"],
    ["quality.evidence"],
    ["quality.registry"],
    ["quality"],
    ["pipeline.attach", "pipeline.conclude", "pipeline.selection"],
    ["pipeline"],
    ["layer"],
    ["show"],
    ["outputs"],
    ["analysis", "video", "many"],
    ["simulate"],
    ["benchmark.baselines"],
    ["benchmark"],
    ["cli"],
]
"""Rooms from the ground up; what has no line of its own stands on the floor of the room that it is in."""
FLOOR = {room: floor for floor, rooms in enumerate(FLOORS) for room in rooms}


def floor_of(module: str) -> int:
    """The floor of a module, named without the package."""
    while module not in FLOOR:
        assert module, "a room without a floor: add it to FLOORS"
        module = module.rpartition(".")[0]
    return FLOOR[module]


def modules() -> list[tuple[str, Path]]:
    """Every module of the package, named without the package."""
    found = [(f"losses.{path.stem}", path) for path in (ROOT / "losses").glob("*.py")]
    for path in (ROOT / "torchstickcal").rglob("*.py"):
        parts = path.relative_to(ROOT / "torchstickcal").with_suffix("").parts
        if parts[0] not in {"losses", "configs", "__init__", "__main__"}:
            found.append((".".join(part for part in parts if part != "__init__"), path))
    return found


def is_module(dotted: str) -> bool:
    path = ROOT / "torchstickcal" / dotted.replace(".", "/")
    return path.with_suffix(".py").is_file() or (path / "__init__.py").is_file()


def imported(module: str, source: str) -> set[str]:
    """What a module of the package imports from it: at its top, inside functions, relatively, by a public name, as a text."""
    found: set[str] = set()

    def add(dotted: str) -> None:
        if dotted.split(".")[0] == "torchstickcal":
            found.add(dotted.removeprefix("torchstickcal").removeprefix("."))

    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            for alias in node.names:
                add(alias.name)
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                above = f"torchstickcal.{module}".split(".")[: -node.level]
                base = ".".join([*above, *([base] if base else [])])
            for alias in node.names:
                add(f"{base}.{alias.name}")
        elif isinstance(node, ast.Call) and getattr(node.func, "attr", getattr(node.func, "id", "")) == "import_module":
            for argument in node.args:
                if isinstance(argument, ast.Constant):
                    add(str(argument.value))
    return found


def module_of(name: str) -> str:
    """The module that an imported name comes from: itself, the one that defines it, or the home of a public name."""
    while name and not is_module(name):
        if name in torchstickcal._HOMES:
            return torchstickcal._HOMES[name]
        name = name.rpartition(".")[0]
    return name


@pytest.mark.parametrize(("module", "path"), modules(), ids=lambda value: value if isinstance(value, str) else "")
def test_imports_point_downward(module: str, path: Path):
    for name in imported(module, path.read_text("utf-8")):
        source = module_of(name)
        if source and source != module:
            assert floor_of(source) <= floor_of(module), f"{module} imports {source}, which is above it"


@pytest.mark.parametrize(
    "statement",
    [
        "import torchstickcal.cli",
        "from torchstickcal import cli",
        "from torchstickcal.cli import main",
        "from torchstickcal import calibrate",
        "from .. import cli",
        "from ..cli import main",
        "def later():\n    from torchstickcal import cli",
        "import_module('torchstickcal.cli')",
    ],
)
def test_no_way_of_importing_upward_goes_unnoticed(statement: str):
    names = imported("geometry.se3", statement)
    assert names
    assert all(floor_of(module_of(name)) > floor_of("geometry.se3") for name in names)


def test_folders_at_the_top_are_linked_into_the_package():
    for name in ("losses", "configs"):
        assert (ROOT / "torchstickcal" / name).resolve() == ROOT / name


def test_every_folder_is_installed():
    packages = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["setuptools"]["packages"]
    folders = {path.parent.relative_to(ROOT) for path in (ROOT / "torchstickcal").rglob("__init__.py")}
    names = {".".join(folder.parts) for folder in folders} | {"torchstickcal.losses", "torchstickcal.configs"}
    assert sorted(packages) == sorted(names)


def test_every_public_name_can_be_imported():
    for name in torchstickcal.__all__:
        assert getattr(torchstickcal, name).__doc__
    with pytest.raises(AttributeError, match="no attribute 'calibrat'"):
        _ = torchstickcal.calibrat


def test_public_names_do_not_hide_behind_modules_of_the_same_name():
    """A module that is imported becomes an attribute of its package and would take such a name's place."""
    names = {path.stem for path in (ROOT / "torchstickcal").iterdir()}
    assert not names & set(torchstickcal.__all__)
