"""The intrinsics of a calibration for the cameras of a recording: matched by name, and put right for the size of the images."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchstickcal.errors import CalibrationError, FileFormatError
from torchstickcal.io.recording import last_number, natural_order
from torchstickcal.io.rig import Rig

_SAME_SIZE = 0.02
"""Share by which the sides of an image may differ from those that were calibrated: codecs cut rows and columns."""
_SAME_SHAPE = 0.01
_MOST_OUTSIDE = 0.2
_BEYOND = 1.1
"""How far from the centre, in half sides of the image, a keypoint lies outside; detectors guess points a little outside."""
_COEFFICIENTS = (4, 5, 8, 12, 14)

TURNS = {"left": "a quarter to the left", "right": "a quarter to the right", "back": "upside down"}
"""How images may have been turned after the calibration, as a viewer sees it."""


@dataclass(frozen=True, eq=False)
class Lenses:
    """The lenses of C cameras; intrinsics and distortion are None where nothing is known of them."""

    intrinsics: Tensor | None
    """(C, 3, 3), pixels"""
    distortion: Tensor | None
    """(C, D), OpenCV's order"""
    fisheye: bool
    image_size: Tensor | None
    """(C, 2), width and height, pixels"""

    def check_inside(self, keypoints: NDArray[np.float64], labels: Sequence[str]) -> None:
        """Raise a CalibrationError if many keypoints (C, F, P, 3) of a camera lie outside its image."""
        if self.image_size is None:
            return
        for camera, size in enumerate(self.image_size.numpy()):
            seen = keypoints[camera][keypoints[camera, ..., 2] > 0][:, :2]
            outside = (np.abs(seen - size / 2) > _BEYOND * size / 2).any(-1)
            if len(seen) and outside.mean() > _MOST_OUTSIDE:
                raise CalibrationError(
                    "keypoints lie outside the image",
                    where=f"camera {labels[camera]}",
                    got=f"{100 * outside.mean():.0f} % of them, up to x {seen[:, 0].max():.0f} and y {seen[:, 1].max():.0f}",
                    expected=f"an image of {size[0]:g} x {size[1]:g} pixels",
                    remedy="If the images were made smaller or larger after the calibration, give their size (--image-size).",
                )


def lenses_of(
    rig: Rig, labels: Sequence[str], image_size: Tensor | None, turned: str | None = None
) -> tuple[Lenses, tuple[str, ...]]:
    """The lenses of a recording's cameras, and sentences about how they were found.

    Args:
        rig: the cameras of a calibration.
        labels: the names of the recording's cameras.
        image_size: width and height of the recording's images (C, 2), pixels; NaN or None where they are not known.
        turned: how images were turned after the calibration, a key of :data:`TURNS`; None for not at all.

    Raises:
        CalibrationError: if a camera is missing, lenses of both models are mixed, or images were cut, or turned in a way that
            is not said.
    """
    cameras, notes = arranged(rig, labels, image_size, turned)
    models = {fisheye for fisheye, lens in zip(cameras.fisheye, cameras.distortion, strict=True) if bool((lens != 0).any())}
    if len(models) > 1:
        raise CalibrationError(
            "lenses of both models in one rig",
            where="intrinsics",
            got=f"fisheye {list(cameras.fisheye)}",
            expected="the fisheye model for all cameras, or for none",
        )
    fisheye = models == {True}
    size = cameras.image_size
    known = size if size is not None and bool(size.isfinite().all()) else None
    return Lenses(cameras.intrinsics, _padded(cameras.distortion, fisheye), fisheye, known), notes


def arranged(
    rig: Rig, labels: Sequence[str] | None, image_size: Tensor | None, turned: str | None = None
) -> tuple[Rig, tuple[str, ...]]:
    """The cameras of a calibration in the order of a recording's, for images of its size, and sentences about it.

    Arguments and errors as of :func:`lenses_of`; without labels the cameras must be as many, and are in the same order.
    """
    order, notes = matched(rig.names, labels)
    names = [rig.names[index] for index in order] if labels is None else list(labels)
    if image_size is not None and len(image_size) != len(order):
        raise CalibrationError(
            "another number of cameras", where="calibration", got=len(order), expected=f"{len(image_size)} cameras"
        )
    unknown = torch.full((len(order), 2), torch.nan, dtype=torch.float64)
    calibrated = unknown if rig.image_size is None else rig.image_size[order].clone()
    matrices, lenses = rig.intrinsics[order].clone(), [rig.distortion[index] for index in order]
    rotations, translations = (None if poses is None else poses[order].clone() for poses in (rig.rotations, rig.translations))
    if turned is not None:
        turn = _turn(turned)
        for camera, label in enumerate(names):
            matrices[camera], lenses[camera], calibrated[camera] = _turned(
                label, matrices[camera], lenses[camera], rig.fisheye[order[camera]], calibrated[camera], turn
            )
            if rotations is not None and translations is not None:
                rotations[camera], translations[camera] = turn @ rotations[camera], turn @ translations[camera]
        notes.append(f"The images were turned {TURNS[turned]} after the calibration; so were its cameras now.")
    images = calibrated if image_size is None else torch.where(image_size.isfinite(), image_size.double().cpu(), calibrated)
    for camera, label in enumerate(names):
        factor = _factor(label, calibrated[camera], images[camera])
        if factor != 1:
            matrices[camera] = _scaled(matrices[camera], factor)
            notes.append(
                f"The images of {label} are {factor:.4g} times as large as those calibrated; so is its camera matrix now."
            )
    return replace(
        rig,
        names=tuple(names),
        intrinsics=matrices,
        distortion=tuple(lenses),
        fisheye=tuple(rig.fisheye[index] for index in order),
        image_size=images,
        rotations=rotations,
        translations=translations,
    ), tuple(notes)


