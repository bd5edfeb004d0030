"""The command `evaluate`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from torchstickcal.cli.outputs import EXIT_DONE, errors_by_camera, print_errors, try_json, write_json
from torchstickcal.errors import CalibrationError
from torchstickcal.files import CAMERAS_FILE

if TYPE_CHECKING:
    from torchstickcal.io import Truth


def evaluate(options: argparse.Namespace) -> int:
    """Cameras are matched by name if both sides have the same names, each once, else by their order."""
    from torchstickcal.io import Truth
    from torchstickcal.metrics import pose_errors

    try_json(options.json)
    names, estimate = poses_of(options.calibration, None, options.units)
    truth_names, truth = poses_of(options.truth, options.format, options.units)
    if len(names) != len(truth_names):
        raise CalibrationError(
            "the number of cameras differs",
            where=str(options.truth),
            got=f"{len(truth_names)} cameras",
            expected=f"{len(names)} as in {options.calibration}",
        )
    if set(names) == set(truth_names) and len(set(names)) == len(names):
        order = [truth_names.index(name) for name in names]
        truth = Truth(truth.rotations[order], truth.translations[order])
    errors = pose_errors(estimate.rotations, estimate.translations, truth.rotations, truth.translations)
    result = errors_by_camera(names, errors)
    print_errors(result)
    write_json(options.json, result)
    return EXIT_DONE


def poses_of(path: Path, format: str | None, units: str | None) -> tuple[tuple[str, ...], Truth]:
    """Names and poses of the cameras of a calibration, or of a session that holds its truth.

    Args:
        path: a file, or a folder that holds a camera file.
        format: of the session; None if the content decides.
        units: of length, of a calibration that does not say it.
    """
    from torchstickcal.errors import FileFormatError
    from torchstickcal.io import CALIBRATION_READERS, SESSION_READERS, Rig, Truth, find_reader, reading

    if format is None and (path / CAMERAS_FILE).is_file():
        path = path / CAMERAS_FILE
    reader = SESSION_READERS[format] if format else find_reader(path, CALIBRATION_READERS, SESSION_READERS)
    content = reader.read(path)
    if isinstance(content, Rig):
        with reading(path, "a calibration with poses in a known unit"):
            return content.names, Truth(*content.poses(units if content.unit is None else None))
    observations, truth = content
    if truth is None:
        raise FileFormatError("a session without truth", where=str(path), got="no poses", expected="the poses of its cameras")
    return observations.camera_labels, truth
