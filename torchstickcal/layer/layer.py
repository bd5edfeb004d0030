"""The calibration as a differentiable layer of a network."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from torchstickcal.config import Config, load_config
from torchstickcal.errors import ConfigError, ObservationError, RigError
from torchstickcal.geometry.cameras import Intrinsics
from torchstickcal.layer.inputs import LayerInputs
from torchstickcal.model.measurements import Measurements
from torchstickcal.model.objective import Objective
from torchstickcal.model.state import State
from torchstickcal.model.unknowns import RigUnknowns
from torchstickcal.observations import Stick
from torchstickcal.pipeline.adjust import Adjustment, WarmStart, adjust_cameras, adjust_points, begin
from torchstickcal.pipeline.run import Run
from torchstickcal.pipeline.scale import rulers, scale_factors
from torchstickcal.pipeline.stage import StageResult
from torchstickcal.solvers.gradients import GradientMode, attach, gradient_mode
from torchstickcal.solvers.newton import polish
from torchstickcal.workers import map_on_workers

_KEYPOINTS_AT_ONCE = 32_000
"""Keypoints of the sessions that a CPU solves side by side: more would leave its cache."""


@dataclass(frozen=True)
class LayerResult:
    """Calibrated rigs, in the frame of each session's first camera; leading B only where the keypoints had it.

    Poses, lenses, clocks and points carry gradients, and have the dtype and device of the keypoints.

    Example:
        >>> from torchstickcal.simulate import golf_session
        >>> observations, truth = golf_session(cameras=3, frames=10)
        >>> result = CalibrationLayer(observations.sticks)(observations.keypoints, observations.cameras)
        >>> result.status, result.points.shape
        (('converged',), torch.Size([10, 21, 3]))
    """

    rotations: Tensor
    """(B, C, 3, 3), world to camera; the identity where a session could not be calibrated"""
    translations: Tensor
    """(B, C, 3), metres; zero where a session could not be calibrated"""
    intrinsics: Tensor
    """(B, C, 3, 3), camera matrices, pixels, as given or as estimated; as given where a session could not be calibrated"""
    distortion: Tensor | None
    """(B, C, D), likewise; None for perfect lenses"""
    time_offsets: Tensor
    """(B, C), time by which the middle rows of a camera's frames are exposed after those of the first camera, in frames; zero
    where not estimated"""
    readout: Tensor
    """(B, C), time from the first row of an image to the last, in frames; zero where not estimated"""
    unknowns: Tensor
    """(B, K), what was estimated of the cameras beside their poses, as deviations from what was given"""
    points: Tensor
    """(B, F, P, 3), metres; zero where ``known`` is False"""
    known: Tensor
    """(B, F, P), True where two cameras or more see a point"""
    inliers: Tensor
    """(B, C, F, P), True where a keypoint was used"""
    sigma_px: Tensor
    """(B, P), estimated noise of each point's keypoints, pixels"""
    converged: Tensor
    """(B,); the gradients of a session that could not be calibrated are zero"""
    status: tuple[str, ...]
    """``converged``, or why not, for each session"""


