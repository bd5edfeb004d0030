"""What the cameras saw: the one place where input is checked and bad input is refused."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchstickcal.errors import ObservationError
from torchstickcal.geometry.cameras import Intrinsics
from torchstickcal.registry import suggestion

_LONGEST_STICK_M = 10.0
_SHORTEST_IN_MM = 300.0


@dataclass(frozen=True)
class Stick:
    """A rigid stick: two tracked points and the known distance between them.

    Args:
        start: one end, as the index of a point or as its name.
        end: the other end.
        length_m: length in metres.
        sigma_m: standard deviation of the length, metres: how well it was measured and how rigid the stick is. A limb that
            stands in for a stick is known to a few centimetres at best.

    Raises:
        ObservationError: if the ends are the same, or the length or its deviation are no lengths in metres.

    Example:
        >>> Stick(19, 20, 1.0)
        Stick(start=19, end=20, length_m=1.0, sigma_m=0.001)
        >>> Stick("right_knee", "right_ankle", 0.42, sigma_m=0.02)
        Stick(start='right_knee', end='right_ankle', length_m=0.42, sigma_m=0.02)
    """

    start: int | str
    end: int | str
    length_m: float
    sigma_m: float = 0.001

    def __post_init__(self) -> None:
        if self.start == self.end:
            raise ObservationError(
                "a stick needs two different ends", where="Stick", got=f"start = end = {self.start!r}", expected="two points"
            )
        for name, value in (("length_m", self.length_m), ("sigma_m", self.sigma_m)):
            if not (np.isfinite(value) and value > 0):
                raise ObservationError("not a length", where=f"Stick.{name}", got=value, expected="metres, above 0")
        if self.length_m > _LONGEST_STICK_M:
            unit, factor = ("millimetres", 1000) if self.length_m >= _SHORTEST_IN_MM else ("centimetres", 100)
            raise ObservationError(
                f"stick length looks like {unit}",
                where="Stick.length_m",
                got=self.length_m,
                expected=f"metres, at most {_LONGEST_STICK_M:g}",
                remedy=f"Divide by {factor}: {self.length_m / factor:g} m.",
            )

    @property
    def ends(self) -> tuple[int, int]:
        """Both ends as indices of points.

        Raises:
            ObservationError: if an end is a name; :class:`Observations` turns names into indices.
        """
        if isinstance(self.start, str) or isinstance(self.end, str):
            raise ObservationError(
                "a stick's end is a name", where="Stick.ends", got=f"{self.start!r}, {self.end!r}", expected="indices of points"
            )
        return self.start, self.end

    def located(self, point_names: Sequence[str] | None) -> Stick:
        """The stick with its ends as indices of points.

        Raises:
            ObservationError: if an end is a name that no point has.
        """
        start, end = (point_index(end, point_names) if isinstance(end, str) else end for end in (self.start, self.end))
        return replace(self, start=start, end=end)


def point_index(name: str, point_names: Sequence[str] | None) -> int:
    """The index of a named point.

    Raises:
        ObservationError: if no point has the name.
    """
    if point_names is None or name not in point_names:
        known = f"one of {', '.join(point_names)}" if point_names else "an index, since the points have no names"
        remedy = suggestion(name, point_names) if point_names else "Give point_names."
        raise ObservationError("no such point", where="point_names", got=repr(name), expected=known, remedy=remedy)
    return list(point_names).index(name)


@dataclass(frozen=True, eq=False)
class Observations:
    """Keypoints of one session with everything known about the cameras and the sticks.

    Args:
        keypoints: pixels (C, F, P, 2) as detected (distorted), NaN where a point was not seen.
        intrinsics: camera matrices, (C, 3, 3) or one (3, 3) for all; None if they are to be estimated, for which the image size
            is needed. The principal point is then taken to be the centre of the image.
        sticks: one stick or several; empty if the scale comes from elsewhere.
        distortion: (C, D) or (D,), OpenCV's order, D of 4, 5, 8, 12 or 14; None for perfect lenses.
        confidence: (C, F, P) in [0, 1], the weight of a keypoint: its variance is divided by it. 0 means not seen.
        image_size: width and height in pixels, (C, 2) or (2,).
        fps: frames per second.
        point_names: P names. camera_names: C names.
        fisheye: whether ``distortion`` (D = 4) is of OpenCV's fisheye model.
        timestamps: (C, F) or (F,), seconds at which each camera's frames begin, for cameras of different frame rates or with
            dropped frames; NaN where a camera has no frame. None for synchronised frames.
        readout_s: time from the first row of an image to the last, of rolling shutters, seconds; None for none. Needs image
            size and frame rate.

    Arrays, lists and tensors are accepted and kept as tensors with the given values, shape and dtype. The results of a
    calibration have the dtype and device of ``keypoints``.

    Raises:
        ObservationError: for anything that cannot be used.

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
    """(C, F, P), True where a keypoint is given with a confidence above 0."""

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
        put(self, "keypoints", _tensor(keypoints, "keypoints"))
        device = self.keypoints.device
        put(self, "intrinsics_known", intrinsics_known and intrinsics is not None)
        put(self, "intrinsics", _tensor(_guess(image_size) if intrinsics is None else intrinsics, "intrinsics", device))
        for name, value in (("distortion", distortion), ("confidence", confidence), ("image_size", image_size)):
            put(self, name, None if value is None else _tensor(value, name, device))
        put(self, "fps", None if fps is None else float(fps))
        put(self, "timestamps", None if timestamps is None else _times(timestamps, self.keypoints))
        put(self, "readout_s", None if readout_s is None else float(readout_s))
        put(self, "point_names", None if point_names is None else tuple(map(str, point_names)))
        put(self, "camera_names", None if camera_names is None else tuple(map(str, camera_names)))
        put(self, "fisheye", bool(fisheye))
        put(self, "sticks", _located((sticks,) if isinstance(sticks, Stick) else tuple(sticks), self.point_names))
        self._check_keypoints()
        self._check_intrinsics()
        self._check_confidence()
        self._check_names()
        self._check_times()
        visible = self.keypoints.isfinite().all(-1)
        put(self, "visible", visible if self.confidence is None else visible & (self.confidence > 0))
        self._check_sticks()

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
        distortion = self.distortion.double()
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

    def to(self, device: torch.device | str) -> Observations:
        """The same observations on another device."""
        return replace(self, keypoints=self.keypoints.to(device))

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
        if keypoints.isinf().any():
            _refuse_first("keypoints hold infinite values", keypoints.isinf().any(-1), keypoints, "finite pixels or NaN")
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
        for index, camera in enumerate(matrix.reshape(-1, 3, 3)):
            usable = camera.isfinite().all() and camera[0, 0] > 0 and camera[1, 1] > 0
            if not (usable and camera[1, 0] == 0 and bool((camera[2] == camera.new_tensor([0, 0, 1])).all())):
                raise ObservationError(
                    "a camera matrix is not invertible or not a camera matrix",
                    where="intrinsics" if matrix.ndim == 2 else f"intrinsics[{index}]",
                    got=camera.tolist(),
                    expected="[[fx, s, cx], [0, fy, cy], [0, 0, 1]] with fx, fy > 0, in pixels",
                )
        if self.distortion is not None:
            counts = (4,) if self.fisheye else (4, 5, 8, 12, 14)
            shape = tuple(self.distortion.shape)
            if shape[-1:] not in {(n,) for n in counts} or shape[:-1] not in {(), (cameras,)}:
                raise ObservationError(
                    "distortion has the wrong shape",
                    where="distortion",
                    got=shape,
                    expected=f"({cameras}, D) or (D,), D of {', '.join(map(str, counts))}",
                )
            if not self.distortion.isfinite().all():
                raise ObservationError(
                    "distortion is not finite", where="distortion", got=self.distortion.tolist(), expected="finite numbers"
                )
        if self.image_size is not None and (
            tuple(self.image_size.shape) not in {(2,), (cameras, 2)} or not bool((self.image_size > 0).all())
        ):
            raise ObservationError(
                "image size is not usable",
                where="image_size",
                got=self.image_size.tolist(),
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
            _refuse_first("confidence outside [0, 1]", outside, confidence, "a number from 0 to 1", where="confidence")

    def _check_names(self) -> None:
        for where, names, count in (
            ("point_names", self.point_names, self.num_points),
            ("camera_names", self.camera_names, self.num_cameras),
        ):
            if names is not None and (len(names) != count or len(set(names)) != count):
                raise ObservationError(
                    "names do not fit the keypoints", where=where, got=names, expected=f"{count} different names"
                )

    def _check_times(self) -> None:
        if self.fps is not None and not (np.isfinite(self.fps) and self.fps > 0):
            raise ObservationError("frame rate is not usable", where="fps", got=self.fps, expected="a number above 0")
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
        if self.readout_s is not None:
            if not (np.isfinite(self.readout_s) and self.readout_s >= 0):
                raise ObservationError(
                    "not a read-out time", where="readout_s", got=self.readout_s, expected="seconds, 0 or more"
                )
            if self.image_size is None or (self.fps is None and self.timestamps is None):
                raise ObservationError(
                    "a read-out time without what it is counted in",
                    where="readout_s",
                    got=f"image_size {self.image_size}, fps {self.fps}",
                    expected="image_size, and fps or timestamps",
                )

    def _check_sticks(self) -> None:
        views = self.visible.sum(0)
        for number, stick in enumerate(self.sticks):
            where, (start, end) = f"sticks[{number}]", stick.ends
            if not (0 <= start < self.num_points and 0 <= end < self.num_points):
                raise ObservationError(
                    "a stick's end is not a tracked point",
                    where=where,
                    got=f"start {start}, end {end}",
                    expected=f"indices from 0 to {self.num_points - 1}",
                )
            if any({start, end} == set(other.ends) for other in self.sticks[:number]):
                raise ObservationError(
                    "two sticks have the same ends", where=where, got=f"start {start}, end {end}", expected="a stick once"
                )
            if not bool(((views[:, start] >= 2) & (views[:, end] >= 2)).any()):
                raise ObservationError(
                    "a stick is never seen by two cameras",
                    where=where,
                    got=f"at most {int(views[:, start].max())} cameras at its start and "
                    f"{int(views[:, end].max())} at its end in one frame",
                    expected="some frame in which each end is seen by two cameras or more",
                    remedy="Check the stick's point indices and the detector's threshold.",
                )


def _located(sticks: Sequence[Any], point_names: Sequence[str] | None) -> tuple[Stick, ...]:
    """Sticks with their ends as indices of points."""
    for number, stick in enumerate(sticks):
        if not isinstance(stick, Stick):
            expected = "Stick(start, end, length_m)"
            raise ObservationError("not a stick", where=f"sticks[{number}]", got=repr(stick), expected=expected)
    return tuple(stick.located(point_names) for stick in sticks)


def _tensor(value: Any, name: str, device: torch.device | None = None) -> Tensor:
    try:
        tensor = value if isinstance(value, Tensor) else torch.as_tensor(np.asarray(value))
    except (TypeError, ValueError) as error:
        raise ObservationError("not an array of numbers", where=name, got=type(value).__name__, expected="numbers") from error
    if tensor.is_complex() or tensor.dtype == torch.bool:
        raise ObservationError("not an array of real numbers", where=name, got=tensor.dtype, expected="real numbers")
    return tensor.to(device=device, dtype=tensor.dtype if tensor.is_floating_point() else torch.float64)


def _times(timestamps: Any, keypoints: Tensor) -> Tensor:
    """Timestamps (C, F), of those of each camera or of those common to all (F,)."""
    times = _tensor(timestamps, "timestamps", keypoints.device)
    return times.expand(len(keypoints), -1) if times.ndim == 1 else times


def _guess(image_size: Any) -> Tensor:
    """Camera matrices (..., 3, 3) of images (..., 2): the centre, and a focal length as long as the wider side.

    Raises:
        ObservationError: if there is no image size.
    """
    if image_size is None:
        raise ObservationError(
            "neither intrinsics nor image size", where="intrinsics", got="None", expected="camera matrices, or image_size"
        )
    size = _tensor(image_size, "image_size")
    matrix = torch.eye(3, dtype=torch.float64).repeat(*size.shape[:-1], 1, 1)
    matrix[..., :2, 2] = (size - 1) / 2
    matrix[..., [0, 1], [0, 1]] = size.amax(-1, keepdim=True).to(matrix)
    return matrix


def _refuse_first(what: str, bad: Tensor, values: Tensor, expected: str, where: str = "keypoints") -> None:
    camera, frame, point = (int(i) for i in bad.nonzero()[0])
    raise ObservationError(
        what,
        where=f"{where}[{camera}, {frame}, {point}]",
        got=f"{values[camera, frame, point].tolist()} ({int(bad.sum())} such in all)",
        expected=expected,
    )
