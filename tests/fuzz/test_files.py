"""A file is read, or refused; never run, never a crash, never more memory than it is worth."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
from hypothesis import given

from fuzz.damage import CANARY
from fuzz.damaged import KINDS, Damaged, damaged
from fuzz.promise import budget, case, check_shares, read_in_a_child

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="each file is read in a child process")


def test_whole_files_are_accepted(tmp_path: Path):
    for name, kind in KINDS.items():
        path = tmp_path / f"whole{kind.suffix}"
        path.write_bytes(Damaged(name).content())
        assert read_in_a_child(partial(kind.read, path)) == "accepted", name


@pytest.mark.parametrize("kind", KINDS)
def test_damaged_files(kind: str):
    subject = f"files, {kind}"

    @budget(small=12, large=500)
    @given(file=damaged(kind))
    def test(file: Damaged):
        content = file.content()
        with case(subject) as ended, tempfile.TemporaryDirectory() as folder:
            path = Path(folder, f"damaged{KINDS[kind].suffix}")
            path.write_bytes(content)
            ended(read_in_a_child(partial(KINDS[kind].read, path)))
            assert not CANARY.exists(), "a program inside the file was run"

    test()
    check_shares(subject, "refused", at_least=0.4)


PATHS: dict[str, Callable[[Path], object]] = {
    "missing": lambda path: None,
    "folder": Path.mkdir,
    "empty": Path.touch,
    "endless": lambda path: path.symlink_to("/dev/zero"),
    "nothing": lambda path: path.symlink_to(os.devnull),
    "link to itself": lambda path: path.symlink_to(path),
    "pipe": os.mkfifo,
}


@pytest.mark.parametrize("what", PATHS)
def test_paths_that_are_no_files(what: str, tmp_path: Path):
    for name, kind in KINDS.items():
        path = tmp_path / f"{len(name)}{kind.suffix}"
        PATHS[what](path)
        assert read_in_a_child(partial(kind.read, path)) == "refused", name
