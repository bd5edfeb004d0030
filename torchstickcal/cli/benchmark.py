"""The command `benchmark`."""

from __future__ import annotations

import argparse
import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from torchstickcal.cli.configuration import chosen_config
from torchstickcal.cli.console import note
from torchstickcal.cli.outputs import EXIT_DONE, EXIT_NOT_CONVERGED, try_json, write_json
from torchstickcal.cli.plugins import import_plugins
from torchstickcal.cli.progress import progress
from torchstickcal.errors import CalibrationError

if TYPE_CHECKING:
    from torchstickcal.benchmark import SequenceScore


def benchmark(options: argparse.Namespace) -> int:
    return _score(options) if options.out is None else _measure(options)


def _score(options: argparse.Namespace) -> int:
    """The errors of one configuration."""
    from torchstickcal.benchmark import score_sequence, sources, summarise

    config = chosen_config(options)
    try_json(options.json)
    cases = sources(options.place, options.count)
    width = max(len(case.name) for case in cases)
    scores = []
    print(f"{'session':{width}}  rotation (deg)  translation (mm)  time (ms)  status")
    with progress(options) as bar:
        for number, case in enumerate(cases):
            bar(number, len(cases), f"session {number + 1} of {len(cases)}: {case.name}")
            score = score_sequence(case, config)
            if score is None:
                note(f"{case.name} is left out, because it holds no truth.")
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
    with progress(options) as bar:
        rows = run_benchmark(Path(options.place).name, cases, names, options.out, options.jobs, bar, prepare)
    if not rows:
        raise CalibrationError("no session with truth", where="benchmark", got=options.place, expected="sessions with truth")
    write_results(rows, options.out)
    if failed := sum(row.outcome == FAILED for row in rows):
        print(f"{failed} of {len(rows)} measurements failed; the table of failures says why", file=sys.stderr)
    print(f"{len(rows)} measurements, tables and figures in {options.out}")
    return EXIT_DONE
