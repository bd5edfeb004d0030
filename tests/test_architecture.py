"""The order of the house: nothing imports upward."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
LAYERS = [
    ["errors", "files", "symmetric", "workers"],
    ["se3"],
    ["cameras", "observations", "camera_unknowns"],
    ["losses"],
    ["config", "problem", "extrinsics"],
    ["objective"],
    ["solvers", "noise"],
    ["gradients", "uncertainty", "camera_check", "trajectories"],
    ["initialise", "synchronise", "stages"],
    ["focal_search", "result"],
    ["adjust"],
    ["assemble"],
    ["pipeline", "metrics", "report", "figures"],
    ["layer"],
    ["io"],
    ["simulate", "monitor"],
    ["baselines"],
    ["benchmark"],
    ["cli"],
]
RANK = {name: rank for rank, names in enumerate(LAYERS) for name in names}


def modules() -> list[tuple[str, Path]]:
    found = [("losses", path) for path in (ROOT / "losses").glob("*.py")]
    for path in (ROOT / "torchstickcal").rglob("*.py"):
        parts = path.relative_to(ROOT / "torchstickcal").with_suffix("").parts
        if parts[0] not in {"__init__", "__main__", "losses", "configs"}:
            found.append((parts[0], path))
    return found


@pytest.mark.parametrize(("room", "path"), modules(), ids=lambda value: value.name if isinstance(value, Path) else value)
def test_imports_point_downward(room: str, path: Path):
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        names = [node.module] if isinstance(node, ast.ImportFrom) else [a.name for a in getattr(node, "names", [])]
        if not isinstance(node, ast.Import | ast.ImportFrom):
            continue
        for name in names:
            parts = (name or "").split(".")
            if parts[0] == "torchstickcal" and len(parts) > 1 and parts[1] != room:
                assert RANK[parts[1]] <= RANK[room], f"{path.name} imports {name}"


def test_folders_at_the_top_are_linked_into_the_package():
    for name in ("losses", "configs"):
        assert (ROOT / "torchstickcal" / name).resolve() == ROOT / name


def test_every_public_name_can_be_imported():
    import torchstickcal

    for name in torchstickcal.__all__:
        assert getattr(torchstickcal, name).__doc__
    with pytest.raises(AttributeError, match="no attribute 'calibrat'"):
        _ = torchstickcal.calibrat


def test_public_names_do_not_hide_behind_modules_of_the_same_name():
    """A module that is imported becomes an attribute of its package and would take such a name's place."""
    import torchstickcal

    modules = {path.stem for path in (ROOT / "torchstickcal").iterdir()}
    assert not modules & set(torchstickcal.__all__)
