"""The command `analyse`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from torchstickcal.cli.outputs import EXIT_DONE
from torchstickcal.errors import CalibrationError
from torchstickcal.files import POINTS_FILE

PICTURES = ("curves.png", "repeated.png")


def add_analyse(commands: Any) -> None:
    command = commands.add_parser(
        "analyse",
        help="joint angles, stick kinematics and phases of the swings of a calibrated session",
        description="Joint angles, stick kinematics, phases and repeated swings of a calibrated session, with their "
        "standard deviations.",
    )
    add = command.add_argument
    add("calibration", metavar="DIR", type=Path, help=f"folder that `calibrate` wrote, or its {POINTS_FILE}")
    add("--out", metavar="DIR", type=Path, help="folder for tables and pictures (default: `analysis` in DIR)")
    add("--sport", default="any", help="golf, baseball, hockey, kendo or any: whose rule for the impact is used (default: any)")
    add("--fps", metavar="HZ", type=float, help="frames per second (default: the session's)")
    add(
        "--up",
        metavar=("X", "Y", "Z"),
        nargs=3,
        type=float,
        help="the vertical in the frame of the first camera (default: from the cameras, if they stand level)",
    )
    add("--stick", metavar="N", type=int, default=0, help="which stick, counted from 0 (default: 0)")
    add("--plugin", action="append", default=[], help=argparse.SUPPRESS)
    command.set_defaults(run=analyse_session)


def analyse_session(options: argparse.Namespace) -> int:
    from torchstickcal.analysis import analyse
    from torchstickcal.analysis.pictures import curves_picture, repeated_picture
    from torchstickcal.analysis.tables import TABLES, table, write_tables
    from torchstickcal.files import atomic_set, try_writing
    from torchstickcal.result import Calibration

    path = options.calibration / POINTS_FILE if options.calibration.is_dir() else options.calibration
    if not path.is_file():
        raise CalibrationError(
            "no calibration to analyse", where="DIR", got=str(path), expected=f"a folder with {POINTS_FILE}, or such a file",
            remedy="Run `torchstickcal calibrate` first.",
        )  # fmt: skip
    out = path.parent / "analysis" if options.out is None else options.out
    try_writing(out, [*TABLES, *PICTURES])
    analysis = analyse(Calibration.load(path), options.sport, fps=options.fps, up=options.up, stick=options.stick)
    with atomic_set(out) as folder:
        write_tables(folder, analysis)
        curves_picture(analysis).savefig(folder / PICTURES[0], format="png", dpi=120)
        if analysis.repeated:
            repeated_picture(analysis).savefig(folder / PICTURES[1], format="png", dpi=120)
        names = sorted(file.name for file in folder.iterdir())
    print(table(analysis))
    print(f"\n{', '.join(names)} in {out}")
    return EXIT_DONE