def _turn(turned: str) -> Tensor:
    """The rotation (3, 3) of the camera's frame when its images are turned."""
    if turned not in TURNS:
        raise CalibrationError("no such turn", where="turned", got=repr(turned), expected=f"one of {', '.join(TURNS)}")
    x_axis = {"right": [0.0, -1.0], "left": [0.0, 1.0], "back": [-1.0, 0.0]}[turned]
    y_axis = [-x_axis[1], x_axis[0]]
    return torch.tensor([[*x_axis, 0.0], [*y_axis, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)


def _turned(
    label: str, matrix: Tensor, lens: Tensor, fisheye: bool, size: Tensor, turn: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Camera matrix, lens and size for images that were turned.

    Raises:
        CalibrationError: if the size of the images is not known, or for a lens that cannot be turned.
    """
    if not bool(size.isfinite().all()):
        raise CalibrationError(
            "images cannot be turned without their size",
            where=f"intrinsics of {label}",
            got="a calibration that does not say it",
            expected="a calibration with the size of the images",
        )
    if bool(matrix[0, 1]) or bool(lens[12:].any()):
        got = "skewed pixels" if matrix[0, 1] else "a tilted sensor"
        raise CalibrationError("a camera that cannot be turned", where=f"intrinsics of {label}", got=got, expected="neither")
    axes = turn[:2, :2]
    middle = (size - 1) / 2
    centre = axes @ (matrix[:2, 2] - middle)
    new_size = axes.abs() @ size
    turned = torch.eye(3, dtype=torch.float64)
    turned[[0, 1], [0, 1]] = axes.abs() @ matrix.diagonal()[:2]
    turned[:2, 2] = centre + (new_size - 1) / 2
    lens = lens.clone()
    if not fisheye and len(lens) >= 4:
        lens[[3, 2]] = axes @ lens[[3, 2]]  # p2 and p1 shift along x and y
        if len(lens) >= 12:
            lens[[8, 10]], lens[[9, 11]] = axes @ lens[[8, 10]], axes @ lens[[9, 11]]
    return turned, lens, new_size


def matched(names: Sequence[str], labels: Sequence[str] | None) -> tuple[list[int], list[str]]:
    """The index among a calibration's cameras of each of a recording's, and a sentence if they are not matched by name.

    Raises:
        FileFormatError: if there is no match.
    """
    if labels is None:
        return list(range(len(names))), []
    if set(labels) <= set(names) and len(set(names)) == len(names):
        return [names.index(label) for label in labels], []
    numbers, wanted = list(map(last_number, names)), list(map(last_number, labels))
    unique = None not in numbers and len(set(numbers)) == len(numbers) and len(set(wanted)) == len(wanted)
    if unique and set(wanted) <= set(numbers):
        order = [numbers.index(number) for number in wanted]
        return order, [_pairs("the numbers in their names", names, order, labels)]
    if len(names) == len(labels):
        order = list(range(len(names)))
        if None not in numbers:
            order.sort(key=lambda index: natural_order(names[index]))
        return order, [_pairs("their order", names, order, labels)]
    raise FileFormatError(
        "the cameras of the calibration are others than those of the recording",
        where="intrinsics",
        got=f"{len(names)} cameras: {', '.join(names)}",
        expected=f"{len(labels)} cameras: {', '.join(labels)}",
    )


def _pairs(by: str, names: Sequence[str], order: Sequence[int], labels: Sequence[str]) -> str:
    pairs = ", ".join(f"{label} = {names[index]}" for label, index in zip(labels, order, strict=True))
    return f"Cameras of keypoints and calibration were matched by {by}: {pairs}."


def _factor(label: str, calibrated: Tensor, image: Tensor) -> float:
    """How many times larger the images are than those that were calibrated; 1 if that is not known."""
    if not bool(calibrated.isfinite().all() and image.isfinite().all()):
        return 1.0
    ratio = image / calibrated
    if bool(((ratio - 1).abs() <= _SAME_SIZE).all()):
        return 1.0
    if bool((ratio[0] / ratio[1] - 1).abs() <= _SAME_SHAPE):
        return float(ratio.mean())
    turned = bool(((image.flip(0) / calibrated - 1).abs() <= _SAME_SIZE).all())
    raise FileFormatError(
        "images were turned after the calibration" if turned else "images of another shape than those calibrated",
        where=f"intrinsics of {label}",
        got="{:g} x {:g} pixels".format(*image.tolist()),
        expected="{:g} x {:g} pixels, or a multiple of both".format(*calibrated.tolist()),
        remedy="Turn the images back, or say how they were turned (--turned left or right)." if turned else "Were they cut?",
    )


def _scaled(matrix: Tensor, factor: float) -> Tensor:
    """A camera matrix for an image some times as large; the corner of the image is at (-0.5, -0.5)."""
    scale = matrix.new_tensor([[factor, 0, (factor - 1) / 2], [0, factor, (factor - 1) / 2], [0, 0, 1]])
    return scale @ matrix


def _padded(distortion: Sequence[Tensor], fisheye: bool) -> Tensor | None:
    """Distortion (C, D), with zeros where a camera has fewer coefficients; None for perfect lenses."""
    longest = max(len(coefficients) for coefficients in distortion)
    if longest == 0:
        return None
    count = 4 if fisheye else next((count for count in _COEFFICIENTS if count >= longest), longest)
    return torch.stack([torch.nn.functional.pad(coefficients, (0, count - len(coefficients))) for coefficients in distortion])
