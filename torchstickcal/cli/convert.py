"""The command `convert`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from torchstickcal.cli.outputs import EXIT_DONE
from torchstickcal.errors import CalibrationError

if TYPE_CHECKING:
    from torchstickcal.io import Motion, Rig, Writer
    from torchstickcal.result import Calibration

_SUFFIXES = {".trc": "trc", ".c3d": "c3d", ".csv": "csv", ".npz": "npz", ".toml": "pose2sim", ".py": "blender"}
"""The format of a file by the end of its name, where its whole name says nothing else."""


def convert(options: argparse.Namespace) -> int:
    from torchstickcal.files import atomic_set, try_writing
    from torchstickcal.io.results import read_result

    name, writer = writer_of(options.target.name, options.to, "TARGET")
    folder = options.target.parent
    try_writing(folder, [] if writer.files else [name], "TARGET")
    content = _in_metres(read_result(options.source, getattr(options, "from")), options.units)
    with atomic_set(folder) as temporary:
        writer.write(temporary / name, content)
    print(f"{options.target}: {writer.description}")
    return EXIT_DONE


def writer_of(file_name: str, format: str | None = None, where: str = "--write") -> tuple[str, Writer]:
    """A file's name and its writer, by the name of the format, else by that of the file.

    Raises:
        CalibrationError: if nothing says which format it is.
    """
    from torchstickcal.io import CALIBRATION_WRITERS

    if format is not None:
        return file_name, CALIBRATION_WRITERS[format]
    for writer in CALIBRATION_WRITERS.values():
        if writer.file_name == file_name:
            return file_name, writer
    suffix = Path(file_name).suffix.lower()
    if suffix in _SUFFIXES:
        return file_name, CALIBRATION_WRITERS[_SUFFIXES[suffix]]
    known = ", ".join(f"{writer.file_name} ({name})" for name, writer in CALIBRATION_WRITERS.items())
    raise CalibrationError(
        "the format of a file to be written is not known",
        where=where,
        got=file_name,
        expected=f"a name that says it, such as {known}",
        remedy="Say it with --to." if where == "TARGET" else "",
    )


def _in_metres(content: Calibration | Rig, unit: str | None) -> Calibration | Rig | Motion:
    """The content in metres.

    Raises:
        CalibrationError: if its unit of length is not known.
    """
    from torchstickcal.io import Rig

    return content.in_metres(unit if content.unit is None else None) if isinstance(content, Rig) else content
