"""Calibrations of Qualisys Track Manager, exported as XML (``.qca.txt``).

A camera looks along -z with y up, and its rotation is the transpose of the one that is written by rows. Lengths are in
millimetres, and lens values in 64ths of a pixel of the sensor, of which the image may be a part.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from torchstickcal.io.formats import calibration_reader, reading
from torchstickcal.io.rig import Rig, RigCamera
from torchstickcal.untrusted import read_xml

_DESCRIPTION = "cameras of Qualisys Track Manager (.qca.txt)"
_SUBPIXELS = 64
_TURN = np.diag([1.0, -1.0, -1.0])
"""From axes with y up and z backwards to those of OpenCV."""


@calibration_reader("qualisys", _DESCRIPTION, recognises=lambda path, head: b"<calibration" in head and b"<camera" in head)
def read_qualisys(path: str | Path) -> Rig:
    """Read the cameras that record video or see markers.

    Raises:
        FileFormatError: if it is no such file, or the view of a camera is turned.
        FileNotFoundError: if there is no such file.
    """
    with reading(path, _DESCRIPTION):
        return Rig.of([_camera(number, camera) for number, camera in enumerate(read_xml(path).iter("camera"), 1)], "mm")


def _camera(number: int, camera: Element) -> RigCamera:
    if float(camera.get("viewrotation", "0")) != 0:
        raise ValueError(f"camera {number} whose view is turned by {camera.get('viewrotation')} degrees, which is not read")
    view, lens, pose = (_attributes(camera, name) for name in ("fov_video", "intrinsic", "transform"))
    left, top = float(view["left"]), float(view["top"])

    def pixels(name: str) -> float:
        return float(lens[name]) / _SUBPIXELS

    rotation = _TURN @ np.array([[float(pose[f"r{row}{column}"]) for column in (1, 2, 3)] for row in (1, 2, 3)])
    position = np.array([float(pose[axis]) for axis in "xyz"])
    return RigCamera(
        name=camera.get("serial") or f"cam{number}",
        matrix=[
            [pixels("focalLengthU"), pixels("skew"), pixels("centerPointU") - left],
            [0, pixels("focalLengthV"), pixels("centerPointV") - top],
            [0, 0, 1],
        ],
        distortion=[
            float(lens[name])
            for name in (
                "radialDistortion1",
                "radialDistortion2",
                "tangentalDistortion1",
                "tangentalDistortion2",
                "radialDistortion3",
            )
        ],
        image_size=[float(view["right"]) - left + 1, float(view["bottom"]) - top + 1],
        rotation=rotation,
        translation=-rotation @ position,
    )


def _attributes(camera: Element, name: str) -> Mapping[str, str]:
    found = camera.find(name)
    if found is None:
        raise KeyError(name)
    return found.attrib
