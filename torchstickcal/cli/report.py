"""The command `report`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchstickcal.cli.outputs import EXIT_DONE
from torchstickcal.files import PAGE_FILE, POINTS_FILE, REPORT_FILE, RERUN_FILE

if TYPE_CHECKING:
    from torchstickcal.result import Calibration


def report(options: argparse.Namespace) -> int:
    """Write the page of saved results."""
    from torchstickcal.files import try_writing
    from torchstickcal.outputs import write_page
    from torchstickcal.result import Calibration
    from torchstickcal.show.rerun import rerun_package, write_rerun

    folder: Path = options.folder
    if options.rrd:
        rerun_package()
    calibration = Calibration.load(folder / POINTS_FILE)
    try_writing(folder, [PAGE_FILE, *([RERUN_FILE] if options.rrd else [])], where="report")
    write_page(folder / PAGE_FILE, calibration, _made_of(folder / REPORT_FILE, calibration))
    print(f"{folder / PAGE_FILE}: open it in a browser")
    if options.rrd:
        write_rerun(folder / RERUN_FILE, calibration)
        print(f"{folder / RERUN_FILE}: open it with the command `rerun`")
    return EXIT_DONE


def _made_of(path: Path, calibration: Calibration) -> dict[str, Any]:
    """What results were made of, as the report beside them says it; nothing if there is none.

    Raises:
        FileFormatError: if it is not such a report.
    """
    from torchstickcal.untrusted import read_json, reading

    if not path.is_file():
        return {}
    with reading(path, "a report that `calibrate` wrote", "not a report"):
        found = calibration.summary().keys()
        return {name: value for name, value in read_json(path).items() if name not in found}
