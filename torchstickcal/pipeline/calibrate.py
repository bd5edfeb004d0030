"""The calibration as one story, in the steps of docs/method.md."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, Protocol

from torchstickcal.config import Config, Refine, load_config, with_noise, with_refine
from torchstickcal.errors import RigError
from torchstickcal.inference import ordinary
from torchstickcal.losses import LOSSES
from torchstickcal.model.unknowns import REFINEMENTS
from torchstickcal.observations import Observations
from torchstickcal.pipeline.adjust import adjust_cameras, adjust_points
from torchstickcal.pipeline.adjustment import Adjustment
from torchstickcal.pipeline.check import CameraCheck
from torchstickcal.pipeline.conclude import conclude
from torchstickcal.pipeline.inference import inference_of
from torchstickcal.pipeline.part import adjusted_from_part
from torchstickcal.pipeline.run import Run
from torchstickcal.pipeline.scale import ending_in_scale
from torchstickcal.pipeline.selection import ModelSelection
from torchstickcal.pipeline.start import Poses, starting_from
from torchstickcal.result import Calibration
from torchstickcal.solvers import IterationRecord, ignore_record
from torchstickcal.workers import on_worker

if TYPE_CHECKING:
    from torchstickcal.io.rig import Rig

_ = len(LOSSES), len(REFINEMENTS)  # imported now: a process that is forked while another thread imports them lacks some


class Callback(Protocol):
    """What may listen to a calibration: a progress bar, TensorBoard, a test.

    A callback may also have a method ``on_start(observations)``, which is called before the first step.
    """

    def on_iteration(self, record: IterationRecord) -> None:
        """After each iteration."""
        ...

    def on_end(self, calibration: Calibration) -> None:
        """Once, with the result."""
        ...


def calibrate(
    observations: Observations,
    config: str | Path | Mapping[str, Any] | Config = "default",
    callback: Callback | None = None,
    refine: Sequence[Refine] | Literal["auto"] | None = None,
    noise: Literal["estimated", "given"] | None = None,
    initial: Calibration | Rig | None = None,
) -> Calibration:
    """Find the extrinsics of all cameras and the 3D points, in metres, in the frame of the first camera.

    Args:
        observations: keypoints, intrinsics and sticks.
        config: the name of a configuration, a TOML file, a mapping of its keys, or a :class:`Config`.
        callback: listens to the iterations and the result.
        refine: what else to estimate of the cameras, instead of what the configuration says: names of
            :data:`torchstickcal.model.unknowns.REFINEMENTS`, such as ``focal``, ``radial`` or ``time_offset``, or ``auto`` for
            what the keypoints contradict.
        noise: whether the noise of the keypoints is ``estimated`` or ``given`` as ``sigma_px`` of the configuration, instead of
            what the configuration says. Estimated, confidences compare keypoints of one point with each other; given, they set
            the variance of each keypoint, ``sigma_px ** 2 / confidence``.
        initial: poses of all cameras to start from, of an earlier calibration or of another program, in any frame and up to
            scale. Cameras are matched by name, else by the last number in the names, else by order. Where no intrinsics are
            known, its own are the start. Where the keypoints contradict the poses, they are not used, and a warning says so.

    Returns:
        The calibration. Its ``status`` says whether every stage converged; a stage that did not leaves the best state it found.

    Raises:
        ConfigError: if the configuration cannot be used.
        ObservationError: if clocks are to be estimated without a frame rate.
        RigError: if the cameras cannot be placed in one rig.
        CalibrationError: if ``initial`` lacks a camera or has no poses.

    Example:
        >>> from torchstickcal.simulate import golf_session
        >>> observations, truth = golf_session(cameras=3, frames=20)
        >>> calibration = calibrate(observations)
        >>> calibration.status
        'converged'
        >>> calibration.rotations.shape, calibration.points.shape
        (torch.Size([3, 3, 3]), torch.Size([20, 21, 3]))
    """
    settings = load_config(config)
    if refine is not None:
        settings = with_refine(settings, refine)
    if noise is not None:
        settings = with_noise(settings, noise)
    start = None
    if initial is not None:
        observations, start = starting_from(initial, observations)
    calibrated = _calibrated if settings.incomplete == "refuse" else _largest_part
    return on_worker(observations.keypoints.device, calibrated, observations, settings, callback, start)


def _largest_part(
    observations: Observations, config: Config, callback: Callback | None, start: Poses | None = None
) -> Calibration:
    """All cameras, or where they are no one rig, those of its largest part."""
    try:
        return _calibrated(observations, config, callback, start)
    except RigError as error:
        if not error.parts or len(error.parts[-1]) < 2:
            raise
        left_out = tuple(name for part in error.parts[:-1] for name in part)
    cameras = [camera for camera, name in enumerate(observations.camera_labels) if name not in left_out]
    groups = [config.camera_groups[camera] for camera in cameras] if config.camera_groups else []
    return _calibrated(observations.of_cameras(cameras), replace(config, camera_groups=groups), callback, None, left_out)


def _calibrated(
    observations: Observations,
    config: Config,
    callback: Callback | None,
    start: Poses | None = None,
    left_out: tuple[str, ...] = (),
) -> Calibration:
    steps = calibration_steps(observations, config, callback, start, left_out)
    adjusted: Adjustment | None = None
    with inference_of(observations, config, () if callback is None else (type(callback),)):
        while True:
            try:
                due = steps.send(adjusted)
            except StopIteration as ended:
                return ended.value
            adjusted = due.adjust(due.adjustment, due.run)


class Due(NamedTuple):
    """An adjustment that is due, of one session."""

    adjust: Callable[[Adjustment, Run], Adjustment]
    adjustment: Adjustment
    run: Run


def calibration_steps(
    observations: Observations,
    config: Config,
    callback: Callback | None = None,
    start: Poses | None = None,
    left_out: tuple[str, ...] = (),
) -> Generator[Due, Adjustment | None, Calibration]:
    """One calibration, which asks whoever runs it for its main adjustments: those of other sessions may join them.

    Raises:
        CalibrationError: as :func:`calibrate`.
    """
    began = time.perf_counter()
    if (on_start := getattr(callback, "on_start", None)) is not None:
        on_start(observations)
    config = ending_in_scale(config, len(observations.sticks))
    run = Run(config, callback.on_iteration if callback else ignore_record)
    models = ModelSelection(observations, run, start)

    # 1. Synchronise: where the cameras' frames clearly do not belong together, find the time offsets.
    clocks = models.clocks_unlike_given if "time_offset" in models.allowed else None

    # 2. Initialise rig and points, and 3. adjust them in stages, at the time offsets at which the views fit together best.
    first = adjusted_from_part(models, observations, run, start)
    if first is None and clocks is None and (begun := models.begun()) is not None:
        first = yield Due(adjust_cameras, begun, run)
    adjusted, clocks = models.adjusted(clocks, first)

    # 4. Check the given lenses and clocks when that is first asked for; with refine="auto", estimate what is contradicted.
    check = CameraCheck(adjusted, config.camera_groups)
    if config.refine == "auto":
        adjusted, check = models.refined_where_contradicted(adjusted, check)

    # 5. Trajectories: with the cameras fixed, smooth each point as its noise and its motion demand.
    ended = yield Due(adjust_points, adjusted, run)
    assert ended is not None

    # 6. Conclude: covariance, and the result in the caller's dtype. Its quality is judged when it is first asked for.
    def unsynchronised() -> bool:
        return config.synchronise and "time_offset" not in ended.refined and models.clocks_unlike_given is not None

    run.took("total", time.perf_counter() - began)
    calibration = ordinary(conclude(ended, check, clocks, unsynchronised, left_out, models.start_contradicted, run))
    if callback:
        callback.on_end(calibration)
    return calibration
