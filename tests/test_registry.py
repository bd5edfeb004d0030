"""Registries: what is looked up by several threads at once is complete for all of them."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from torchstickcal.registry import Registry

MODULE = """
import time
from torchstickcal.registry import Registry
import {package}
time.sleep(0.05)
{package}.THINGS.register("{name}", 1)
time.sleep(0.05)
"""


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_all_threads_see_everything_that_is_shipped(threads: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    package = f"things_of_{threads}_threads"
    (tmp_path / package).mkdir()
    init = f'from torchstickcal.registry import Registry\nTHINGS = Registry("thing", "{package}")\n'
    (tmp_path / package / "__init__.py").write_text(init)
    for name in ("first", "second", "third"):
        (tmp_path / package / f"{name}.py").write_text(MODULE.format(package=package, name=name))
    monkeypatch.syspath_prepend(tmp_path)
    things: Registry[int] = __import__(package).THINGS
    with ThreadPoolExecutor(threads) as pool:
        found = list(pool.map(lambda _: sorted(things), range(threads)))
    assert found == [["first", "second", "third"]] * threads
