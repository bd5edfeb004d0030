"""The command `analyse`."""

from __future__ import annotations

import argparse
from dataclasses import replace
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchstickcal.cli.outputs import EXIT_DONE, point_writers
from torchstickcal.errors import CalibrationError
from torchstickcal.files import POINTS_FILE

if TYPE_CHECKING:
    from torchstickcal.reconstruction import Reconstruction
    from torchstickcal.result import Calibration

PICTURES = ("curves.png", "repeated.png")


def analyse_session(options: argparse.Namespace) -> int:
    from torchstickcal.result import Calibration

    path = options.calibration / POINTS_FILE if options.calibration.is_dir() else options.calibration
    if not path.is_file():
        raise CalibrationError(
            "no calibration to analyse", where="DIR", got=str(path), expected=f"a folder with {POINTS_FILE}, or such a file",
            remedy="Run `torchstickcal calibrate` first.",
        )  # fmt: skip
    out = path.parent / "analysis" if options.out is None else options.out
    calibration = Calibration.load(path)
    write_analysis(calibration, out, options.sport, options.write, fps=options.fps, up=options.up, stick=options.stick)
    return EXIT_DONE


def write_analysis(
    scene: Calibration | Reconstruction, out: Path, sport: str, formats: str | None = None, **known: Any
) -> None:
    """Analyse a session, write and print the results.

    Args:
        scene: the session.
        out: folder for the results.
        sport: as of :func:`~torchstickcal.analysis.analyse`, as ``known``.
        formats: in which the points are written too, with the phases as events where a format has these.
    """
    from torchstickcal.analysis import analyse
    from torchstickcal.analysis.pictures import curves_picture, repeated_picture
    from torchstickcal.analysis.tables import TABLES, table, write_tables
    from torchstickcal.files import atomic_set, try_writing
    from torchstickcal.io import Motion

    writers = point_writers(formats) if formats else {}
    try_writing(out, [*TABLES, *PICTURES, *writers])
    analysis = analyse(scene, sport, **known)
    several = len(analysis.swings) > 1
    events = [
        (f"{event} {number}" if several else event, figure.value)
        for number, swing in enumerate(analysis.swings, start=1)
        for event, figure in swing.events.items()
        if isfinite(figure.value)
    ]
    motion = Motion.of(scene)
    motion = replace(motion, events=tuple(events), times=analysis.times, rate_hz=known.get("fps") or motion.rate_hz)
    with atomic_set(out) as folder:
        for name, writer in writers.items():
            writer.write(folder / name, motion)
        write_tables(folder, analysis)
        curves_picture(analysis).savefig(folder / PICTURES[0], format="png", dpi=120)
        if analysis.repeated:
            repeated_picture(analysis).savefig(folder / PICTURES[1], format="png", dpi=120)
        names = sorted(file.name for file in folder.iterdir())
    print(table(analysis))
    print(f"\n{', '.join(names)} in {out}")
