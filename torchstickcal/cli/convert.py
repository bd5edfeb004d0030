"""The command `convert`."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from torchstickcal.cli.outputs import EXIT_DONE

if TYPE_CHECKING:
    from torchstickcal.io import Motion, Rig
    from torchstickcal.result import Calibration


def convert(options: argparse.Namespace) -> int:
    from torchstickcal.files import atomic_set, try_writing
    from torchstickcal.io.results import read_result
    from torchstickcal.io.writers import writer_of

    name, writer = writer_of(options.target.name, options.to, "TARGET")
    folder = options.target.parent
    try_writing(folder, [] if writer.files else [name], "TARGET")
    content = _in_metres(read_result(options.source, getattr(options, "from")), options.units)
    with atomic_set(folder) as temporary:
        writer.write(temporary / name, content)
    print(f"{options.target}: {writer.description}")
    return EXIT_DONE


def _in_metres(content: Calibration | Rig, unit: str | None) -> Calibration | Rig | Motion:
    """The content in metres.

    Raises:
        CalibrationError: if its unit of length is not known.
    """
    from torchstickcal.io import Rig

    return content.in_metres(unit if content.unit is None else None) if isinstance(content, Rig) else content
