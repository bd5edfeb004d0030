"""The command `benchmark`."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchstickcal.cli.configuration import chosen_config
from torchstickcal.cli.console import note
from torchstickcal.cli.outputs import EXIT_DONE, EXIT_NOT_CONVERGED, try_json, write_json
from torchstickcal.cli.plugins import import_plugins
from torchstickcal.cli.progress import Progress, progress
from torchstickcal.errors import CalibrationError

if TYPE_CHECKING:
    from torchstickcal.benchmark import ExternalPoses, SequenceScore, Source


def benchmark(options: argparse.Namespace) -> int:
    return _score(options) if options.out is None else _measure(options)


def _score(options: argparse.Namespace) -> int:
    """The errors of one configuration, and those of poses from elsewhere."""
    from torchstickcal.benchmark import score_external, score_sequence, sources, summarise

    config = chosen_config(options)
    try_json(options.json)
    cases = sources(options.place, options.count)
    externals = _externals(options)
    for external in externals:
        external.check([case.name for case in cases])
    scored: dict[str, Callable[[Source], SequenceScore | None]] = {options.config: partial(score_sequence, config=config)}
    scored |= {external.name: partial(score_external, external=external) for external in externals}
    summaries: dict[str, dict[str, Any]] = {}
    scores: list[SequenceScore] = []
    with progress(options) as bar:
        for number, (name, score) in enumerate(scored.items()):
            if externals:
                print(f"{name}:" if number == 0 else f"\n{name}, computed elsewhere:")
            found = list(_scores(cases, score, bar, number * len(cases), len(scored) * len(cases), quiet=number > 0))
            summaries[name] = summarise(found)
            scores = scores or found
    own, *others = summaries.values()
    more = {"external": dict(zip([external.name for external in externals], others, strict=True))} if externals else {}
    write_json(options.json, own | more)
    return EXIT_DONE if scores and own["converged"] == len(scores) else EXIT_NOT_CONVERGED


def _scores(
    cases: Sequence[Source],
    score: Callable[[Source], SequenceScore | None],
    bar: Progress,
    done: int,
    total: int,
    quiet: bool,
) -> Iterator[SequenceScore]:
    """The scores of some sessions, each shown as soon as it is known, and their mean at the end.

    Args:
        cases: the sessions.
        score: scores one.
        bar: shows how many are done.
        done: those that were done before.
        total: all that are to be done.
        quiet: whether nothing is said of sessions without truth.
    """
    from torchstickcal.benchmark import summarise

    width = max(len(case.name) for case in cases)
    scores: list[SequenceScore] = []
    print(f"{'session':{width}}  rotation (deg)  translation (mm)  time (ms)  status")
    for number, case in enumerate(cases, done):
        bar(number, total, f"session {number + 1} of {total}: {case.name}")
        found = score(case)
        if found is None:
            if not quiet:
                note(f"{case.name} is left out, because it holds no truth.")
            continue
        scores.append(found)
        print(_score_line(found, width), flush=True)
        yield found
    summary = summarise(scores)
    if summary["mean_rotation_deg"] is not None:
        mean = f"{summary['mean_rotation_deg']:14.5f}  {1000 * summary['mean_translation_m']:16.3f}"
        timed = any(found.seconds is not None for found in scores)
        print(f"{'mean':{width}}  {mean}" + (f"  {'':9}  {summary['converged']} of {len(scores)} converged" if timed else ""))


def _score_line(score: SequenceScore, width: int) -> str:
    rotation = "-" if score.rotation_deg is None else f"{score.rotation_deg:.5f}"
    translation = "-" if score.translation_m is None else f"{1000 * score.translation_m:.3f}"
    seconds = "-" if score.seconds is None else f"{1000 * score.seconds:.0f}"
    return f"{score.name:{width}}  {rotation:>14}  {translation:>16}  {seconds:>9}  {score.status}"


def _measure(options: argparse.Namespace) -> int:
    """The errors of all methods: a folder with measurements, tables, figures and pages."""
    from torchstickcal.benchmark import METHODS, run_benchmark, sources, write_results
    from torchstickcal.benchmark.external import external_methods
    from torchstickcal.benchmark.page import FILES
    from torchstickcal.benchmark.run import FAILED
    from torchstickcal.files import try_writing

    if options.config != "default" or options.set:
        raise CalibrationError(
            "one configuration, and all methods",
            where="--config" if options.config != "default" else "--set",
            got="--out too",
            expected="one of the two",
            remedy="With --out, configurations are named by --methods.",
        )
    names = options.methods.split(",") if options.methods else list(METHODS)
    cases = sources(options.place, options.count)
    externals = _externals(options)
    up_to_scale = {external.name: external.check([case.name for case in cases]) for external in externals}
    try_writing(options.out, FILES)
    prepare = partial(_prepare, options.plugin, externals, up_to_scale)
    with external_methods(externals, up_to_scale), progress(options) as bar:
        names += [external.name for external in externals]
        rows = run_benchmark(Path(options.place).name, cases, names, options.out, options.jobs, bar, prepare)
        if not rows:
            raise CalibrationError(
                "no session with truth", where="benchmark", got=options.place, expected="sessions with truth"
            )
        write_results(rows, options.out)
    if failed := sum(row.outcome == FAILED for row in rows):
        print(f"{failed} of {len(rows)} measurements failed; the table of failures says why", file=sys.stderr)
    print(f"{len(rows)} measurements, tables and figures in {options.out}")
    return EXIT_DONE


def _prepare(plugins: Sequence[str], externals: Sequence[ExternalPoses], up_to_scale: dict[str, bool]) -> None:
    """Make known, in a process of its own, what the options name."""
    from torchstickcal.benchmark.external import add_external_methods

    import_plugins(plugins)
    add_external_methods(externals, up_to_scale)


def _externals(options: argparse.Namespace) -> list[ExternalPoses]:
    """Poses from elsewhere.

    Raises:
        CalibrationError: if one is not a name and a folder, or has the name of another method.
    """
    from torchstickcal.benchmark import METHODS, ExternalPoses

    found: list[ExternalPoses] = []
    for text in options.external:
        name, _, folder = text.partition("=")
        if not name or not folder:
            raise CalibrationError(
                "not a name and a folder", where="--external", got=repr(text), expected="NAME=FOLDER, such as colmap=colmap/"
            )
        if name in METHODS or name in {external.name for external in found}:
            raise CalibrationError("two methods of one name", where="--external", got=repr(name), expected="a name of its own")
        found.append(ExternalPoses(name, Path(folder), options.units))
    return found
