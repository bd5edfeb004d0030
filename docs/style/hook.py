"""What the site needs beside mkdocs: formulas without a script, the public names, and links to files outside of it."""

from __future__ import annotations

import ast
import html
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from latex2mathml.converter import convert

PACKAGE = Path(__file__).parents[2] / "torchstickcal"
_FORMULAS = {
    r'<span class="arithmatex">\\\((.*?)\\\)</span>': "inline",
    r'<div class="arithmatex">\\\[(.*?)\\\]</div>': "block",
}


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Put in the public names; links to files outside of the folder `docs` become their names."""
    markdown = markdown.replace("{{ api }}", "\n\n".join(api()))
    return re.sub(r"\[([^\]]*)\]\((?:\.\./)+((?:examples|README|CONTRIBUTING|CHANGELOG)[^)]*)\)", r"\1 (`\2`)", markdown)


def on_page_content(content: str, **_: Any) -> str:
    """Formulas become MathML, which browsers draw by themselves."""
    content = re.sub(
        r'<span class="arithmatex">\\\((.*?)\\\)</span>', lambda m: _mathml(m[1], "inline"), content, flags=re.DOTALL
    )
    return re.sub(r'<div class="arithmatex">\\\[(.*?)\\\]</div>', lambda m: _mathml(m[1], "block"), content, flags=re.DOTALL)


def api() -> Iterator[str]:
    """Headings and references of every public name, package by package."""
    package = _parsed("")
    subpackages = next(_assigned(package, "_SUBPACKAGES"))
    for module in ("", *sorted(subpackages)):
        tree = _parsed(module)
        dotted = f"torchstickcal.{module}".removesuffix(".")
        first_line = (ast.get_docstring(tree) or "").partition("\n\n")[0].replace("\n", " ")
        yield f"## {dotted}\n\n{first_line}"
        for name in next(_assigned(tree, "__all__"), None) or _definitions(tree):
            yield f"::: {dotted}.{name}"


def _parsed(module: str) -> ast.Module:
    folder = PACKAGE / module
    file = folder / "__init__.py" if folder.is_dir() else folder.with_suffix(".py")
    return ast.parse(file.read_text("utf-8"))


def _assigned(tree: ast.Module, name: str) -> Iterator[Any]:
    """The value of a name that a module assigns."""
    for node in tree.body:
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name) and node.targets[0].id == name:
            yield ast.literal_eval(node.value)


def _definitions(tree: ast.Module) -> list[str]:
    """Public classes and functions of a module without ``__all__``."""
    names = [node.name for node in tree.body if isinstance(node, ast.ClassDef | ast.FunctionDef)]
    return [name for name in names if not name.startswith("_")]


def _mathml(formula: str, display: str) -> str:
    return convert(html.unescape(formula.strip()), display=display)
