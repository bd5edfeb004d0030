"""What the cameras saw: the one place where input is checked and bad input is refused."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchstickcal.arrays import FARTHEST_PX, is_too_far, names_of, number_of, tensor_of, truth_of
from torchstickcal.errors import ObservationError, ObservationWarning
from torchstickcal.geometry.cameras import Intrinsics
from torchstickcal.stick import Stick, check_ends, located_sticks, point_index

LEAST_CONFIDENCE = 1e-4
"""Confidence, as a share of the session's largest, up to which a keypoint counts as not seen. Where nothing else determines a
point, such keypoints would: with errors and gradients that are larger the smaller the confidence is."""
_NO_CONFIDENCE = 1e-12
"""Confidence up to which a keypoint counts as not seen in any case: smaller numbers overflow when they are inverted."""
_LEAST_REPEATED = 6
"""Least number of keypoints of a frame that is called a copy of the frame before: fewer, in whole pixels, may be equal by
chance."""
_COEFFICIENTS = (4, 5, 8, 12, 14)
_FISHEYE_COEFFICIENTS = (4,)
_LARGEST_INTRINSIC = 1e9
"""Beyond any camera; squares of larger numbers may not be numbers at all."""


class Doubt(NamedTuple):
    """Something that is probably not meant as it was given."""

    code: str
    meaning: str
    advice: str
    share: float
    """of the keypoints, or of a camera's frames"""
    camera: str | None = None
    """the only one that it is about"""
    negligible: float = 0.0
    """share up to which nobody is warned"""


