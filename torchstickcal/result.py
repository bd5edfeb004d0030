"""The result of a calibration: everything that was estimated, how, and how precisely."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from torchstickcal.archives import save_arrays
from torchstickcal.arrays import FARTHEST_PX, number_of, tensor_of
from torchstickcal.errors import CalibrationError, ObservationError
from torchstickcal.files import atomic_path
from torchstickcal.geometry import se3
from torchstickcal.geometry.cameras import Intrinsics
from torchstickcal.lazy import cached_property
from torchstickcal.quality.verdict import Quality
from torchstickcal.registry import Registry
from torchstickcal.shapes import check_shapes
from torchstickcal.solvers import IterationRecord, StageRecord, Stop
from torchstickcal.solvers.uncertainty import centre_covariances, point_covariances, relative_scale_std
from torchstickcal.stick import Stick
from torchstickcal.untrusted import open_arrays, reading
from torchstickcal.world import WORLDS, Frame, World, athlete_frame, floor_frame

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_FORMAT = "torchstickcal calibration 8"
_TENSORS = {
    "rotations": "C 3 3",
    "translations": "C 3",
    "points": "G P 3",
    "covariance": "K K",
    "residuals_px": "C F P 2",
    "inliers": "C F P",
    "stick_lengths_m": "G S",
    "sigma_px": "P",
    "intrinsics": "C 3 3",
    "frame_index": "C F",
    "keypoint_index": "C F P",
    "other_person": "C F",
}
_OPTIONAL_TENSORS = {"distortion": "C D", "image_size": "C 2", "times": "G"}
"""The axes of the tensors of a calibration, as of :func:`torchstickcal.shapes.check_shapes`."""


@dataclass(frozen=True, eq=False)
class CameraParameter:
    """Something that may be unknown of the cameras beside their poses.

    Values and standard deviations are (C,), or (C, n) where it has n > 1 components, in ``unit``.
    """

    label: str
    """what it is, for people"""
    unit: str
    components: tuple[str, ...]
    """names of the numbers that each camera has"""
    refined: bool
    """whether it was estimated; otherwise the given value was used"""
    value: Tensor
    """as estimated, or as given"""
    std: Tensor
    """standard deviation of the estimate; NaN where the value was given, 0 where it is so by definition, as the time offset of
    the first camera"""
    given: Tensor
    prior_std: Tensor
    """standard deviation around the given value before anything was seen"""
    suggestion: tuple[Tensor, Tensor] | Callable[[], tuple[Tensor, Tensor]] = field(repr=False)
    """what the keypoints suggest, and its standard deviation, or what gives them when they are first asked for"""

    @property
    def suggested(self) -> Tensor:
        """What the keypoints suggest, to first order, if this alone is changed; near ``value`` where it was estimated."""
        return self._suggestion[0]

    @property
    def suggested_std(self) -> Tensor:
        """Standard deviation of what the keypoints suggest."""
        return self._suggestion[1]

    def to(self, dtype: torch.dtype) -> CameraParameter:
        """The same in another floating-point type."""
        tensors = {name: getattr(self, name).to(dtype).contiguous() for name in _PARAMETER_TENSORS}
        return dataclasses.replace(self, **tensors, suggestion=partial(_converted, self, dtype))

    def by_component(self, name: str) -> Tensor:
        """One of the tensors as (C, n), whatever n is."""
        tensor: Tensor = getattr(self, name)
        return tensor.view(len(tensor), -1)

    @cached_property
    def _suggestion(self) -> tuple[Tensor, Tensor]:
        found = self.suggestion() if callable(self.suggestion) else self.suggestion
        object.__setattr__(self, "suggestion", found)  # what it was computed from need not be kept
        return found

    def __getstate__(self) -> dict[str, Any]:
        """What is copied and sent to other processes: the suggestion itself, not what gives it."""
        return self.__dict__ | {"suggestion": self._suggestion}


def _converted(parameter: CameraParameter, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    return parameter.suggested.to(dtype).contiguous(), parameter.suggested_std.to(dtype).contiguous()


_CAMERA_WORLD = World()
_UNKNOWN = "unknown_"
_PARAMETER_TENSORS = ("value", "std", "given", "prior_std")
_SAVED_TENSORS = (*_PARAMETER_TENSORS, "suggested", "suggested_std")


VIEWS: Registry[Callable[..., Any]] = Registry("view of a calibration", "torchstickcal.show.views")
"""Functions that show a calibration, by name; the methods of :class:`Calibration` ask them."""


@dataclass(frozen=True, eq=False, repr=False)
class Calibration:
    """A calibrated rig and the scene it saw, in metres, in the frame of the first camera unless :attr:`world` says another.

    Floating-point tensors have the dtype and device of the keypoints that they were estimated from.

    Example:
        >>> from torchstickcal import calibrate
        >>> from torchstickcal.simulate import Noise, golf_session
        >>> observations, truth = golf_session(cameras=3, frames=30, noise=Noise(1.0))
        >>> calibration = calibrate(observations)
        >>> calibration.converged, calibration.camera_centres.shape, calibration.points.shape
        (True, torch.Size([3, 3]), torch.Size([30, 21, 3]))
        >>> focal = calibration.unknowns["focal"]
        >>> focal.refined, focal.value.tolist() == focal.given.tolist()
        (False, True)
        >>> bool((calibration.camera_std_m[1:] < 0.05).all())
        True
        >>> calibration.summary()["quality"]["verdict"]
        'good'
    """

    rotations: Tensor
    """(C, 3, 3), world to camera"""
    translations: Tensor
    """(C, 3), world to camera, metres"""
    points: Tensor
    """(G, P, 3), metres, at the common frames; NaN where fewer than two cameras saw the point. The common frames are the F
    frames of the session, unless time offsets were estimated or timestamps were given."""
    covariance: Tensor
    """(6 (C - 1), 6 (C - 1)), float64, of the tangents (translation, rotation; metres, radians) of all cameras but the first,
    relative to which the others are uncertain: ``T_true = T Exp(tangent)``. It contains errors of the keypoints that last for
    several frames, and the stated deviations of the sticks' lengths, which are common to all frames."""
    residuals_px: Tensor
    """(C, F, P, 2), projection minus keypoint, pixels, of inliers and outliers; NaN where not seen or the point is not known"""
    inliers: Tensor
    """(C, F, P), True where a keypoint was used to the end: a second camera sees the point too, and they agree"""
    stick_lengths_m: Tensor
    """(G, S), reconstructed lengths; NaN where an end is not known"""
    sigma_px: Tensor
    """(P,), estimated noise of each point's keypoints along an axis, pixels"""
    intrinsics: Tensor
    """(C, 3, 3), camera matrices, as given or as estimated (``refined``)"""
    distortion: Tensor | None
    """(C, D), OpenCV's order, as given or as estimated; None for perfect lenses"""
    refined: tuple[str, ...]
    """what was estimated of the cameras beside their poses: names of :data:`torchstickcal.model.unknowns.REFINEMENTS`"""
    unknowns: Mapping[str, CameraParameter]
    """everything that can be estimated of the cameras beside their poses, by its name: ``focal``, ``principal_point``,
    ``radial``, ``time_offset``, ``readout``"""
    frame_index: Tensor
    """(C, F), the common frame (of G) nearest to each frame of a camera, -1 where the frame was left out"""
    keypoint_index: Tensor
    """(C, F, P), the point whose given keypoint each point uses: its own, except where label errors were undone. Residuals and
    inliers are about the keypoints that points use."""
    other_person: Tensor
    """(C, F), True where all keypoints of a camera's frame were set aside: they fit together, but show another person"""
    times: Tensor | None
    """(G,), float64, seconds on the clock of the first camera at which the middle row of its image was exposed in each common
    frame; None without a frame rate"""
    image_size: Tensor | None
    """(C, 2), width and height, pixels"""
    fisheye: bool
    sticks: tuple[Stick, ...]
    fps: float | None
    point_names: tuple[str, ...] | None
    camera_names: tuple[str, ...]
    stages: tuple[StageRecord, ...]
    seconds: dict[str, float]
    """time of the initialisation, of the search for label errors, of each stage and in total"""
    judgement: Quality | Callable[[], Quality] = field(repr=False)
    """the quality, or what gives it when it is first asked for"""
    left_out: tuple[str, ...] = ()
    """names of the cameras that share too little with the others, where only the largest part was to be calibrated. They are in
    no other part of the result."""
    world: World = _CAMERA_WORLD
    """the frame of cameras and points: where its origin is and how its axes lie"""

    def in_world(self, world: str | Frame) -> Calibration:
        """The same calibration in another frame: poses, points and covariance.

        Args:
            world: ``camera``: the frame of the first camera. ``athlete``: z up, the origin on the floor below the athlete's
                feet in the first frame, x where the athlete faces. ``floor``: z up, the origin on the floor below the first
                camera, x in its viewing direction. Or a frame, from :func:`torchstickcal.world.frame_of_points` or
                :func:`torchstickcal.world.frame_of_cameras`.

        Raises:
            CalibrationError: if there is no such frame, or if it needs the head and the ankles of an athlete and these are not
                known.

        Example:
            >>> from torchstickcal import calibrate
            >>> from torchstickcal.simulate import golf_session
            >>> calibration = calibrate(golf_session(cameras=3, frames=30)[0]).in_world("athlete")
            >>> head = calibration.points[0, calibration.point_names.index("head_top")]
            >>> calibration.world.name, bool(1.4 < head[2] < 1.8), bool((calibration.camera_centres[:, 2] > 0).all())
            ('athlete', True, True)
        """
        frame = self._frame(world) if isinstance(world, str) else world
        rotations, translations = frame.poses(self.rotations.double().cpu(), self.translations.double().cpu())
        return dataclasses.replace(
            self,
            rotations=rotations.to(self.rotations),
            translations=translations.to(self.translations),
            points=frame.points(self.points.double().cpu()).to(self.points),
            covariance=frame.covariance(self.covariance.cpu()).to(self.covariance),
            world=frame.world,
        )

    def _frame(self, world: str) -> Frame:
        """A frame of :data:`torchstickcal.world.WORLDS`, relative to the present one."""
        if world == "camera":
            return Frame(self.rotations[0].double().cpu(), self.translations[0].double().cpu(), World())
        if world == "athlete":
            return athlete_frame(self.points, self.point_names, self.rotations)
        if world == "floor":
            return floor_frame(self.points, self.point_names, self.rotations, self.translations)
        raise CalibrationError(
            "unknown frame of the world", where="world", got=repr(world), expected=f"one of {', '.join(WORLDS)}, or a Frame"
        )

    @property
    def converged(self) -> bool:
        """Whether every stage converged."""
        return all(stage.stop.converged for stage in self.stages)

    @property
    def status(self) -> str:
        """``converged``, or which stage did not and why."""
        failed = [f"{stage.name}: {stage.stop}" for stage in self.stages if not stage.stop.converged]
        return "; ".join(failed) or "converged"

    @cached_property
    def quality(self) -> Quality:
        """Whether the result can be used, and why: a verdict with findings, and errors in millimetres.

        It is judged when it is first asked for, in a fraction of the time of the calibration; where something is wrong, causes
        are tried, which takes longer.
        """
        quality = self.judgement if isinstance(self.judgement, Quality) else self.judgement()
        object.__setattr__(self, "judgement", quality)  # what it was judged by need not be kept
        return quality

    @property
    def warnings(self) -> tuple[str, ...]:
        """What a careful user should know: the texts of the findings."""
        return tuple(finding.text for finding in self.quality.findings)

    def __getstate__(self) -> dict[str, Any]:
        """What is copied and sent to other processes: the quality itself, not what it is judged by."""
        return self.__dict__ | {"judgement": self.quality}

    @property
    def relabelled(self) -> Tensor:
        """(C, F, P), True where a point uses the keypoint that was given for another: a label error that was undone."""
        return self.keypoint_index != torch.arange(self.keypoint_index.shape[2], device=self.keypoint_index.device)

    @property
    def iterations(self) -> tuple[IterationRecord, ...]:
        """The records of all iterations of all stages."""
        return tuple(record for stage in self.stages for record in stage.iterations)

    @property
    def time_offsets(self) -> Tensor:
        """(C,), time by which each camera's frames begin after those of the first camera, seconds; zero where not estimated."""
        return self.unknowns["time_offset"].value

    @property
    def camera_centres(self) -> Tensor:
        """(C, 3), metres."""
        return se3.camera_centres(self.rotations, self.translations) + 0.0

    @property
    def camera_std_deg(self) -> Tensor:
        """(C,), standard deviation of each camera's rotation angle relative to the first camera, degrees."""
        variances = self.covariance.diagonal().unflatten(0, (-1, 6))[:, 3:].sum(1)
        return torch.nn.functional.pad(variances.sqrt().rad2deg(), (1, 0)).to(self.rotations.dtype)

    @cached_property
    def camera_std_m(self) -> Tensor:
        """(C,), standard deviation of each camera's centre from its true position relative to the first camera, metres."""
        covariances = centre_covariances(self.camera_centres.double(), self.covariance)
        return covariances.diagonal(dim1=1, dim2=2).sum(1).sqrt().to(self.rotations.dtype)

    @cached_property
    def scale_std(self) -> Tensor:
        """(), standard deviation of the rig's scale, as a fraction of it."""
        return relative_scale_std(self.camera_centres.double(), self.covariance).to(self.rotations.dtype)

    @property
    def points_std_m(self) -> Tensor:
        """(G, P), standard deviation of each point from its true position, metres, without what sticks and smoothness add."""
        frames, points = self.points.shape[:2]
        sigma_px = self.sigma_px.double().expand(frames, points).flatten()
        seen = self.inliers.new_zeros(len(self.inliers), frames, points)
        cameras, own = (self.frame_index >= 0).nonzero(as_tuple=True)
        seen[cameras, self.frame_index[cameras, own]] = self.inliers[cameras, own]
        found = self._point_covariances(self.points.double().flatten(0, 1), seen.flatten(1), sigma_px)
        return found.diagonal(dim1=1, dim2=2).sum(1).sqrt().to(self.points.dtype).view(frames, points)

    def predict_std(self, points: Any, sigma_px: float | None = None) -> Tensor:
        """How precisely points would be triangulated: standard deviations (..., 3) along the axes, metres.

        A point counts as seen by every camera in front of which it lies and, where the image sizes are known, in whose image.

        Args:
            points: (..., 3), metres, in the frame of the calibration, as a tensor, array or list.
            sigma_px: noise of their keypoints along an axis, pixels; None for the median over the calibration's points.

        Returns:
            Standard deviations, the uncertainty of the cameras included; NaN where fewer than two cameras see the point. They
            are in float32 or float64, as the points are.

        Raises:
            ObservationError: if the points are no points, or ``sigma_px`` is no number above 0.
        """
        points = tensor_of(points, "points", device=self.points.device)
        if points.shape[-1:] != (3,):
            got = tuple(points.shape)
            raise ObservationError("points have the wrong shape", where="points", got=got, expected="(..., 3), metres")
        if sigma_px is not None:
            expected = "one number above 0, pixels"
            sigma_px = number_of(
                sigma_px, "sigma_px", what="not the noise of a keypoint", expected=expected, least=1e-9, most=FARTHEST_PX
            )
        flat = points.double().reshape(-1, 3)
        moved = se3.moved(self.rotations.double()[None], self.translations.double()[None], flat.mT[None])[0]
        visible = moved[:, 2] > 0
        if self.image_size is not None:
            pixels = self._cameras().project(moved.movedim(1, -1))
            visible = visible & ((pixels >= 0) & (pixels < self.image_size[:, None].to(pixels.device))).all(-1)
        sigma = flat.new_full(flat.shape[:1], float(self.sigma_px.median()) if sigma_px is None else sigma_px)
        found = self._point_covariances(flat, visible, sigma)
        return found.diagonal(dim1=1, dim2=2).sqrt().to(points.dtype).view(points.shape)

    @cached_property
    def reprojection_rms_px(self) -> Tensor:
        """(C,), root mean square over the inliers of each camera of the residuals' lengths, pixels."""
        return self._inlier_distances().square().nanmean(1).sqrt()

    @cached_property
    def reprojection_median_px(self) -> Tensor:
        """(C,), median over the inliers of each camera of the residuals' lengths, pixels."""
        return self._inlier_distances().nanmedian(1).values

    def _cameras(self) -> Intrinsics:
        return Intrinsics(self.intrinsics.double(), None if self.distortion is None else self.distortion.double(), self.fisheye)

    def _point_covariances(self, points: Tensor, visible: Tensor, sigma_px: Tensor) -> Tensor:
        poses = self.rotations.double(), self.translations.double()
        return point_covariances(points, visible, sigma_px, poses, self._cameras(), self.covariance)

    def _inlier_distances(self) -> Tensor:
        return self.residuals_px.norm(dim=-1).where(self.inliers, torch.nan).flatten(1)

    def plot(self, frame: int | None = None) -> Figure:
        """A 3D figure of cameras, athlete and stick, in the axes of the calibration.

        Args:
            frame: the common frame in which the athlete is drawn; None for the one with the most known points.

        Returns:
            A figure of matplotlib; notebooks show it, ``figure.savefig("rig.png")`` writes it.

        Raises:
            ObservationError: if there is no such frame.
        """
        if frame is not None:
            last = len(self.points) - 1
            frame = int(
                number_of(frame, "frame", what="no such frame", expected=f"a number from 0 to {last}", least=0, most=last)
            )
        return VIEWS["rig"](self, frame)

    def plot_residuals(self) -> Figure:
        """A figure of the residuals of each camera along x and y, and of their size over the frames."""
        return VIEWS["residuals"](self)

    def plot_stick(self) -> Figure:
        """A figure of the reconstructed length of each stick over time, minus the given one."""
        return VIEWS["stick"](self)

    def summary(self) -> dict[str, Any]:
        """The calibration without its arrays, as JSON can hold it: the content of ``report.json``.

        Lengths are in metres, angles in degrees, times in seconds; None where a number is not known.
        """
        return VIEWS["summary"](self)

    def __repr__(self) -> str:
        """One line with the verdict."""
        return VIEWS["text"](self)

    def _repr_html_(self) -> str:
        """What notebooks show: the verdict with its reasons, and a table of the cameras."""
        return VIEWS["html"](self)

    def save(self, path: str | Path) -> None:
        """Write everything to one ``.npz`` file."""
        tensors = {name: getattr(self, name) for name in (*_TENSORS, *_OPTIONAL_TENSORS)}
        arrays = {name: tensor.detach().cpu().numpy() for name, tensor in tensors.items() if tensor is not None}
        for name, parameter in self.unknowns.items():
            values = (getattr(parameter, field).detach() for field in _SAVED_TENSORS)
            arrays[f"{_UNKNOWN}{name}"] = torch.stack(list(values)).cpu().numpy()
        meta = {
            "format": _FORMAT,
            "fisheye": self.fisheye,
            "refined": self.refined,
            "unknowns": {
                name: {"label": p.label, "unit": p.unit, "components": p.components, "refined": p.refined}
                for name, p in self.unknowns.items()
            },
            "sticks": [dataclasses.astuple(stick) for stick in self.sticks],
            "fps": self.fps,
            "point_names": self.point_names,
            "camera_names": self.camera_names,
            "stages": [_stage_as_plain(stage) for stage in self.stages],
            "seconds": self.seconds,
            "quality": self.quality.as_json(),
            "left_out": self.left_out,
            "world": dataclasses.asdict(self.world),
        }
        with atomic_path(path) as temporary, temporary.open("wb") as file:
            save_arrays(file, arrays | {"meta": np.array(json.dumps(meta))})

    @staticmethod
    def load(path: str | Path) -> Calibration:
        """Read what :meth:`save` wrote.

        Raises:
            FileFormatError: if the file is not such a file, or damaged.
            FileNotFoundError: if there is no such file.
        """
        with reading(path, "a file written by Calibration.save", "not a saved calibration"), open_arrays(path) as arrays:
            meta: dict[str, Any] = json.loads(str(arrays["meta"]))
            if meta.pop("format") != _FORMAT:
                raise KeyError("format of this version")
            tensors = {name: _tensor(arrays, name) for name in _TENSORS}
            optional: dict[str, Any] = {name: _tensor(arrays, name) if name in arrays else None for name in _OPTIONAL_TENSORS}
            sizes = check_shapes("calibration", tensors | optional, _TENSORS | _OPTIONAL_TENSORS)
            unknowns = {name: _parameter(arrays, name, about, sizes["C"]) for name, about in meta["unknowns"].items()}
            calibration = Calibration(
                **tensors,
                **optional,
                fisheye=_checked(meta["fisheye"], bool),
                refined=_texts(meta["refined"]),
                unknowns=unknowns,
                sticks=tuple(Stick(*stick) for stick in meta["sticks"]),
                fps=None if meta["fps"] is None else _number(meta["fps"]),
                point_names=None if meta["point_names"] is None else _texts(meta["point_names"]),
                camera_names=_texts(meta["camera_names"]),
                stages=tuple(_stage_record(stage) for stage in _checked(meta["stages"], list)),
                seconds=_numbers(meta["seconds"]),
                judgement=Quality.from_json(_checked(meta["quality"], dict)),
                left_out=_texts(meta["left_out"]),
                world=_world(meta["world"]),
            )
            counts = {"C": calibration.camera_names, "P": calibration.point_names, "S": calibration.sticks}
            if any(given is not None and len(given) != sizes[axis] for axis, given in counts.items()):
                raise ValueError("names or sticks of another number of cameras, points or sticks")
            if not calibration.stages or not all(stage.iterations for stage in calibration.stages):
                raise ValueError("no stage, or one without iterations")
            if len(tensors["covariance"]) != 6 * (sizes["C"] - 1):
                raise ValueError("a covariance of another number of cameras")
            return calibration