class CalibrationLayer(nn.Module):
    """From keypoints to cameras and points in metres, with gradients back to keypoints, confidence, intrinsics and lengths.

    Where the configuration estimates lenses, those given are the start. Where it estimates clocks, frames of equal number are
    taken to be of about the same time: time offsets of up to about a frame are found, whole frames are not searched for.

    Some things count as constants in the gradients: the noise of the keypoints and the choice of outliers, where the
    configuration estimates them; and, with clocks, how far each keypoint is moved to the common time, its velocity in the
    image, and its loss of weight by interpolation.

    Args:
        sticks: the stick or sticks, as of :class:`Observations`.
        config: as of :func:`torchstickcal.calibrate`; its solver does not matter to the gradients.
        gradient: ``implicit`` (exact), ``gauss_newton`` (approximate), ``unrolled``, or a :class:`GradientMode`.
        point_names: names of the points, for sticks and losses that name them.

    Raises:
        ConfigError: if the configuration cannot be used, or leaves it to the data what is refined.
        ObservationError: if a stick names a point that is not among ``point_names``.

    Example:
        >>> from torchstickcal.simulate import golf_session
        >>> observations, truth = golf_session(cameras=3, frames=10)
        >>> keypoints = observations.keypoints.requires_grad_()
        >>> result = CalibrationLayer(observations.sticks)(keypoints, observations.cameras)
        >>> result.translations.norm(dim=-1).sum().backward()
        >>> keypoints.grad.shape
        torch.Size([3, 10, 21, 2])
    """

    def __init__(
        self,
        sticks: Stick | Sequence[Stick],
        config: str | Path | Mapping[str, Any] | Config = "default",
        gradient: str | GradientMode = "implicit",
        point_names: Sequence[str] | None = None,
    ) -> None:
        super().__init__()
        self.point_names = None if point_names is None else tuple(point_names)
        given = (sticks,) if isinstance(sticks, Stick) else tuple(sticks)
        self.sticks = tuple(stick.located(self.point_names) for stick in given)
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
                initialisation and all stages before the last one that estimates cameras.
            image_size: (2,), (C, 2) or (B, C, 2), width and height, pixels; needed where the configuration refines ``readout``.

        Raises:
            ConfigError: if the configuration's camera groups do not fit the cameras.
            ObservationError: for arguments whose shapes do not fit, and without an image size where it is needed. A session
                that cannot be calibrated is not an error but a status.
        """
        batched = keypoints.ndim == 5
        if "readout" in self._refined and image_size is None:
            raise ObservationError(
                "a read-out time cannot be estimated without the image size",
                where="image_size",
                got=None,
                expected="width and height, (2,), (cameras, 2) or (B, cameras, 2): rows are exposed one after another",
            )
        keypoints = keypoints if batched else keypoints[None]
        given = LayerInputs.of(keypoints, intrinsics, stick_lengths, confidence, image_size, self.sticks, self.point_names)
        if initial is not None and not batched:
            initial = _each(initial, lambda tensor: tensor[None])
        if initial is not None:
            self._check_initial(initial, given)
        with torch.autocast(keypoints.device.type, enabled=False):
            result = self._calibrated(given, initial)
        return result if batched else _each(result, lambda tensor: tensor[0])

    def _calibrated(self, given: LayerInputs, initial: LayerResult | None) -> LayerResult:
        """All sessions; those that can be begun are solved side by side, a few at a time."""
        device, run = given.keypoints.device, Run(self.config)

        def begun(session: int) -> Adjustment | str:
            try:
                with torch.no_grad():
                    return begin(given.observations(session), run, self._refined, start=_warm_start(initial, session))
            except (ObservationError, RigError) as error:
                return f"{type(error).__name__}: {error}"

        starts = dict(enumerate(map_on_workers(device, begun, range(len(given.keypoints)))))
        failed = {session: start for session, start in starts.items() if isinstance(start, str)}
        going = {session: start for session, start in starts.items() if isinstance(start, Adjustment)}
        together = len(going) if device.type != "cpu" else _KEYPOINTS_AT_ONCE // given.keypoints[0, ..., 0].numel()
        chosen = [list(going)[first : first + max(1, together)] for first in range(0, len(going), max(1, together))]

        def solved(sessions: list[int]) -> LayerResult:
            adjustment = Adjustment.stack([going[session] for session in sessions])
            return self._solved(given.of_sessions(sessions), adjustment, run, only_last=initial is not None)

        results = map_on_workers(device, solved, chosen)
        results += [self._failed(given.of_sessions([session]), status) for session, status in failed.items()]
        return _in_order(results, [*itertools.chain(*chosen), *failed])

    def _solved(self, given: LayerInputs, begun: Adjustment, run: Run, only_last: bool) -> LayerResult:
        """Sessions adjusted side by side, their last stages with gradients by what was given."""
        with torch.no_grad():
            ended = adjust_points(adjust_cameras(begun, run, only_last), run)
        data = given.measurements(ended.seen, ended.measurements, self._refined, self.config.camera_groups)
        state = self._with_gradients(data, ended)
        status = tuple(ended.status(session) for session in range(data.sessions))
        known = data.by_frame(ended.last.inliers.any(1))
        points = data.by_frame(state.points).movedim(1, -1).where(known[..., None], 0.0)
        inliers, cameras = data.by_frame(ended.last.inliers), data.cameras_at(state)
        return self._result(given, cameras, data.unknowns, state, points, known, inliers, ended.last.sigma_px, status)

    def _with_gradients(self, data: Measurements, ended: Adjustment) -> State:
        """The state where the last stage ended, with gradients by the measurements.

        It depends on them through the last stage that estimated cameras and through those after it.
        """
        state = ended.state
        for number, result in enumerate(ended.results):
            kept = replace(data, confidence=data.confidence.where(result.inliers, 0.0))
            fixed = None if result.stage.cameras == "free" else state if number else result.minimum
            state = attach(Objective(kept, result.losses), _polished(kept, result, fixed), self.gradient, fixed)
            if result.stage.rescale:
                state = state.scaled(scale_factors(kept, state.points, rulers(kept, self.config)))
        return state

    @torch.no_grad()
    def _failed(self, given: LayerInputs, status: str) -> LayerResult:
        """One session that could not be calibrated, and why."""
        like, unknowns = given.keypoints, RigUnknowns.of(self._refined, given.cameras, self.config.camera_groups)
        _, cameras, frames, points, _ = like.shape
        nothing = torch.zeros(1, cameras, frames, points, dtype=torch.bool, device=like.device)
        zero = given.lengths_m.new_zeros(1, frames, points, 3)
        rotations = torch.eye(3).to(zero).expand(1, cameras, 3, 3)
        state = State(rotations, zero.new_zeros(1, cameras, 3), zero.flatten(1, 2).mT, unknowns.given)
        lenses, sigma_px = unknowns.applied(given.cameras, unknowns.given), zero.new_zeros(1, points)
        return self._result(given, lenses, unknowns, state, zero, nothing[:, 0], nothing, sigma_px, (status,))

    @staticmethod
    def _result(
        given: LayerInputs,
        cameras: Intrinsics,
        unknowns: RigUnknowns,
        state: State,
        points: Tensor,
        known: Tensor,
        inliers: Tensor,
        sigma_px: Tensor,
        status: tuple[str, ...],
    ) -> LayerResult:
        """A result in the dtype of the keypoints."""
        dtype, by_name = given.keypoints.dtype, unknowns.by_name(state.unknowns)
        zero = torch.zeros_like(given.cameras.focal_px)[..., None]
        lenses = cameras.to(dtype)
        return LayerResult(
            rotations=state.rotations.to(dtype),
            translations=state.translations.to(dtype),
            intrinsics=lenses.matrix,
            distortion=lenses.distortion,
            time_offsets=by_name.get("time_offset", zero)[..., 0].to(dtype),
            readout=by_name.get("readout", zero)[..., 0].to(dtype),
            unknowns=state.unknowns.to(dtype),
            points=points.to(dtype),
            known=known,
            inliers=inliers,
            sigma_px=sigma_px.to(dtype),
            converged=torch.tensor([said == "converged" for said in status], device=points.device),
            status=status,
        )

    def _check_initial(self, initial: LayerResult, given: LayerInputs) -> None:
        """Refuse a start from another batch, or with other unknowns.

        Raises:
            ObservationError: if it is one.
        """
        unknowns = RigUnknowns.of(self._refined, given.cameras, self.config.camera_groups)
        expected = (*given.keypoints.shape[:2], unknowns.count)
        got = (*initial.translations.shape[:2], initial.unknowns.shape[-1])
        if got != expected:
            raise ObservationError(
                "the earlier result is of other sessions, or of another choice of what to refine",
                where="initial",
                got=f"{got[0]} sessions, {got[1]} cameras, {got[2]} unknowns",
                expected=f"{expected[0]} sessions, {expected[1]} cameras, {expected[2]} unknowns",
            )


def _warm_start(initial: LayerResult | None, session: int) -> WarmStart | None:
    """Where a session starts from; None for a start from nothing, as after a failure."""
    if initial is None or not bool(initial.converged[session]):
        return None
    points = initial.points[session].detach()
    return WarmStart(
        initial.rotations[session].detach(),
        initial.translations[session].detach(),
        points.where(initial.known[session][..., None], torch.nan),
        initial.unknowns[session].detach(),
        initial.inliers[session],
        initial.sigma_px[session].detach(),
    )


@torch.no_grad()
def _polished(measurements: Measurements, result: StageResult, fixed: State | None) -> State:
    """A stage's minimum, to rounding: a gradient is as exact as the minimum at which it is taken."""
    start = result.minimum if fixed is None else replace(fixed, points=result.minimum.points)
    return polish(Objective(measurements, result.losses), start, cameras_free=fixed is None)


