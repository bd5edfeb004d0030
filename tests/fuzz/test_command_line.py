"""A command does what it says and ends with 0, 1 or 3, or shows one error, ends with 2 and changes nothing."""

from __future__ import annotations

import contextlib
import io
import os
import tempfile
from pathlib import Path

from hypothesis import given

from fuzz.command_lines import COMMANDS, VALUES, command_lines, lay_out
from fuzz.promise import budget, case, check_shares
from torchstickcal.cli import main
from torchstickcal.cli.arguments import parser


@budget(small=30, large=500)
@given(words=command_lines())
def test_command_lines(words: list[str]):
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        lay_out(Path(folder))
        before = files_of(Path(folder))
        with case("command lines") as ended:
            status, errors = run(words)
            assert status in (0, 1, 2, 3), status
            ended("refused" if status == 2 else "accepted")
            if status == 2:
                said = [line for line in errors.splitlines() if "error: " in line]
                assert said == errors.splitlines()[-1:], errors
                assert files_of(Path(folder)) == before, "a command that was refused has changed files"


def test_not_all_are_refused():
    check_shares("command lines", "accepted", at_least=0.15)


def run(words: list[str]) -> tuple[int, str]:
    """The exit status of a command, and what it wrote as errors."""
    errors = io.StringIO()
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(errors):
        try:
            return main(words), errors.getvalue()
        except SystemExit as stopped:
            return int(stopped.code or 0), errors.getvalue()


def files_of(folder: Path) -> dict[str, bytes | None]:
    """What lies in a folder, apart from what Python keeps of modules."""
    paths = [path for path in folder.rglob("*") if "__pycache__" not in path.parts]
    return {os.fspath(path): path.read_bytes() if path.is_file() else None for path in paths}


def test_every_option_is_tried():
    commands = next(action.choices for action in parser()._actions if isinstance(action.choices, dict))
    options = {name for command in commands.values() for name in command._option_string_actions if name.startswith("--")}
    assert options - {"--help"} <= set(VALUES)
    assert set(commands) - {"demo", "calibrate-many"} == set(COMMANDS)  # each calibrate-many starts processes of its own