@dataclass(frozen=True, eq=False)
class Observations:
    """Keypoints of one session with everything known about the cameras and the sticks.

    Args:
        keypoints: pixels (C, F, P, 2) as detected (distorted), NaN where a point was not seen.
        intrinsics: camera matrices, (C, 3, 3), or one (3, 3) or (1, 3, 3) for all; None if they are to be estimated, for which
            the image size is needed. The principal point is then taken to be the centre of the image.
        sticks: one stick or several; empty if the scale comes from elsewhere.
        distortion: (C, D), or one (D,) for all, OpenCV's order, D of 4, 5, 8, 12 or 14; None for perfect lenses. Rows and
            columns as OpenCV returns them, (1, D), (D, 1), (C, 1, D) and (C, D, 1), are accepted too.
        confidence: (C, F, P) in [0, 1], the weight of a keypoint relative to the noise of its point: the variance of a keypoint
            is the point's, divided by the keypoint's confidence. 0 means not seen, and so does 1/10000 of the session's largest
            confidence or less: such a keypoint would be a hundred times as uncertain as the best.
        image_size: width and height in pixels, (C, 2) or (2,).
        fps: frames per second.
        point_names: P names. camera_names: C names.
        fisheye: whether ``distortion`` (D = 4) is of OpenCV's fisheye model.
        timestamps: (C, F) or (F,), seconds at which each camera's frames begin, for cameras of different frame rates or with
            dropped frames; NaN where a camera has no frame. None for synchronised frames.
        readout_s: time from the first row of an image to the last, of rolling shutters, seconds; None for none. Needs image
            size and frame rate.

    Arrays, lists and tensors are accepted and kept as tensors with the given values. Those in float32 and float64 keep their
    dtype; float16 and bfloat16 become float32, without loss, and integers and longer numbers float64. Masked values of numpy's
    masked arrays count as NaN in ``keypoints`` and ``timestamps``, as 0 in ``confidence``, and are refused elsewhere. Tensors
    that require gradients are detached: :func:`torchstickcal.calibrate` is not differentiable, while
    :class:`torchstickcal.CalibrationLayer` is. The results of a calibration have the dtype and device of ``keypoints`` as kept.

    Raises:
        ObservationError: for anything that cannot be used.

    Warns:
        ObservationWarning: if keypoints lie exactly at (0, 0), by which many detectors mean "not seen", or if more than 5 % of
            a camera's frames are exact copies of the frame before, while other cameras show new frames.

    Example:
        >>> import numpy as np
        >>> rng = np.random.default_rng(0)
        >>> observations = Observations(
        ...     rng.uniform(0, 1000, (3, 50, 4, 2)),  # 3 cameras, 50 frames, 4 points
        ...     [[1000, 0, 960], [0, 1000, 540], [0, 0, 1]],
        ...     Stick("grip", "head", 1.0),
        ...     point_names=["hip", "wrist", "grip", "head"],
        ... )
        >>> observations.num_cameras, observations.num_frames, observations.sticks[0].ends
        (3, 50, (2, 3))
    """

    keypoints: Tensor
    intrinsics: Tensor
    sticks: tuple[Stick, ...]
    distortion: Tensor | None = None
    confidence: Tensor | None = None
    image_size: Tensor | None = None
    fps: float | None = None
    point_names: tuple[str, ...] | None = None
    camera_names: tuple[str, ...] | None = None
    fisheye: bool = False
    intrinsics_known: bool = True
    """False where ``intrinsics`` is a guess from the image size"""
    timestamps: Tensor | None = None
    readout_s: float | None = None
    visible: Tensor = field(init=False, repr=False, compare=False)
    """(C, F, P), True where a keypoint is given with a confidence that counts, and is not one of a repeated frame."""
    repeated: Tensor = field(init=False, repr=False, compare=False)
    """(C, F), True where all keypoints of a camera are exactly those of the frame before, as where its video was converted to a
    higher frame rate, or stopped. Such a frame shows an earlier time. It is not used where another camera shows a new one."""

    def __init__(
        self,
        keypoints: Any,
        intrinsics: Any,
        sticks: Stick | Sequence[Stick],
        distortion: Any = None,
        confidence: Any = None,
        image_size: Any = None,
        fps: float | None = None,
        point_names: Sequence[str] | None = None,
        camera_names: Sequence[str] | None = None,
        fisheye: bool = False,
        intrinsics_known: bool = True,
        timestamps: Any = None,
        readout_s: float | None = None,
    ) -> None:
        put = object.__setattr__
        put(self, "keypoints", tensor_of(keypoints, "keypoints", masked=torch.nan))
        self._check_keypoints()
        device = self.keypoints.device
        put(self, "image_size", None if image_size is None else tensor_of(image_size, "image_size", device=device))
        self._check_image_size()
        put(self, "fisheye", truth_of(fisheye, "fisheye"))
        put(self, "intrinsics_known", truth_of(intrinsics_known, "intrinsics_known") and intrinsics is not None)
        matrix = _guess(self.image_size) if intrinsics is None else tensor_of(intrinsics, "intrinsics", device=device)
        put(self, "intrinsics", matrix[0] if matrix.shape == (1, 3, 3) else matrix)
        if distortion is not None:
            distortion = coefficients_of(tensor_of(distortion, "distortion", device=device), self.fisheye)
        put(self, "distortion", distortion)
        self._check_intrinsics()
        if confidence is not None:
            confidence = tensor_of(confidence, "confidence", device=device, masked=0.0)
        put(self, "confidence", confidence)
        self._check_confidence()
        put(self, "point_names", names_of(point_names, "point_names", self.num_points))
        put(self, "camera_names", names_of(camera_names, "camera_names", self.num_cameras))
        put(self, "fps", None if fps is None else _frame_rate(fps))
        put(self, "timestamps", None if timestamps is None else _times(timestamps, self.keypoints))
        put(self, "readout_s", None if readout_s is None else _readout(readout_s))
        self._check_times()
        visible = self.keypoints.isfinite().all(-1)
        if self.confidence is not None:
            largest = self.confidence.where(visible, 0.0).max()
            visible = visible & (self.confidence > (LEAST_CONFIDENCE * largest).clamp_min(_NO_CONFIDENCE))
        put(self, "repeated", _repeated(self.keypoints, visible))
        fresh = (visible.any(-1) & ~self.repeated).any(0)
        put(self, "visible", visible & ~(self.repeated & fresh)[..., None])
        put(self, "sticks", located_sticks(sticks, self.point_names))
        self._check_sticks()
        if sys._getframe(1).f_globals.get("__name__") != "dataclasses":  # replace() changes what has been warned about
            for sentence in self.warnings:
                warnings.warn(sentence, ObservationWarning, stacklevel=2)

    @property
    def num_cameras(self) -> int:
        """C"""
        return self.keypoints.shape[0]

    @property
    def num_frames(self) -> int:
        """F"""
        return self.keypoints.shape[1]

    @property
    def num_points(self) -> int:
        """P, joints and stick ends together"""
        return self.keypoints.shape[2]

    @property
    def cameras(self) -> Intrinsics:
        """The intrinsics of every camera, in float64."""
        matrix = self.intrinsics.double().expand(self.num_cameras, 3, 3)
        if self.distortion is None or not bool((self.distortion != 0).any()):
            return Intrinsics(matrix, None, False)
        distortion = _without_zeros(self.distortion.double())
        return Intrinsics(matrix, distortion.expand(self.num_cameras, distortion.shape[-1]), self.fisheye)

    def camera_label(self, index: int) -> str:
        """The camera's name, or its number."""
        return self.camera_names[index] if self.camera_names else f"camera {index}"

    @property
    def camera_labels(self) -> tuple[str, ...]:
        """The names of all cameras, or their numbers."""
        return tuple(map(self.camera_label, range(self.num_cameras)))

    def point_label(self, index: int) -> str:
        """The point's name, or its number."""
        return self.point_names[index] if self.point_names else f"point {index}"

    def point_index(self, name: str) -> int:
        """The index of a named point.

        Raises:
            ObservationError: if no point has the name.
        """
        return point_index(name, self.point_names)

    @property
    def at_corner(self) -> Tensor:
        """(C, F, P), True for keypoints at exactly (0, 0), by which many detectors mean that a point was not seen."""
        return (self.keypoints == 0).all(-1) & self.visible

    @property
    def doubts(self) -> tuple[Doubt, ...]:
        """What is probably not meant as it was given."""
        return (*self._at_corner_doubt(), *self._repeated_doubts())

    @property
    def warnings(self) -> tuple[str, ...]:
        """The doubts that a user is warned of, in words."""
        return tuple(f"{doubt.meaning} {doubt.advice}" for doubt in self.doubts if doubt.share > doubt.negligible)

    def _at_corner_doubt(self) -> Iterator[Doubt]:
        if at_corner := int(self.at_corner.sum()):
            total = int(self.visible.sum())
            yield Doubt(
                "keypoints_at_corner",
                f"{at_corner} of {total} keypoints lie exactly at (0, 0), the corner of the image, by which many detectors "
                "mean that a point was not seen. They are used as given.",
                "Set them to NaN if they were not seen.",
                at_corner / total,
            )

    def _repeated_doubts(self) -> Iterator[Doubt]:
        used = (self.repeated & self.visible.any(-1)).any(1)
        for camera in self.repeated.any(1).nonzero().flatten().tolist():
            name, count = self.camera_label(camera), int(self.repeated[camera].sum())
            effect = (
                "They are used where no other camera shows a new frame: all deviations are then too small."
                if bool(used[camera])
                else "They are not used: they show an earlier time than the other cameras do."
            )
            yield Doubt(
                "frames_repeated",
                f"{name}: {count} of {self.num_frames} frames are exact copies of the frame before, as where a video stopped "
                f"or was converted to a higher frame rate. {effect}",
                "Take its keypoints from the video as it was recorded.",
                count / self.num_frames,
                name,
                negligible=1.0 if bool(used[camera]) else 0.05,
            )

    def to(self, device: torch.device | str) -> Observations:
        """The same observations on another device."""
        return replace(self, keypoints=self.keypoints.to(device))

    def of_cameras(self, cameras: Sequence[int]) -> Observations:
        """The same observations of some of the cameras, by their indices.

        Raises:
            ObservationError: if an index is no camera's.
        """
        if wrong := [camera for camera in cameras if camera not in range(self.num_cameras)]:
            expected = f"indices from 0 to {self.num_cameras - 1}"
            raise ObservationError("no such camera", where="cameras", got=wrong[0], expected=expected)
        return self._chosen(list(cameras), [self.camera_label(camera) for camera in cameras])

    def _chosen(self, own: list[int], names: Sequence[str]) -> Observations:
        """The same observations of some of the cameras, which get names."""

        def chosen(given: Tensor | None, of_one: int) -> Tensor | None:
            return given if given is None or given.ndim == of_one else given[own]

        return replace(
            self,
            keypoints=self.keypoints[own],
            intrinsics=chosen(self.intrinsics, 2),
            distortion=chosen(self.distortion, 1),
            confidence=chosen(self.confidence, 2),
            image_size=chosen(self.image_size, 1),
            timestamps=chosen(self.timestamps, 1),
            camera_names=names,
        )

    def with_camera_split(self, camera: int, frame: int) -> Observations:
        """The same observations with a camera that moved as two: one up to a frame, and a further last one from it on.

        A calibration then gives both of its places.

        Args:
            camera: index of the camera.
            frame: the first frame after it moved.

        Raises:
            ObservationError: if there is no such camera, or no frame before or after.
        """
        if not 0 < frame < self.num_frames:
            raise ObservationError(
                "a camera cannot be split there", where="frame", got=frame, expected=f"a frame from 1 to {self.num_frames - 1}"
            )
        names = [*self.camera_labels, f"{self.camera_label(camera)} from frame {frame}"]
        both = self._chosen([*range(self.num_cameras), camera], names)
        keypoints = both.keypoints.clone()
        keypoints[camera, frame:], keypoints[-1, :frame] = torch.nan, torch.nan
        return replace(both, keypoints=keypoints)

    def with_stick_length(self, length_m: float) -> Observations:
        """The same observations with another length for their only stick.

        Raises:
            ObservationError: if there is not exactly one stick, or the length is not one.
        """
        if len(self.sticks) != 1:
            raise ObservationError(
                "one length for several sticks", where="sticks", got=f"{len(self.sticks)} sticks", expected="one stick"
            )
        return replace(self, sticks=(replace(self.sticks[0], length_m=length_m),))

    def _check_keypoints(self) -> None:
        keypoints = self.keypoints
        if keypoints.ndim != 4 or keypoints.shape[-1] != 2 or 0 in keypoints.shape:
            raise ObservationError(
                "keypoints have the wrong shape",
                where="keypoints",
                got=tuple(keypoints.shape),
                expected="(cameras, frames, points, 2)",
            )
        if self.num_cameras < 2:
            raise ObservationError(
                "a rig needs at least two cameras", where="keypoints", got=f"{self.num_cameras} camera", expected="2 or more"
            )
        if (far := is_too_far(keypoints)).any():
            infinite = bool(keypoints.isinf().any())
            what = "keypoints hold infinite values" if infinite else "keypoints lie outside any image"
            _refuse_first(
                what, keypoints.isinf().any(-1) if infinite else far, keypoints, f"at most {FARTHEST_PX:g} pixels, or NaN"
            )
        half = keypoints.isnan().any(-1) & ~keypoints.isnan().all(-1)
        if half.any():
            _refuse_first("a keypoint has only one coordinate", half, keypoints, "both coordinates, or NaN for both")

    def _check_intrinsics(self) -> None:
        matrix, cameras = self.intrinsics, self.num_cameras
        if tuple(matrix.shape) not in {(3, 3), (cameras, 3, 3)}:
            raise ObservationError(
                "intrinsics have the wrong shape",
                where="intrinsics",
                got=tuple(matrix.shape),
                expected=f"(3, 3) or ({cameras}, 3, 3)",
            )
        of_cameras = matrix.reshape(-1, 3, 3)
        positive = (of_cameras.diagonal(dim1=1, dim2=2) >= 1 / _LARGEST_INTRINSIC).all(1)
        usable = positive & (of_cameras.abs() <= _LARGEST_INTRINSIC).all((1, 2)) & (of_cameras[:, 1, 0] == 0)
        usable &= (of_cameras[:, 2] == matrix.new_tensor([0, 0, 1])).all(1)
        if not bool(usable.all()):
            index = usable.tolist().index(False)
            raise ObservationError(
                "a camera matrix is not invertible or not a camera matrix",
                where="intrinsics" if matrix.ndim == 2 else f"intrinsics[{index}]",
                got=of_cameras[index].tolist(),
                expected="[[fx, s, cx], [0, fy, cy], [0, 0, 1]] with fx, fy > 0, in pixels",
            )
        if self.distortion is not None:
            shape = tuple(self.distortion.shape)
            if shape[:-1] not in {(), (cameras,)}:
                expected = f"({cameras}, D) or (D,)"
                raise ObservationError("distortion has the wrong shape", where="distortion", got=shape, expected=expected)
            if not (self.distortion.abs() <= _LARGEST_INTRINSIC).all():
                raise ObservationError(
                    "distortion is not finite",
                    where="distortion",
                    got=self.distortion.tolist(),
                    expected=f"finite numbers, at most {_LARGEST_INTRINSIC:g}",
                )

    def _check_image_size(self) -> None:
        size, cameras = self.image_size, self.num_cameras
        if size is not None and (
            tuple(size.shape) not in {(2,), (cameras, 2)} or not bool(((size > 0) & (size <= FARTHEST_PX)).all())
        ):
            raise ObservationError(
                "image size is not usable",
                where="image_size",
                got=size.tolist(),
                expected=f"(2,) or ({cameras}, 2): width, height in pixels",
            )

    def _check_confidence(self) -> None:
        confidence = self.confidence
        if confidence is None:
            return
        if confidence.shape != self.keypoints.shape[:3]:
            raise ObservationError(
                "confidence has the wrong shape",
                where="confidence",
                got=tuple(confidence.shape),
                expected=f"{tuple(self.keypoints.shape[:3])}, one per keypoint",
            )
        outside = ~((confidence >= 0) & (confidence <= 1)) & ~self.keypoints.isnan().all(-1)
        if outside.any():
            _refuse_first(
                "confidence outside [0, 1]",
                outside,
                confidence,
                "a number from 0 to 1",
                where="confidence",
                remedy="Divide the scores of a heat map by the largest possible score, or clip them to [0, 1]; 0 is not seen.",
            )

    def _check_times(self) -> None:
        if self.timestamps is not None:
            shape = tuple(self.keypoints.shape[:2])
            if tuple(self.timestamps.shape) != shape:
                raise ObservationError(
                    "timestamps have the wrong shape",
                    where="timestamps",
                    got=tuple(self.timestamps.shape),
                    expected=f"{shape} or {shape[1:]}: seconds, for each frame of each camera",
                )
            for index, times in enumerate(self.timestamps):
                known = times[~times.isnan()]
                if len(known) < 2 or not known.isfinite().all() or not bool((known.diff() > 0).all()):
                    raise ObservationError(
                        "timestamps do not increase",
                        where=f"timestamps[{index}]",
                        got=known.tolist()[:5],
                        expected="seconds, each later than the one before; NaN where the camera has no frame",
                    )
            unplaced = self.timestamps.isnan()[..., None] & self.keypoints.isfinite().all(-1)
            if unplaced.any():
                _refuse_first("a keypoint in a frame without a timestamp", unplaced, self.keypoints, "a time, or NaN keypoints")
        if self.readout_s is not None and (self.image_size is None or (self.fps is None and self.timestamps is None)):
            raise ObservationError(
                "a read-out time without what it is counted in",
                where="readout_s",
                got=f"image_size {self.image_size}, fps {self.fps}",
                expected="image_size, and fps or timestamps",
            )
        if self.readout_s is not None and self.fps is not None and self.readout_s * self.fps > 1:
            raise ObservationError(
                "a read-out time longer than a frame",
                where="readout_s",
                got=f"{self.readout_s:g} s",
                expected=f"at most {1 / self.fps:g} s at {self.fps:g} frames per second",
                remedy="Give it in seconds; most cameras need 0.005 to 0.03 s.",
            )

    def _check_sticks(self) -> None:
        check_ends(self.sticks, self.num_points)
        views = self.visible.sum(0)
        if not views.any():
            return
        for number, stick in enumerate(self.sticks):
            where, (start, end) = f"sticks[{number}]", stick.ends
            if not bool(((views[:, start] >= 2) & (views[:, end] >= 2)).any()):
                raise ObservationError(
                    "a stick is never seen by two cameras",
                    where=where,
                    got=f"at most {int(views[:, start].max())} cameras at its start and "
                    f"{int(views[:, end].max())} at its end in one frame",
                    expected="some frame in which each end is seen by two cameras or more",
                    remedy="Check the stick's point indices and the detector's threshold.",
                )