def _tensor(arrays: Mapping[str, Any], name: str) -> Tensor:
    """An array of a file, of the kind of numbers that it has by its name."""
    tensor = torch.from_numpy(arrays[name])
    kinds = {"inliers": "b", "other_person": "b", "frame_index": "i", "keypoint_index": "i", "image_size": "iuf"}.get(name, "f")
    if arrays[name].dtype.kind not in kinds:
        raise TypeError(f"{name} is of the type {tensor.dtype}")
    return tensor


def _parameter(arrays: Mapping[str, Any], name: str, about: dict[str, Any], cameras: int) -> CameraParameter:
    values = _tensor(arrays, f"{_UNKNOWN}{name}")
    if values.shape[:2] != (len(_SAVED_TENSORS), cameras):
        raise ValueError(f"{name} has the shape {tuple(values.shape)}")
    value, std, given, prior_std, suggested, suggested_std = values
    return CameraParameter(
        _checked(about["label"], str),
        _checked(about["unit"], str),
        _texts(about["components"]),
        _checked(about["refined"], bool),
        value,
        std,
        given,
        prior_std,
        suggestion=(suggested, suggested_std),
    )


def _world(about: dict[str, Any]) -> World:
    texts = {name: _checked(about[name], str) for name in ("name", "origin", "axes")}
    optional = {"up": str, "vertical_std_deg": float, "floor_std_m": float}
    return World(**texts, **{name: _checked(about[name], kind | None) for name, kind in optional.items()})


