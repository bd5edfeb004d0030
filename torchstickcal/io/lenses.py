"""The intrinsics of a calibration for the cameras of a recording: matched by name, and put right for the size of the images."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

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
                    got=f"{outside.mean():.0%} of them, up to x {seen[:, 0].max():.0f} and y {seen[:, 1].max():.0f}",
                    expected=f"an image of {size[0]:g} x {size[1]:g} pixels",
                    remedy="If the images were made smaller or larger after the calibration, give their size (--image-size).",
                )


def lenses_of(rig: Rig, labels: Sequence[str], image_size: Tensor | None) -> tuple[Lenses, tuple[str, ...]]:
    """The lenses of a recording's cameras, and sentences about how they were found.

    Args:
        rig: the cameras of a calibration.
        labels: the names of the recording's cameras.
        image_size: width and height of the recording's images (C, 2), pixels; NaN or None where they are not known.

    Raises:
        CalibrationError: if a camera is missing, lenses of both models are mixed, or images were turned or cut.
    """
    order, notes = _matched(rig.names, labels)
    models = {rig.fisheye[index] for index in order if bool((rig.distortion[index] != 0).any())}
    if len(models) > 1:
        raise CalibrationError(
            "lenses of both models in one rig",
            where="intrinsics",
            got=f"fisheye {[rig.fisheye[index] for index in order]}",
            expected="the fisheye model for all cameras, or for none",
        )
    fisheye = models == {True}
    calibrated = (
        torch.full((len(order), 2), torch.nan, dtype=torch.float64) if rig.image_size is None else rig.image_size[order]
    )
    images = calibrated if image_size is None else torch.where(image_size.isfinite(), image_size, calibrated)
    matrices = rig.intrinsics[order].clone()
    for camera, label in enumerate(labels):
        factor = _factor(label, calibrated[camera], images[camera])
        if factor != 1:
            matrices[camera] = _scaled(matrices[camera], factor)
            notes.append(
                f"The images of {label} are {factor:.4g} times as large as those calibrated; so is its camera matrix now."
            )
    size = images if bool(images.isfinite().all()) else None
    distortion = _padded([rig.distortion[index] for index in order], fisheye)
    return Lenses(matrices, distortion, fisheye, size), tuple(notes)


def _matched(names: Sequence[str], labels: Sequence[str]) -> tuple[list[int], list[str]]:
    """The index among a calibration's cameras of each of a recording's."""
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
        remedy="Turn the images back, or calibrate the lens with images as they are." if turned else "Were they cut?",
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