def coefficients_of(distortion: Tensor, fisheye: bool) -> Tensor | None:
    """Lens coefficients (..., D), where rows or columns of OpenCV's were given; None for no coefficients.

    Raises:
        ObservationError: if their number is none of OpenCV's.
    """
    counts = _FISHEYE_COEFFICIENTS if fisheye else _COEFFICIENTS
    given = tuple(distortion.shape)
    if distortion.ndim > 1 and given[-1] == 1:
        distortion = distortion[..., 0]
    if distortion.ndim == 3 and distortion.shape[1] == 1:
        distortion = distortion[:, 0]
    if distortion.ndim == 2 and len(distortion) == 1:
        distortion = distortion[0]
    if distortion.shape[-1:] == (0,):
        return None
    if distortion.shape[-1:] not in {(n,) for n in counts}:
        expected = f"(cameras, D) or (D,), D of {', '.join(map(str, counts))}"
        raise ObservationError("distortion has the wrong shape", where="distortion", got=given, expected=expected)
    return distortion


def _without_zeros(distortion: Tensor) -> Tensor:
    """Distortion (..., D) without the tilt of the sensor and the thin prism, of every lens, where they are zero."""
    for shorter in (12, 8):
        if distortion.shape[-1] > shorter and not bool(distortion[..., shorter:].any()):
            distortion = distortion[..., :shorter]
    return distortion


