"""OpenCap: a pickle for each camera, read without running anything of it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from torchstickcal.io import safe_pickle
from torchstickcal.io.formats import calibration_reader, reading
from torchstickcal.io.recording import in_folder
from torchstickcal.io.rig import Rig, RigCamera

_DESCRIPTION = "cameras of OpenCap: cameraIntrinsicsExtrinsics.pickle, or a folder with one in the folder of each camera"
_FILE = "cameraIntrinsicsExtrinsics.pickle"
_KEY = b"intrinsicMat"
"""A key of the dictionary in each of these files."""


def _files_of(path: Path) -> list[Path]:
    if not path.is_dir():
        return [path]
    folders = [*in_folder(path / "Videos"), *in_folder(path)]
    return [folder / _FILE for folder in folders if (folder / _FILE).is_file()]


@calibration_reader(
    "opencap",
    _DESCRIPTION,
    recognises=lambda path, head: (head.startswith(b"\x80") and _KEY in head) or (path.is_dir() and bool(_files_of(path))),
)
def read_opencap(path: str | Path) -> Rig:
    """Read cameras that are called as the folders in which their files are. Lengths are in millimetres."""
    with reading(path, _DESCRIPTION):
        return Rig.of([_camera(file) for file in _files_of(Path(path))], "mm")


def _camera(path: Path) -> RigCamera:
    content = safe_pickle.load(path)
    height, width = np.asarray(content["imageSize"], dtype=np.float64).reshape(2)
    return RigCamera(
        name=path.absolute().parent.name or path.stem,
        matrix=content["intrinsicMat"],
        distortion=content["distortion"],
        image_size=(width, height),
        rotation=content.get("rotation"),
        translation=content.get("translation"),
    )