def _in_order(results: Sequence[LayerResult], sessions: Sequence[int]) -> LayerResult:
    """Results of some sessions each as one result of all, in the order of the sessions' numbers."""
    order = sorted(range(len(sessions)), key=lambda place: sessions[place])
    status = [said for result in results for said in result.status]

    def together(name: str) -> Tensor | None:
        tensors = [getattr(result, name) for result in results]
        return None if tensors[0] is None else torch.cat(tensors)[order]

    names = [field.name for field in fields(LayerResult) if field.name != "status"]
    tensors: dict[str, Any] = {name: together(name) for name in names}
    return LayerResult(**tensors, status=tuple(status[place] for place in order))


def _each(result: LayerResult, function: Callable[[Tensor], Tensor]) -> LayerResult:
    """A result made of another, tensor by tensor."""
    tensors = {field.name: getattr(result, field.name) for field in fields(result) if field.name != "status"}
    return replace(result, **{name: tensor if tensor is None else function(tensor) for name, tensor in tensors.items()})


def _refined(config: Config) -> tuple[str, ...]:
    """What a configuration refines.

    Raises:
        ConfigError: if it leaves that to the data.
    """
    if config.refine == "auto":
        raise ConfigError(
            "the layer cannot choose what to refine: a choice has no gradient",
            where="config.refine",
            got="'auto'",
            expected="a list of what to refine",
            remedy="Calibrate once with refine='auto', and give the layer what was refined.",
        )
    return tuple(config.refine)
