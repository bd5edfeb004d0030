"""The calibration as a differentiable layer of a network."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from torchstickcal.config import Config, Stage, load_config
from torchstickcal.errors import CalibrationError, ConfigError, ObservationError
from torchstickcal.geometry.cameras import Intrinsics
from torchstickcal.model.measurements import Measurements, State
from torchstickcal.model.objective import Objective
from torchstickcal.model.unknowns import CameraUnknowns
from torchstickcal.observations import Observations, Stick
from torchstickcal.pipeline.adjust import points_used
from torchstickcal.pipeline.initialise import initialise, triangulated
from torchstickcal.pipeline.stage import Ruler, StageResult, rulers, run_stage, scale_factors
from torchstickcal.pipeline.synchronise import CLOCK_STAGE, Exposures, Support, on_one_clock
from torchstickcal.solvers import unheard
from torchstickcal.solvers.gradients import GradientMode, attach, gradient_mode
from torchstickcal.solvers.newton import polish
from torchstickcal.workers import map_on_workers

_KEYPOINTS_AT_ONCE = 32_000
"""Keypoints of the sessions that a CPU solves side by side: more would leave its cache."""


@dataclass(frozen=True)
class LayerResult:
    """Calibrated rigs, in the frame of each session's first camera; leading B only where the keypoints had it.

    Poses, lenses, clocks and points carry gradients, and have the dtype and device of the keypoints.
    """

    rotations: Tensor
    """(B, C, 3, 3), world to camera; the identity where a session could not be calibrated"""
    translations: Tensor
    """(B, C, 3), metres; zero where a session could not be calibrated"""
    intrinsics: Tensor
    """(B, C, 3, 3), pixels, with what the configuration refines as found; as given where a session could not be calibrated"""
    distortion: Tensor | None
    """(B, C, D), likewise; None for perfect lenses"""
    time_offsets: Tensor
    """(B, C), how much later than the first camera's a camera's frames are exposed in their middle row, frames; zero where the
    configuration does not refine it"""
    readout: Tensor
    """(B, C), time from the first row of an image to the last, frames; likewise"""
    unknowns: Tensor
    """(B, K), how lenses and clocks differ from those given, as :class:`torchstickcal.model.unknowns.CameraUnknowns` has it"""
    points: Tensor
    """(B, F, P, 3), metres; zero where ``known`` is False"""
    known: Tensor
    """(B, F, P), whether two cameras or more see a point"""
    inliers: Tensor
    """(B, C, F, P), which keypoints took part"""
    sigma_px: Tensor
    """(B, P), noise of each point's keypoints"""
    converged: Tensor
    """(B,); the gradients of a session that could not be calibrated are zero"""
    status: tuple[str, ...]
    """``converged``, or why not, for each session"""


