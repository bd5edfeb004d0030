"""The calibration as a differentiable layer of a network."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import torch
from torch import nn

from torchstickcal.arrays import names_of, tensor_of
from torchstickcal.config import Config, load_config, with_noise
from torchstickcal.errors import CalibrationError, ConfigError, ObservationError, RigError, quoted
from torchstickcal.layer.inputs import LayerInputs, is_of_session
from torchstickcal.layer.result import LayerResult
from torchstickcal.layer.transforms import calibrated_in_any_transform, is_transformed, outside_graphs
from torchstickcal.model.state import State
from torchstickcal.model.unknowns import RigUnknowns
from torchstickcal.pipeline.adjust import adjust_cameras, adjust_points, begin
from torchstickcal.pipeline.adjustment import Adjustment
from torchstickcal.pipeline.attach import attach_gradients
from torchstickcal.pipeline.check import CameraCheck
from torchstickcal.pipeline.conclude import evidence_of
from torchstickcal.pipeline.relabel import Labels
from torchstickcal.pipeline.run import Run
from torchstickcal.precision import full_precision
from torchstickcal.quality.finding import Finding, Severity
from torchstickcal.quality.judge import judged
from torchstickcal.quality.verdict import Quality
from torchstickcal.solvers.gradients import GradientMode, gradient_mode
from torchstickcal.stick import Stick, located_sticks
from torchstickcal.workers import map_on_workers

_FEW_KEYPOINTS, _MOST_KEYPOINTS = 32_000, 64_000
"""Keypoints of the sessions that a CPU solves side by side: fewer are not divided any further, more would leave its cache."""


class CalibrationLayer(nn.Module):
    """From keypoints to cameras and points in metres, with gradients back to keypoints, confidence, intrinsics and lengths.

    Where the configuration estimates lenses, those given are the start. Where it estimates clocks, frames of equal number are
    taken to be of about the same time: time offsets of up to about a frame are found, whole frames are not searched for.

    The gradients are those of all that is estimated, also of the noise: of the keypoints, how long their errors last, and how
    much points accelerate. Decisions count as constants: which keypoints are outliers, which keypoint each point uses, and
    whether errors last at all; and, with clocks, how far each keypoint is moved to the common time, its velocity in the image,
    and its loss of weight by interpolation.

    Args:
        sticks: the stick or sticks, as of :class:`Observations`.
        config: as of :func:`torchstickcal.calibrate`; its solver does not matter to the gradients.
        gradient: ``implicit`` (exact), ``gauss_newton`` (approximate), ``unrolled``, or a :class:`GradientMode`.
        point_names: names of the points, for sticks and losses that name them.
        on_failure: what happens if a session cannot be calibrated: ``status`` (its status says why, and its gradients are zero)
            or ``raise`` (an error for the whole batch).
        judge: whether each session is judged, as ``calibrate`` does: ``result.verdict``, ``agreement``, ``metre_m`` and
            ``qualities``. For small sessions it takes about two thirds of the time of the forward and the backward pass, and
            more where something is wrong.
        noise: as of :func:`torchstickcal.calibrate`. Choose ``given`` to train confidences: a factor on all confidences of one
            point then has an effect, and a gradient.

    Raises:
        ConfigError: if the configuration cannot be used, or leaves it to the data what is refined, or for another
            ``on_failure``.
        ObservationError: if ``sticks`` are no sticks, or one names a point that is not among ``point_names``.

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
        on_failure: Literal["status", "raise"] = "status",
        noise: Literal["estimated", "given"] | None = None,
        judge: bool = False,
    ) -> None:
        super().__init__()
        self.judge = bool(judge)
        self.point_names = names_of(point_names, "point_names")
        self.sticks = located_sticks(sticks, self.point_names)
        self.config = load_config(config) if noise is None else with_noise(load_config(config), noise)
        self._refined = _refined(self.config)
        self.gradient = gradient_mode(gradient)
        if on_failure not in ("status", "raise"):
            raise ConfigError(
                "no such way to treat failures", where="on_failure", got=quoted(on_failure), expected="'status' or 'raise'"
            )
        self.on_failure = on_failure

    def extra_repr(self) -> str:
        """What ``print(layer)`` shows."""
        gradient = type(self.gradient).__name__
        return (
            f"sticks={list(self.sticks)}, stages={list(self.config.stages)}, refine={list(self._refined)}, gradient={gradient}"
        )

    def forward(
        self,
        keypoints: Any,
        intrinsics: Any,
        stick_lengths: Any = None,
        confidence: Any = None,
        initial: LayerResult | None = None,
        image_size: Any = None,
    ) -> LayerResult:
        """Calibrate B sessions of equal shape, or one. B may be 0.

        Tensors, arrays and lists are accepted. Results have the dtype of ``keypoints``, but float32 for float16 and bfloat16,
        and float64 for integers.

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
            ObservationError: for arguments that are no arrays, whose shapes do not fit, or that do not fit the sticks, without
                an image size where it is needed, and for values that nothing can have: a confidence outside [0, 1], a length
                that is none, a matrix that is not a camera's. A session that cannot be calibrated because of its keypoints is
                not an error but a status, and the gradients by what was given of it are zero.
            CalibrationError: with ``on_failure="raise"`` for a session that cannot be calibrated; if the layer is to be
                exported; and for forward-mode and second derivatives, which it does not have.
        """
        return outside_graphs(CalibrationLayer._forward)(
            self, keypoints, intrinsics, stick_lengths, confidence, initial, image_size
        )

    def _forward(
        self,
        keypoints: Any,
        intrinsics: Any,
        stick_lengths: Any,
        confidence: Any,
        initial: LayerResult | None,
        image_size: Any,
    ) -> LayerResult:
        """As :meth:`forward`, never compiled."""
        keypoints = tensor_of(keypoints, "keypoints", masked=torch.nan, keep_graph=True)
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
        if initial is not None:
            initial = self._start(initial)
        with full_precision(keypoints.device):
            result = calibrated_in_any_transform(lambda given: self._calibrated(given, initial), given)
        if self.on_failure == "raise":
            _raise_failures(result.status)
        return result if batched else result.each(lambda tensor: tensor[0])

    def _calibrated(self, given: LayerInputs, initial: LayerResult | None) -> LayerResult:
        """All sessions; those that can be begun are solved side by side, a few at a time."""
        device, run = given.keypoints.device, Run(self.config, to_rounding=True)
        if initial is not None:
            self._check_initial(initial, given)

        def begun(session: int) -> Adjustment | str:
            try:
                with torch.no_grad():
                    start = None if initial is None else initial.warm_start(session)
                    return begin(given.observations(session), run, self._refined, start=start)
            except (ObservationError, RigError) as error:
                if not is_of_session(error):
                    raise _with_session(error, session) from error
                return f"{type(error).__name__}: {error}"

        starts = dict(enumerate(map_on_workers(device, begun, range(len(given.keypoints)))))
        failed = {session: start for session, start in starts.items() if isinstance(start, str)}
        going = {session: start for session, start in starts.items() if isinstance(start, Adjustment)}
        chosen = _side_by_side(list(going), given.keypoints.shape[1:4].numel(), device)

        def solved(sessions: list[int]) -> LayerResult:
            adjustment = Adjustment.stack([going[session] for session in sessions])
            return self._solved(given.of_sessions(sessions), adjustment, run, only_last=initial is not None)

        results = map_on_workers(device, solved, chosen)
        if failed or not going:
            results.append(self._failed(given.of_sessions(list(failed)), list(failed.values())))
        return LayerResult.together(results, [*itertools.chain(*chosen), *failed])

    def _solved(self, given: LayerInputs, begun: Adjustment, run: Run, only_last: bool) -> LayerResult:
        """Sessions adjusted side by side, their last stages with gradients by what was given."""
        with torch.no_grad():
            ended = adjust_points(adjust_cameras(begun, run, only_last), run)
        data = given.relabelled(ended.labels).measurements(
            ended.seen, ended.measurements, self._refined, self.config.camera_groups
        )
        state = attach_gradients(ended, data, run, self.gradient)
        status = tuple(ended.status(session) for session in range(data.sessions))
        result = LayerResult.of(
            data, state, ended.last.inliers, ended.last.sigma_px, ended.labels, status, given.keypoints.dtype
        )
        return self._judged(result, ended) if self.judge else result

    def _judged(self, result: LayerResult, ended: Adjustment) -> LayerResult:
        """A result with the quality of each session."""
        with torch.no_grad():
            found = []
            for session in range(len(ended.records)):
                one = ended.alone(session)
                evidence = evidence_of(one, CameraCheck(one, self.config.camera_groups), self.config)
                found.append((judged(evidence), evidence.agreement))
        return result.with_qualities([quality for quality, _ in found], torch.stack([agreement for _, agreement in found]))

    def _failed(self, given: LayerInputs, status: Sequence[str]) -> LayerResult:
        """Sessions that could not be calibrated, and why: poses of nothing, cameras as given, and gradients of zero."""
        with torch.no_grad():
            data = given.unseen(self._refined, self.config.camera_groups)
            shape, zeros = (len(status), data.num_cameras), data.pixels.new_zeros
            poses = torch.eye(3).to(data.pixels).expand(*shape, 3, 3), zeros(*shape, 3)
            state = State(*poses, zeros(len(status), 3, data.num_columns), data.unknowns.given)
            sigma_px = zeros(len(status), data.points_per_frame)
            result = LayerResult.of(data, state, data.visible, sigma_px, Labels.as_given(data), status, given.keypoints.dtype)
        no_gradient = given.no_gradient()
        result = result.each(lambda tensor: tensor + no_gradient if tensor.is_floating_point() else tensor)
        if not self.judge:
            return result
        return result.with_qualities([_not_calibrated(said) for said in status], torch.zeros_like(result.time_offsets.detach()))

    def _start(self, initial: LayerResult) -> LayerResult:
        """An earlier result to start from, with the batch dimension, without gradients.

        Raises:
            ObservationError: if it is none, or a transform of torch.func has made it.
        """
        if not isinstance(initial, LayerResult) or is_transformed(initial):
            raise ObservationError(
                "not an earlier result to start from",
                where="initial",
                got="a result inside torch.func" if isinstance(initial, LayerResult) else type(initial).__name__,
                expected="a result of this layer, made outside torch.func",
            )
        return initial.detach() if initial.batched else initial.detach().each(lambda tensor: tensor[None])

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


