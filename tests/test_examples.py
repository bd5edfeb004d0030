"""Every example runs as it stands."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = sorted((Path(__file__).parents[1] / "examples").glob("*.py"))
LONG = {"benchmark_lenses_and_clocks", "from_video_to_swing", "joint_training", "swings_of_a_golfer"}
"""Examples that take 20 s and more."""


def marked(example: Path) -> object:
    return pytest.param(example, id=example.stem, marks=[pytest.mark.slow] if example.stem in LONG else [])


@pytest.mark.parametrize("example", list(map(marked, EXAMPLES)))
def test_example_runs(example: Path, tmp_path: Path):
    alone = os.environ | {"OMP_NUM_THREADS": "1"}
    run = subprocess.run([sys.executable, str(example)], cwd=tmp_path, env=alone, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    assert run.stdout
