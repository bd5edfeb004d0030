"""Poses from elsewhere that a calibration starts from: of another program, or of an earlier calibration."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from torch import Tensor

from torchstickcal.errors import CalibrationError
from torchstickcal.geometry import se3
from torchstickcal.observations import Observations
from torchstickcal.result import Calibration

if TYPE_CHECKING:
    from torchstickcal.io.rig import Rig

Poses = tuple[Tensor, Tensor]
"""Rotations (C, 3, 3) and translations (C, 3), world to camera."""

CONTRADICTED_START = (
    "The keypoints contradict the poses that were given as a start, which were not used. Check that they are of the same "
    "cameras, and that none has been moved since."
)
_LEAST_DISTANCE = 1e-9


def cameras_of(calibration: Calibration | Rig, where: str) -> Rig:
    """The cameras of a calibration.

    Args:
        calibration: which.
        where: the argument, for the message.

    Raises:
        CalibrationError: if it is none.
    """
    from torchstickcal.io.rig import Rig

    if isinstance(calibration, Calibration):
        return Rig.of_calibration(calibration)
    if not isinstance(calibration, Rig):
        expected = "a Calibration, or a Rig from torchstickcal.io.read_calibration"
        raise CalibrationError("not a calibration", where=where, got=type(calibration).__name__, expected=expected)
    return calibration


def starting_from(initial: Calibration | Rig, observations: Observations) -> tuple[Observations, Poses]:
    """A session and poses of its cameras to start from, in the frame of the first camera and with distances of about 1.

    Where the session has no intrinsics, it gets those of the start, still as a guess.

    Raises:
        CalibrationError: if there are no poses, or not of every camera.
    """
    from torchstickcal.io.lenses import arranged, lenses_of

    rig = cameras_of(initial, "initial")
    size, device = observations.image_size, observations.keypoints.device
    images = None if size is None else size.double().cpu().expand(observations.num_cameras, 2)
    known = observations.intrinsics_known
    rig, _ = arranged(replace(rig, image_size=None) if known else rig, observations.camera_names, None if known else images)
    if len(rig.names) != observations.num_cameras:
        expected = f"{observations.num_cameras} cameras"
        raise CalibrationError("a start with another number of cameras", where="initial", got=len(rig.names), expected=expected)
    if rig.rotations is None or rig.translations is None:
        raise CalibrationError(
            "a start without poses", where="initial", got="intrinsics alone", expected="poses of all cameras"
        )
    rotations, translations = rig.rotations, rig.translations
    from_first = rotations @ rotations[0].mT
    translations = translations - from_first @ translations[0]
    centres = se3.camera_centres(from_first, translations)
    spread = float(centres.square().sum(-1).mean().sqrt())
    if not spread > _LEAST_DISTANCE:
        raise CalibrationError(
            "a start whose cameras are all in one place",
            where="initial",
            got=f"distances of {spread:g}",
            expected="different places",
        )
    if not known:
        lenses, _ = lenses_of(rig, rig.names, None)
        observations = replace(
            observations,
            intrinsics=lenses.intrinsics,
            distortion=lenses.distortion,
            fisheye=lenses.fisheye,
            intrinsics_known=False,
        )
    return observations, (from_first.to(device), (translations / spread).to(device))