class CalibrationLayer(nn.Module):
    """From keypoints to cameras and points in metres, with gradients back to keypoints, confidence, intrinsics and lengths.

    Where the configuration refines lenses, those given are where they are found from. Where it refines clocks, frames that
    stand side by side are taken to be of about the same time: offsets of up to about a frame are found, and whole frames are
    not searched for.

    The noise of the keypoints and the choice of outliers, where the configuration estimates them, count as constants. So does
    the motion by which keypoints are brought to one clock: how far each is moved to where the clocks were found, its velocity
    in the image, and the weight that it loses to interpolation. What else a clock depends on, its gradient has.

    Args:
        sticks: the stick or sticks, as of :class:`Observations`.
        config: as of :func:`torchstickcal.calibrate`; its solver does not matter to the gradients.
        gradient: ``implicit`` (exact), ``gauss_newton`` (approximate), ``unrolled``, or a :class:`GradientMode`.

    Raises:
        ConfigError: for an unusable configuration, or one that chooses what to refine.
    """

    def __init__(
        self,
        sticks: Stick | Sequence[Stick],
        config: str | Path | Mapping[str, Any] | Config = "default",
        gradient: str | GradientMode = "implicit",
    ) -> None:
        super().__init__()
        self.sticks = (sticks,) if isinstance(sticks, Stick) else tuple(sticks)
        self.config = load_config(config)
        self._refined = _refined(self.config)
        self.gradient = gradient_mode(gradient)

    def forward(
        self,
        keypoints: Tensor,
        intrinsics: Tensor | Intrinsics,
        stick_lengths: Tensor | None = None,
        confidence: Tensor | None = None,
        initial: LayerResult | None = None,
        image_size: Tensor | Sequence[int] | None = None,
    ) -> LayerResult:
        """Calibrate B sessions of equal shape, or one.

        Args:
            keypoints: (B, C, F, P, 2) or (C, F, P, 2), pixels, NaN where not seen.
            intrinsics: camera matrices (3, 3), (C, 3, 3) or (B, C, 3, 3), or :class:`Intrinsics` with their lenses.
            stick_lengths: (S,) or (B, S), metres, instead of the lengths of ``sticks``.
            confidence: (B, C, F, P) or (C, F, P), in [0, 1].
            initial: an earlier result of this layer to start from, if the keypoints have moved but little since. It saves the
                initialisation and all stages before the last one that adjusts the cameras.
            image_size: (2,), (C, 2) or (B, C, 2), width and height, pixels; needed where the configuration refines ``readout``.

        Raises:
            ConfigError: if the configuration's camera groups do not fit the cameras.
            ObservationError: for arguments whose shapes do not fit, and without an image size where it is needed. A session
                that cannot be calibrated from is not an error but a status.
        """
        batched = keypoints.ndim == 5
        if "readout" in self._refined and image_size is None:
            raise ObservationError(
                "a read-out time without what it is counted in",
                where="image_size",
                got=None,
                expected="width and height, (2,), (cameras, 2) or (B, cameras, 2): rows are exposed one after another",
            )
        keypoints = keypoints if batched else keypoints[None]
        given = _Given.of(keypoints, intrinsics, stick_lengths, confidence, image_size, self.sticks)
        if self._refined:
            given = replace(given, unknowns=CameraUnknowns.of(self._refined, given.cameras, self.config.camera_groups))
        if initial is not None and not batched:
            initial = _each(initial, lambda tensor: tensor[None])
        if initial is not None and initial.unknowns.shape != given.nothing_found.shape:
            raise ObservationError(
                "the earlier result is of other sessions, or of another choice of what to refine",
                where="initial.unknowns",
                got=tuple(initial.unknowns.shape),
                expected=str(tuple(given.nothing_found.shape)),
            )
        with torch.autocast(keypoints.device.type, enabled=False):
            result = self._calibrated(given, initial)
        return result if batched else _each(result, lambda tensor: tensor[0])

    def _calibrated(self, given: _Given, initial: LayerResult | None) -> LayerResult:
        """All sessions; those that can be begun are solved side by side."""
        shape = given.keypoints.shape[:-1]
        device = given.keypoints.device
        found: dict[int, _Solved] = {}

        def begin(index: int) -> _Begun | str:
            try:
                return self._begin(given, initial, index)
            except CalibrationError as error:
                return f"{type(error).__name__}: {error}"

        begun: dict[int, _Begun] = {}
        with torch.no_grad():
            for index, start in enumerate(map_on_workers(device, begin, range(shape[0]))):
                if isinstance(start, str):
                    found[index] = given.failed(index, start)
                else:
                    begun[index] = start
        together = len(begun) if device.type != "cpu" else max(1, _KEYPOINTS_AT_ONCE // shape[1:].numel())
        groups = [list(begun)[first : first + together] for first in range(0, len(begun), max(1, together))]

        def solve(group: list[int]) -> list[_Solved]:
            return self._solve(given.of_sessions(group), [begun[index] for index in group], warm=initial is not None)

        for group, solved in zip(groups, map_on_workers(device, solve, groups), strict=True):
            for index, session in zip(group, solved, strict=True):
                found[index] = session
        *columns, status = zip(*(found[index] for index in range(shape[0])), strict=True)
        tensors: list[Any] = [None if column[0] is None else torch.stack(column) for column in columns]
        return LayerResult(*tensors, status=status)

    def _begin(self, given: _Given, initial: LayerResult | None, index: int) -> _Begun:
        """A session's measurements and where to start."""
        observations = given.observations(index, self.sticks)
        given = given.of_sessions([index])
        seen = Measurements.of(observations, points_used(observations, self.config))
        refined = replace(seen, unknowns=given.unknowns)
        resting = given.exposures.resting(refined) if given.clocked else refined
        settings = self.config.initialise
        if initial is None or not bool(initial.converged[index]):
            labels = [observations.camera_label(camera) for camera in range(observations.num_cameras)]
            state = replace(initialise(seen, settings, labels), unknowns=given.nothing_found)
            return _Begun(observations, refined, resting, state)
        rotations, translations, unknowns = (
            v[index][None].detach().double() for v in (initial.rotations, initial.translations, initial.unknowns)
        )
        points = initial.points[index].detach().double().flatten(0, 1).mT[None]
        known = initial.known[index].flatten()
        if bool((seen.active[0] & ~known).any()):
            points = points.where(known, triangulated(seen, rotations, translations, settings))
        state = State(rotations, translations, points.contiguous(), unknowns)
        if not given.clocked:
            return _Begun(observations, refined, resting, state)
        sigma_px = initial.sigma_px[index][None].detach().double()
        support = Support.of(resting.keeping(initial.inliers[index].flatten(1)[None]), state, sigma_px)
        return _Begun(observations, refined, given.exposures.placed(refined, state, support), state)

    def _solve(self, given: _Given, begun: list[_Begun], warm: bool) -> list[_Solved]:
        """Run the stages on sessions side by side, then tie the last ones to what was given."""
        known = rulers([session.observations for session in begun], self.config)
        as_seen = Measurements.stack([session.seen for session in begun])
        measurements, decisive = self._through(given, as_seen, begun, known, warm)
        data = given.measurements(as_seen, measurements)
        tied = self._tied(data, decisive, known)
        last = decisive[-1][1]
        status = [
            "; ".join(f"{record.name}: {record.stop}" for record in records if not record.stop.converged) or "converged"
            for records in zip(*(result.records for _, result in decisive), strict=True)
        ]
        seen = measurements.by_frame(last.inliers.any(1))
        points = measurements.by_frame(tied.points).movedim(1, -1).where(seen[..., None], 0.0)
        dtype = given.keypoints.dtype
        cameras = data.cameras_at(tied).to(dtype)
        assert tied.unknowns is not None
        time_offsets, readout = given.clocks(tied.unknowns)
        return [
            _Solved(
                tied.rotations[k].to(dtype),
                tied.translations[k].to(dtype),
                cameras.matrix[k],
                None if cameras.distortion is None else cameras.distortion[k],
                time_offsets[k].to(dtype),
                readout[k].to(dtype),
                tied.unknowns[k].to(dtype),
                points[k].to(dtype),
                seen[k],
                measurements.by_frame(last.inliers[k]),
                last.sigma_px[k].to(dtype),
                torch.tensor(status[k] == "converged", device=points.device),
                status[k],
            )
            for k in range(len(begun))
        ]

    @torch.no_grad()
    def _through(
        self, given: _Given, seen: Measurements, begun: list[_Begun], known: Sequence[Ruler], warm: bool
    ) -> tuple[Measurements, list[tuple[Stage, StageResult]]]:
        """The keypoints as the stages leave them, on one clock where clocks are to be found, and the results of the last stage
        that adjusts the cameras and of those after it."""
        stages = list(self.config.stages.items())
        last_free = max((number for number, (_, stage) in enumerate(stages) if stage.cameras == "free"), default=0)
        measurements = Measurements.stack([session.measurements for session in begun])
        state = State.stack([session.state for session in begun])
        reached: list[tuple[Stage, StageResult]] = []

        def run(name: str, stage: Stage, measurements: Measurements, state: State) -> StageResult:
            return run_stage(name, stage, measurements, state, known, self.config.solver, unheard)

        for number, (name, stage) in list(enumerate(stages))[last_free if warm else 0 :]:
            result = run(name, stage, measurements, state)
            if number == last_free and measurements.motion is not None:
                again = partial(run, CLOCK_STAGE, stage)
                measurements, result = on_one_clock(seen, given.exposures, measurements, result, again)
            reached.append((stage, result))
            state = result.state
        return measurements, reached[last_free - len(stages) :]

    def _tied(self, data: Measurements, decisive: Sequence[tuple[Stage, StageResult]], known: Sequence[Ruler]) -> State:
        """The result of the last stage that adjusts the cameras and of those after it, with gradients by the data."""
        rulers_given = [
            replace(ruler, lengths_m=data.lengths_m[:, number]) if ruler.rigid else ruler for number, ruler in enumerate(known)
        ]
        state: State | None = None
        for stage, result in decisive:
            kept = replace(data, confidence=data.confidence.where(result.inliers, 0.0))
            held = state if stage.cameras == "held" else None
            minimum = _polished(kept, result, held)
            state = attach(Objective(kept, result.losses), minimum, self.gradient, held)
            if stage.rescale:
                state = state.scaled(scale_factors(kept, state.points, rulers_given))
        assert state is not None
        return state


class _Begun(NamedTuple):
    """A session on its way into the solver."""

    observations: Observations
    seen: Measurements
    """the keypoints as seen"""
    measurements: Measurements
    """the same, where the clocks are known at the start brought to one"""
    state: State


class _Solved(NamedTuple):
    """One session of :class:`LayerResult`."""

    rotations: Tensor
    translations: Tensor
    intrinsics: Tensor
    distortion: Tensor | None
    time_offsets: Tensor
    readout: Tensor
    unknowns: Tensor
    points: Tensor
    known: Tensor
    inliers: Tensor
    sigma_px: Tensor
    converged: Tensor
    status: str


@torch.no_grad()
def _polished(measurements: Measurements, result: StageResult, held: State | None) -> State:
    """A stage's minimum, to rounding: a gradient is worth as much as the minimum that it is taken at."""
    start = result.minimum if held is None else replace(held, points=result.minimum.points)
    return polish(Objective(measurements, result.losses), start, cameras_free=held is None)


@dataclass(frozen=True)
class _Given:
    """What a layer was given, with a batch dimension throughout."""

    keypoints: Tensor
    """(B, C, F, P, 2)"""
    confidence: Tensor | None
    """(B, C, F, P)"""
    cameras: Intrinsics
    """(B, C, ...), float64"""
    lengths_m: Tensor
    """(B, S), float64"""
    image_size: Tensor | None
    """(B, C, 2), width and height, pixels"""
    unknowns: CameraUnknowns | None = None
    """what is to be found of lenses and clocks"""

    @staticmethod
    def of(
        keypoints: Tensor,
        intrinsics: Tensor | Intrinsics,
        stick_lengths: Tensor | None,
        confidence: Tensor | None,
        image_size: Tensor | Sequence[int] | None,
        sticks: Sequence[Stick],
    ) -> _Given:
        """Arguments of a forward pass, ``keypoints`` (B, C, F, P, 2), checked for their shapes."""
        if keypoints.ndim != 5 or keypoints.shape[-1] != 2:
            raise ObservationError(
                "keypoints have the wrong shape",
                where="keypoints",
                got=tuple(keypoints.shape),
                expected="(B, cameras, frames, points, 2) or (cameras, frames, points, 2)",
            )
        sessions, cameras = keypoints.shape[:2]
        if stick_lengths is None:
            stick_lengths = torch.tensor([stick.length_m for stick in sticks], dtype=torch.float64)
        lens = intrinsics if isinstance(intrinsics, Intrinsics) else Intrinsics(intrinsics)
        distortion = lens.distortion
        if distortion is not None:
            distortion = _expanded("distortion", distortion, (sessions, cameras, distortion.shape[-1]), keypoints)
        if image_size is not None:
            image_size = _expanded("image_size", torch.as_tensor(image_size), (sessions, cameras, 2), keypoints)
        return _Given(
            keypoints,
            None if confidence is None else confidence.reshape(keypoints.shape[:-1]),
            Intrinsics(_expanded("intrinsics", lens.matrix, (sessions, cameras, 3, 3), keypoints), distortion, lens.fisheye),
            _expanded("stick_lengths", stick_lengths, (sessions, len(sticks)), keypoints),
            image_size,
        )

    def of_sessions(self, chosen: list[int]) -> _Given:
        """Some of the sessions."""
        confidence = None if self.confidence is None else self.confidence[chosen]
        return _Given(
            self.keypoints[chosen],
            confidence,
            self.cameras[chosen],
            self.lengths_m[chosen],
            None if self.image_size is None else self.image_size[chosen],
            self.unknowns and self.unknowns[chosen],
        )

    @property
    def exposures(self) -> Exposures:
        """When the keypoints were exposed, as far as told."""
        return Exposures.together(self.keypoints.detach(), self.image_size)

    @property
    def clocked(self) -> bool:
        """Whether clocks are to be found."""
        return self.unknowns is not None and self.unknowns.clocked

    @property
    def nothing_found(self) -> Tensor:
        """(B, K), the unknowns of lenses and clocks as given."""
        return self.lengths_m.new_zeros(len(self.lengths_m), 0 if self.unknowns is None else self.unknowns.count)

    def clocks(self, values: Tensor) -> tuple[Tensor, Tensor]:
        """Time offsets and read-out times (B, C), frames, at values (B, K) of the unknowns."""
        own = {} if self.unknowns is None else self.unknowns.by_kind(values)
        nothing = torch.zeros_like(self.cameras.focal_px)
        return own.get("time_offset", nothing), own.get("readout", nothing)

    @torch.no_grad()
    def failed(self, index: int, status: str) -> _Solved:
        """A session that could not be calibrated, and why."""
        like = self.keypoints
        cameras, frames, points = like.shape[1:-1]
        nothing = torch.zeros(cameras, frames, points, dtype=torch.bool, device=like.device)
        lenses = self.cameras if self.unknowns is None else self.unknowns.applied(self.cameras, self.nothing_found)
        lens = lenses[index].to(like.dtype)
        time_offsets, readout = self.clocks(self.nothing_found)
        return _Solved(
            torch.eye(3).to(like).expand(cameras, 3, 3),
            like.new_zeros(cameras, 3),
            lens.matrix,
            lens.distortion,
            time_offsets[index].to(like.dtype),
            readout[index].to(like.dtype),
            self.nothing_found[index].to(like.dtype),
            like.new_zeros(frames, points, 3),
            nothing[0],
            nothing,
            like.new_zeros(points),
            nothing[0, 0, 0],
            status,
        )

    def observations(self, index: int, sticks: Sequence[Stick]) -> Observations:
        """One session, without gradients."""
        distortion = self.cameras.distortion
        lengths = self.lengths_m[index].tolist()
        return Observations(
            self.keypoints[index].detach(),
            self.cameras.matrix[index].detach(),
            [replace(stick, length_m=length) for stick, length in zip(sticks, lengths, strict=True)],
            distortion=None if distortion is None else distortion[index].detach(),
            confidence=None if self.confidence is None else self.confidence[index].detach(),
            fisheye=self.cameras.fisheye,
        )

    def measurements(self, seen: Measurements, solved: Measurements) -> Measurements:
        """Measurements as those that were solved, which are those seen or were moved and weighted since, with gradients."""
        visible = seen.by_frame(seen.visible)
        keypoints = torch.where(visible[..., None], self.keypoints.double(), 0.0)
        confidence = visible.double() if self.confidence is None else self.confidence.double().where(visible, 0.0)
        weight = (solved.confidence / seen.confidence).where(seen.visible, 0.0)
        return replace(
            solved,
            pixels=keypoints.movedim(-1, 2).flatten(3) + (solved.pixels - seen.pixels),
            confidence=confidence.flatten(2) * weight,
            cameras=self.cameras,
            lengths_m=self.lengths_m,
            unknowns=self.unknowns,
        )


def _expanded(name: str, tensor: Tensor, shape: tuple[int, ...], like: Tensor) -> Tensor:
    """A tensor in float64, expanded to a shape.

    Raises:
        ObservationError: if it does not fit.
    """
    try:
        return tensor.to(like.device, torch.float64).expand(shape)
    except RuntimeError as error:
        expected = f"{shape}, or fewer dimensions where all are alike"
        raise ObservationError("the wrong shape", where=name, got=tuple(tensor.shape), expected=expected) from error


def _each(result: LayerResult, function: Callable[[Tensor], Tensor]) -> LayerResult:
    """A result made of another, tensor by tensor."""
    tensors = {field.name: getattr(result, field.name) for field in fields(result) if field.name != "status"}
    return replace(result, **{name: tensor if tensor is None else function(tensor) for name, tensor in tensors.items()})


def _refined(config: Config) -> tuple[str, ...]:
    """What a configuration refines.

    Raises:
        ConfigError: if that is up to the data.
    """
    if config.refine == "auto":
        raise ConfigError(
            "the layer does not choose what to refine, which has no gradient",
            where="config.refine",
            got="'auto'",
            expected="a list of what to refine",
            remedy="Calibrate once with refine='auto', and give the layer what was refined.",
        )
    return tuple(config.refine)
