"""Calibrations from wherever they are: a folder of results, a saved calibration, or a calibration file of any format."""

from __future__ import annotations

import zipfile
from pathlib import Path

from torchstickcal.files import CAMERAS_FILE, POINTS_FILE
from torchstickcal.io.formats import is_folder, read_calibration
from torchstickcal.io.rig import Rig
from torchstickcal.result import Calibration
from torchstickcal.untrusted import reading


def read_result(path: str | Path, format: str | None = None) -> Calibration | Rig:
    """Read a calibration: everything, where :meth:`torchstickcal.Calibration.save` wrote it, else its cameras.

    Args:
        path: of a folder that ``torchstickcal calibrate`` wrote, of a saved calibration, or of a calibration of any format.
        format: name of its format, a key of :data:`CALIBRATION_READERS`; None to recognise it by its content.

    Raises:
        FileFormatError: if no format is recognised, or if the file is damaged or cannot be opened.
        ConfigError: for an unknown format.
        FileNotFoundError: if there is no such file.

    Example:
        >>> import tempfile
        >>> from torchstickcal import calibrate
        >>> from torchstickcal.simulate import golf_session
        >>> calibration = calibrate(golf_session(cameras=3, frames=10)[0])
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     calibration.save(f"{folder}/points.npz")
        ...     type(read_result(folder)).__name__
        'Calibration'
    """
    path = Path(path)
    if format is not None:
        return read_calibration(path, format)
    if is_folder(path):
        for file in (POINTS_FILE, CAMERAS_FILE):
            if (path / file).is_file():
                return read_result(path / file)
    return Calibration.load(path) if _is_saved(path) else read_calibration(path)


def _is_saved(path: Path) -> bool:
    """Whether a file looks like a saved calibration."""
    with reading(path, "a calibration"):
        if is_folder(path) or not path.is_file() or not zipfile.is_zipfile(path):
            return False
        with zipfile.ZipFile(path) as archive:
            return {"meta.npy", "covariance.npy"} <= set(archive.namelist())
