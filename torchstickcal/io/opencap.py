"""OpenCap: a pickle for each camera, read without running anything of it."""

from __future__ import annotations

import pickle
from pathlib import Path

import cv2
import numpy as np

from torchstickcal.files import atomic_set
from torchstickcal.io import safe_pickle
from torchstickcal.io.about import about
from torchstickcal.io.formats import calibration_reader, camera_writer, reading
from torchstickcal.io.recording import in_folder
from torchstickcal.io.rig import METRES, Rig, RigCamera
from torchstickcal.io.writers import file_names

_DESCRIPTION = "cameras of OpenCap: cameraIntrinsicsExtrinsics.pickle, or a folder with one in the folder of each camera"
_FILE = "cameraIntrinsicsExtrinsics.pickle"
_KEY = b"intrinsicMat"
"""A key of the dictionary in each of these files."""
_PROTOCOL = 2
_MODULE_OF_ARRAYS = b"cnumpy._core.", b"cnumpy.core."
"""How version 2 of NumPy calls the module of its arrays in a pickle, and the name that older versions know."""


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


@camera_writer("opencap", "cameras of OpenCap, in millimetres", file_name="opencap", files=(_FILE,))
def write_opencap(path: Path, rig: Rig) -> None:
    """Write a pickle for each camera into the folder ``Videos/NAME``."""
    rig.check_plain("OpenCap", fisheye=False)
    rotations, translations = rig.in_metres().poses()
    said = " ".join(f"{key}: {text}" for key, text in about("millimetres", rig.world, "x_camera = R x_world + t.").items())
    with atomic_set(path) as folder:
        for camera, name in enumerate(file_names(rig.names)):
            width, height = rig.size(camera)
            content = {
                "intrinsicMat": rig.intrinsics[camera].numpy(),
                "distortion": np.array([rig.coefficients(camera, 5, 5, "OpenCap")]),
                "imageSize": np.array([[height], [width]]),
                "rotation": rotations[camera].numpy(),
                "translation": translations[camera][:, None].numpy() / METRES["mm"],
                "rotation_EulerAngles": cv2.Rodrigues(rotations[camera].numpy())[0],
                "about": said,
            }
            file = folder / "Videos" / name / _FILE
            file.parent.mkdir(parents=True)
            file.write_bytes(pickle.dumps(content, _PROTOCOL).replace(*_MODULE_OF_ARRAYS))


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
