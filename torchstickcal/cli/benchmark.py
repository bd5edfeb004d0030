"""The command `benchmark`."""

from __future__ import annotations

import argparse
import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from torchstickcal.cli.outputs import EXIT_DONE, EXIT_NOT_CONVERGED, try_json, write_json
from torchstickcal.cli.plugins import import_plugins
from torchstickcal.errors import CalibrationError

if TYPE_CHECKING:
    from torchstickcal.benchmark import SequenceScore


def benchmark(options: argparse.Namespace) -> int:
    return _score(options) if options.out is None else _measure(options)


def _score(options: argparse.Namespace) -> int:
    """The errors of one configuration."""
    from torchstickcal.benchmark import score_sequence, sources, summarise
    from torchstickcal.config import load_config

    config = load_config(options.config)
    try_json(options.json)
    cases = sources(options.place, options.count)
    width = max(len(case.name) for case in cases)
    scores = []
    print(f"{'session':{width}}  rotation (deg)  translation (mm)  time (ms)  status")
    for case in cases:
        score = score_sequence(case, config)
        if score is None:
            print(f"{case.name} skipped: it holds no truth", file=sys.stderr)
            continue
        scores.append(score)
        print(_score_line(score, width), flush=True)
    summary = summarise(scores)
    if summary["mean_rotation_deg"] is not None:
        mean = f"{summary['mean_rotation_deg']:14.5f}  {1000 * summary['mean_translation_m']:16.3f}"
        print(f"{'mean':{width}}  {mean}  {'':9}  {summary['converged']} of {len(scores)} converged")
    write_json(options.json, summary)
    return EXIT_DONE if scores and summary["converged"] == len(scores) else EXIT_NOT_CONVERGED


def _score_line(score: SequenceScore, width: int) -> str:
    rotation = "-" if score.rotation_deg is None else f"{score.rotation_deg:.5f}"
    translation = "-" if score.translation_m is None else f"{1000 * score.translation_m:.3f}"
    return f"{score.name:{width}}  {rotation:>14}  {translation:>16}  {1000 * score.seconds:9.0f}  {score.status}"


def _measure(options: argparse.Namespace) -> int:
    """The errors of all methods: a folder with measurements, tables, figures and pages."""
    from torchstickcal.benchmark import METHODS, run_benchmark, sources, write_results
    from torchstickcal.benchmark.page import FILES
    from torchstickcal.benchmark.run import FAILED
    from torchstickcal.files import try_writing

    names = options.methods.split(",") if options.methods else list(METHODS)
    cases = sources(options.place, options.count)
    try_writing(options.out, FILES)
    prepare = partial(import_plugins, options.plugin)
    rows = run_benchmark(Path(options.place).name, cases, names, options.out, options.jobs, _progress_bar, prepare)
    if not rows:
        raise CalibrationError("no session with truth", where="benchmark", got=options.place, expected="sessions with truth")
    write_results(rows, options.out)
    if failed := sum(row.outcome == FAILED for row in rows):
        print(f"{failed} of {len(rows)} measurements failed; the table of failures says why", file=sys.stderr)
    print(f"{len(rows)} measurements, tables and figures in {options.out}")
    return EXIT_DONE


def _progress_bar(done: int, total: int, what: str) -> None:
    """A bar in a terminal; elsewhere a line after each tenth of the measurements."""
    if sys.stderr.isatty():
        bar = "#" * (30 * done // total)
        print(f"\r[{bar:<30}] {done}/{total} {what:<60.60}", end="\n" if done == total else "", file=sys.stderr, flush=True)
    elif 10 * done // total > 10 * (done - 1) // total:
        print(f"{done}/{total} measured", file=sys.stderr, flush=True)