def _side_by_side(sessions: list[int], keypoints: int, device: torch.device) -> list[list[int]]:
    """Sessions of so many keypoints each in groups of about the same size, of which two threads get equally many."""
    count, most = len(sessions), max(1, _MOST_KEYPOINTS // keypoints)
    divided = device.type == "cpu" and count * keypoints > _FEW_KEYPOINTS
    groups = min(count, 2 * -(-count // (2 * most)) if divided else 1)
    return [sessions[count * group // groups : count * (group + 1) // groups] for group in range(groups)]


def _not_calibrated(status: str) -> Quality:
    """The quality of a session that could not be calibrated."""
    meaning = f"The session could not be calibrated: {status}."
    return Quality((Finding("not_calibrated", Severity.FATAL, meaning),))


def _with_session(error: ObservationError | RigError, session: int) -> ObservationError:
    """An error of an argument, which says of which session."""
    where = f"{error.where} of session {session}"
    return ObservationError(error.what, where=where, got=error.got, expected=error.expected, remedy=error.remedy)


def _raise_failures(status: Sequence[str]) -> None:
    """Refuse sessions that could not be calibrated.

    Raises:
        CalibrationError: if there are any.
    """
    failed = {session: said for session, said in enumerate(status) if said != "converged"}
    if failed:
        raise CalibrationError(
            f"{len(failed)} of {len(status)} sessions could not be calibrated",
            where=f"session {', '.join(map(str, failed))}",
            got="; ".join(dict.fromkeys(failed.values())),
            expected="sessions that converge",
            remedy="With on_failure='status' such sessions have a status and zero gradients instead.",
        )


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
