"""The command `analyse`."""

from __future__ import annotations

import argparse

from torchstickcal.cli.outputs import EXIT_DONE
from torchstickcal.errors import CalibrationError
from torchstickcal.files import POINTS_FILE

PICTURES = ("curves.png", "repeated.png")


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
