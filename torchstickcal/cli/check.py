"""The command `check`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from torchstickcal.cli.calibrate import given_of
from torchstickcal.cli.console import note
from torchstickcal.cli.evaluate import poses_of
from torchstickcal.cli.outputs import exit_status, show_quality, try_json, write_json
from torchstickcal.files import POINTS_FILE

if TYPE_CHECKING:
    from torchstickcal.quality.check import OldRig


def check_session(options: argparse.Namespace) -> int:
    """Cameras are matched by name if both sides have the same names, each once, else by their order."""
    from torchstickcal.io import load_session
    from torchstickcal.quality.check import check

    try_json(options.json)
    names, old = _old_rig(options.calibration, options.units)
    session = load_session(options.session, options.format, given_of(options))
    for sentence in session.notes:
        note(sentence)
    observations = session.observations
    labels = observations.camera_labels
    if names != labels and set(names) == set(labels):
        observations = observations.of_cameras([labels.index(name) for name in names])
    quality = check(old, observations)
    show_quality(quality, notes=True)
    write_json(options.json, quality.as_json())
    return exit_status(quality, options.strict)


def _old_rig(path: Path, units: str | None) -> tuple[tuple[str, ...], OldRig]:
    """Names and poses of an old calibration, with their covariance where a file of `calibrate` has it."""
    from torchstickcal.quality.check import OldRig
    from torchstickcal.result import Calibration

    saved = path / POINTS_FILE if path.is_dir() else path
    if saved.suffix == ".npz" and saved.is_file():
        calibration = Calibration.load(saved)
        return calibration.camera_names, OldRig(calibration.rotations, calibration.translations, calibration.covariance)
    names, poses = poses_of(path, None, units)
    return names, OldRig(poses.rotations, poses.translations)
