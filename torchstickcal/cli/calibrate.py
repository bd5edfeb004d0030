"""The command `calibrate`."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchstickcal.cli.configuration import calibration_config, made_with
from torchstickcal.cli.console import note
from torchstickcal.cli.detect import session_in
from torchstickcal.cli.outputs import chosen_files, show_results
from torchstickcal.cli.progress import StagesProgress, progress, weights_of
from torchstickcal.cli.world import placed, world_of
from torchstickcal.errors import CalibrationError

if TYPE_CHECKING:
    from torchstickcal.config import Config
    from torchstickcal.io import Given, Rig
    from torchstickcal.observations import Observations
    from torchstickcal.pipeline.calibrate import Callback
    from torchstickcal.result import Calibration
    from torchstickcal.stick import Stick


def calibrate_session(options: argparse.Namespace) -> int:
    from torchstickcal.files import atomic_set, try_writing
    from torchstickcal.io import load_session
    from torchstickcal.outputs import check_frame_rate
    from torchstickcal.pipeline.calibrate import calibrate

    config = calibration_config(options)
    files, world = chosen_files(options.write, rerun=options.rrd), world_of(options.world, options.units)
    initial = initial_of(options.initial)
    try_writing(options.out, files.single_files)
    if options.tensorboard is not None:
        try_writing(options.tensorboard, where="--tensorboard")
    given = given_of(options)
    session = load_session(session_in(options.session, options), options.format, given)
    for sentence in session.notes:
        note(sentence)
    observations = with_stick(session.observations, options.stick_length, options.stick_sigma)
    check_frame_rate(files.writers, observations)
    with progress(options) as bar:

        def listener() -> Callback:
            return StagesProgress(bar, weights_of(config), _monitor(options.tensorboard))

        calibration = calibrate(observations, config, listener(), initial=initial)
        if options.split_moved and (split := _split(observations, calibration)) is not None:
            calibration = calibrate(split, config, listener())
        calibration, sentences = placed(calibration, world)
        with atomic_set(options.out) as folder:
            files(calibration, folder, _provenance(options, config, [*session.notes, *sentences]))
    for sentence in [*sentences, *(f.meaning for f in calibration.quality.findings if f.code == "height_unused")]:
        note(sentence)
    return show_results(calibration, options.out, files, options.strict, options.verbose)


def _split(observations: Observations, calibration: Calibration) -> Observations | None:
    """The observations with the camera that moved as two; None if none moved at some frame."""
    for finding in calibration.quality.findings:
        if finding.code == "camera_moved" and finding.frames and finding.cameras:
            camera = observations.camera_labels.index(finding.cameras[0])
            return observations.with_camera_split(camera, finding.frames[0])
    return None


def given_of(options: argparse.Namespace) -> Given:
    """What the options say of a recording.

    Raises:
        CalibrationError: if a stick has no length, or a file of the stick's ends cannot be read.
    """
    from torchstickcal.io import Given, read_recording
    from torchstickcal.stick import Stick

    sticks = [Stick(_end(start), _end(end), _metres(length)) for start, end, length in options.stick or ()]
    sticks = _with_offsets(sticks, options.stick_offset or ())
    return Given(
        stick=sticks or None,
        intrinsics=options.intrinsics,
        image_size=options.image_size,
        fps=options.fps,
        skeleton=options.skeleton,
        person=options.person,
        stick_points=None if options.stick_points is None else read_recording(options.stick_points),
        turned=options.turned,
    )


def initial_of(path: Path | None) -> Calibration | Rig | None:
    """The calibration from whose poses another one starts."""
    from torchstickcal.io.results import read_result

    return None if path is None else read_result(path)


def _end(text: str) -> int | str:
    """A stick's end: the index or the name of a point."""
    return int(text) if text.isascii() and text.isdecimal() else text


def _with_offsets(sticks: Sequence[Stick], offsets: Sequence[tuple[str, str]]) -> list[Stick]:
    """The sticks with the offsets (point, metres or "unknown") of their ends.

    Raises:
        CalibrationError: if a point is no end of a stick.
    """
    for point, text in offsets:
        offset_m = None if text == "unknown" else _metres(text, "--stick-offset", "POINT METRES, or POINT unknown")
        end = _end(point)
        if all(end not in (stick.start, stick.end) for stick in sticks):
            raise CalibrationError(
                "an offset of a point that is no end of a stick", where="--stick-offset", got=repr(point),
                expected="START or END of a --stick",
            )  # fmt: skip
        changes = [{"start_offset_m": offset_m} if end == s.start else {"end_offset_m": offset_m} for s in sticks]
        sticks = [
            replace(stick, **change) if end in (stick.start, stick.end) else stick
            for stick, change in zip(sticks, changes, strict=True)
        ]
    return list(sticks)


def _metres(text: str, where: str = "--stick", expected: str = "START END METRES, such as knob barrel 0.864") -> float:
    try:
        return float(text)
    except ValueError as error:
        raise CalibrationError("not a length", where=where, got=repr(text), expected=expected) from error


def _provenance(options: argparse.Namespace, config: Config, notes: Sequence[str]) -> dict[str, Any]:
    """What the results are made of, as JSON can hold it."""
    from dataclasses import asdict

    return {
        "session": ", ".join(map(str, options.session)),
        **made_with(options.config, options.set),
        "configuration": asdict(config),
        **({"notes": list(notes)} if notes else {}),
    }


def with_stick(observations: Observations, length_m: float | None, sigma_m: float | None) -> Observations:
    """The observations with another length of their stick, and another standard deviation of it.

    Raises:
        CalibrationError: if there is not exactly one stick, or if a value is not a length in metres.
    """
    if length_m is not None:
        observations = observations.with_stick_length(length_m)
    if sigma_m is None:
        return observations
    if len(observations.sticks) != 1:
        raise CalibrationError(
            "the standard deviation of a length needs a session with one stick",
            where="--stick-sigma",
            got=f"{len(observations.sticks)} sticks",
            expected="one stick",
        )
    return replace(observations, sticks=(replace(observations.sticks[0], sigma_m=sigma_m),))


def _monitor(log_dir: Path | None) -> Callback | None:
    if log_dir is None:
        return None
    from torchstickcal.show.tensorboard import TensorBoardMonitor

    return TensorBoardMonitor(log_dir)