def _stage_as_plain(stage: StageRecord) -> dict[str, Any]:
    """What is saved of a stage: all but the poses at each iteration."""
    poses = {"rotations", "translations"}
    iterations = [{name: value for name, value in vars(record).items() if name not in poses} for record in stage.iterations]
    return {**vars(stage), "stop": stage.stop.name, "iterations": iterations}


def _stage_record(stage: dict[str, Any]) -> StageRecord:
    iterations = tuple(_iteration_record(record) for record in _checked(stage["iterations"], list))
    return StageRecord(_checked(stage["name"], str), Stop[stage["stop"]], _number(stage["seconds"]), iterations)


def _iteration_record(record: dict[str, Any]) -> IterationRecord:
    return IterationRecord(
        session=_checked(record["session"], int),
        stage=_checked(record["stage"], str),
        iteration=_checked(record["iteration"], int),
        cost=_number(record["cost"]),
        terms=_numbers(record["terms"]),
        damping=_number(record["damping"]),
        step_m=_number(record["step_m"]),
        reprojection_px=tuple(map(_number, record["reprojection_px"])),
        stick_length_m=_number(record["stick_length_m"]),
    )


def _number(value: Any) -> float:
    return _checked(value, int | float)


def _numbers(values: Any) -> dict[str, float]:
    return {name: _number(value) for name, value in _checked(values, dict).items()}


def _texts(values: Any) -> tuple[str, ...]:
    return tuple(_checked(value, str) for value in _checked(values, list))


def _checked(value: Any, kind: Any) -> Any:
    """A value of a file, which is of some type."""
    if not isinstance(value, kind):
        raise TypeError(f"{type(value).__name__} where {kind} is expected")
    return value