def _frame_rate(fps: Any) -> float:
    return number_of(
        fps,
        "fps",
        what="frame rate is not usable",
        expected="one number above 0, frames per second",
        least=1e-6,
        most=1e7,
        several="Where cameras have frame rates of their own, give timestamps instead.",
    )


def _readout(readout_s: Any) -> float:
    return number_of(
        readout_s,
        "readout_s",
        what="not a read-out time",
        expected="one number for all cameras, seconds, 0 or more",
        least=0.0,
        most=10.0,
        several="Where they differ, give the timestamps of the middle rows instead, or estimate them (refine 'readout').",
    )


def _repeated(keypoints: Tensor, visible: Tensor) -> Tensor:
    """(C, F), True where all keypoints of a camera are exactly those of the frame before."""
    repeated = torch.zeros_like(visible[..., 0])
    x = keypoints[..., 0]
    alike = (x[:, 1:] == x[:, :-1]).sum(-1) >= _LEAST_REPEATED
    if not bool(alike.any()):
        return repeated
    before, after = visible[:, :-1], visible[:, 1:]
    equal = (keypoints[:, 1:] == keypoints[:, :-1]).all(-1) | ~before
    repeated[:, 1:] = (equal & (before == after)).all(-1) & (after.sum(-1) >= _LEAST_REPEATED)
    return repeated


def _times(timestamps: Any, keypoints: Tensor) -> Tensor:
    """Timestamps (C, F), of those of each camera or of those common to all (F,)."""
    times = tensor_of(timestamps, "timestamps", device=keypoints.device, masked=torch.nan)
    return times.expand(len(keypoints), -1) if times.ndim == 1 else times


def _guess(size: Tensor | None) -> Tensor:
    """Camera matrices (..., 3, 3) of images (..., 2): the centre, and a focal length as long as the wider side.

    Raises:
        ObservationError: if there is no image size.
    """
    if size is None:
        raise ObservationError(
            "neither intrinsics nor image size", where="intrinsics", got="None", expected="camera matrices, or image_size"
        )
    matrix = torch.eye(3, dtype=torch.float64, device=size.device).repeat(*size.shape[:-1], 1, 1)
    matrix[..., :2, 2] = (size - 1) / 2
    matrix[..., [0, 1], [0, 1]] = size.amax(-1, keepdim=True).to(matrix)
    return matrix


def _refuse_first(what: str, bad: Tensor, values: Tensor, expected: str, where: str = "keypoints", remedy: str = "") -> None:
    camera, frame, point = (int(i) for i in bad.nonzero()[0])
    raise ObservationError(
        what,
        where=f"{where}[{camera}, {frame}, {point}]",
        got=f"{values[camera, frame, point].tolist()} ({int(bad.sum())} such in all)",
        expected=expected,
        remedy=remedy,
    )
