"""The command line. What needs torch is imported when a command runs, so that help and usage errors come at once."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchstickcal.errors import CalibrationError

if TYPE_CHECKING:
    from torchstickcal.config import Config
    from torchstickcal.io import Truth
    from torchstickcal.metrics import PoseErrors
    from torchstickcal.pipeline.calibrate import Callback
    from torchstickcal.result import Calibration
    from torchstickcal.solvers import IterationRecord

EXIT_DONE, EXIT_NOT_CONVERGED, EXIT_UNUSABLE = 0, 1, 2
CAMERAS_FILE, POINTS_FILE, REPORT_FILE = "calibration.toml", "points.npz", "report.json"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; returns the exit status."""
    options = _parser().parse_args(arguments)
    try:
        return options.run(options)
    except (CalibrationError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return EXIT_UNUSABLE


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="torchstickcal",
        description="Calibrate a camera rig, in metres, from an athlete's keypoints and a stick of known length.",
    )
    commands = parser.add_subparsers(metavar="COMMAND", required=True)

    command = commands.add_parser("calibrate", help="calibrate a session", description="Calibrate a session.")
    command.add_argument("session", metavar="SESSION", type=Path, help="an .npz session or a Sports-Stick-Syn .pkl")
    command.add_argument("--out", metavar="DIR", type=Path, required=True, help="folder for the results, made if need be")
    _add_config(command)
    command.add_argument(
        "--refine",
        metavar="A,B|auto|none",
        help="what to find of lenses and clocks: focal, focal_shared, principal_point, radial, time_offset, readout, none, or "
        "auto for what the data contradict (default: as configured, else auto)",
    )
    command.add_argument("--no-sync", action="store_true", help="take the cameras' clocks as told")
    command.add_argument("--stick-length", metavar="M", type=float, help="length of the stick in metres, if not the session's")
    command.add_argument("--tensorboard", metavar="DIR", type=Path, help="write a TensorBoard log of the calibration")
    command.set_defaults(run=_calibrate)

    command = commands.add_parser(
        "evaluate", help="compare a calibration with the truth", description="Compare a calibration with the truth."
    )
    command.add_argument("calibration", metavar="DIR", type=Path, help=f"a folder with {CAMERAS_FILE}, or such a file")
    command.add_argument("truth", metavar="TRUTH", type=Path, help="a session that carries its truth, or as DIR")
    command.add_argument("--json", metavar="FILE", type=Path, help="write the errors as JSON")
    command.set_defaults(run=_evaluate)

    command = commands.add_parser(
        "benchmark",
        help="measure on sessions with truth",
        description="Score a configuration on sessions with truth, or with --out all methods, with tables and figures.",
    )
    command.add_argument("place", metavar="DIR|PRESET", help="a folder of sessions, or a preset of the simulator")
    command.add_argument("--count", metavar="N", type=int, help="only the first N sessions")
    command.add_argument("--json", metavar="FILE", type=Path, help="write the scores as JSON (without --out)")
    _add_config(command)
    command.add_argument("--out", metavar="DIR", type=Path, help="folder for the results; what it holds is not measured again")
    command.add_argument("--methods", metavar="A,B", help="with --out: which methods (default: all; a wrong name lists them)")
    command.add_argument("--jobs", metavar="N", type=int, default=1, help="with --out: processes (default: 1)")
    command.set_defaults(run=_benchmark)

    command = commands.add_parser(
        "simulate",
        help="generate sessions with truth",
        description="Generate sessions with truth: a preset, or a sport seen by six cameras.",
    )
    command.add_argument("name", metavar="PRESET|SPORT", help="what to generate; a wrong name lists what there is")
    command.add_argument("--out", metavar="DIR", type=Path, required=True, help="folder for the sessions, made if need be")
    command.add_argument("--count", metavar="N", type=int, help="how many sessions (default: all of a preset, one of a sport)")
    command.add_argument("--seed", metavar="N", type=int, default=0, help="added to the sessions' own seeds (default: 0)")
    command.add_argument("--gif", action="store_true", help="draw each session as an animation beside it")
    command.set_defaults(run=_simulate)

    command = commands.add_parser(
        "demo",
        help="calibrate a generated golf swing",
        description="Generate a golf swing seen by six cameras, with noise, gaps and outliers; calibrate it; show the result.",
    )
    command.add_argument("--out", metavar="DIR", type=Path, default=Path("demo"), help="folder for the results (default: demo)")
    command.add_argument("--seed", type=int, default=0, help="of everything random (default: 0)")
    command.set_defaults(run=_demo)
    return parser


def _add_config(command: argparse.ArgumentParser) -> None:
    command.add_argument("--config", metavar="NAME|FILE", default="default", help="a configuration (default: default)")
    command.add_argument(
        "--threads",
        metavar="N",
        type=int,
        default=1,
        help="threads of torch (default: 1, which is hardly slower and does not stall beside other programs)",
    )


def _calibrate(options: argparse.Namespace) -> int:
    from torchstickcal.config import load_config
    from torchstickcal.io import read_session
    from torchstickcal.pipeline.calibrate import calibrate

    _use_threads(options.threads)
    config, refine = _refining(load_config(options.config), options.refine, options.no_sync)
    observations, _ = read_session(options.session)
    if options.stick_length is not None:
        observations = observations.with_stick_length(options.stick_length)
    calibration = calibrate(observations, config, _Progress(_monitor(options.tensorboard)), refine)
    _write(calibration, options.out, {"session": str(options.session), "config": options.config})
    return _show(calibration, options.out)


def _refining(config: Config, option: str | None, no_sync: bool) -> tuple[Config, Any]:
    """The configuration, and what to refine instead of what it says; None where it decides.

    Raises:
        CalibrationError: if clocks are both to be found and to be taken as told.
    """
    from torchstickcal.model.unknowns import clock_refinements

    refine: Any = option
    if option is None:
        refine = None if config.refine else "auto"
    elif option != "auto":
        refine = [] if option == "none" else option.split(",")
    if no_sync and refine is not None and clock_refinements() & set(refine):
        raise CalibrationError(
            "clocks are to be found and to be taken as told",
            where="--no-sync",
            got=f"--refine {option}",
            expected="one of the two",
        )
    return (replace(config, synchronise=False) if no_sync else config), refine


def _evaluate(options: argparse.Namespace) -> int:
    """Cameras are matched by name where both sides have the same names, else by their order."""
    from torchstickcal.io import Truth
    from torchstickcal.metrics import pose_errors

    names, estimate = _poses(options.calibration)
    truth_names, truth = _poses(options.truth)
    if len(names) != len(truth_names):
        raise CalibrationError(
            "the number of cameras differs",
            where=str(options.truth),
            got=f"{len(truth_names)} cameras",
            expected=f"{len(names)} as in {options.calibration}",
        )
    if set(names) == set(truth_names):
        order = [truth_names.index(name) for name in names]
        truth = Truth(truth.rotations[order], truth.translations[order])
    errors = pose_errors(estimate.rotations, estimate.translations, truth.rotations, truth.translations)
    result = _errors_by_camera(names, errors)
    _print_errors(result)
    _write_json(options.json, result)
    return EXIT_DONE


def _benchmark(options: argparse.Namespace) -> int:
    from torchstickcal.benchmark import score_sequence, sources, summarise
    from torchstickcal.config import load_config

    if options.out is not None:
        return _measure(options)
    _use_threads(options.threads)
    config = load_config(options.config)
    cases = sources(options.place, options.count)
    width = max(len(case.name) for case in cases)
    scores = []
    print(f"{'session':{width}}  rotation (deg)  translation (mm)  time (ms)  status")
    for case in cases:
        score = score_sequence(case, config)
        if score is None:
            print(f"{case.name} passed over: it carries no truth", file=sys.stderr)
            continue
        scores.append(score)
        rotation = "-" if score.rotation_deg is None else f"{score.rotation_deg:.5f}"
        translation = "-" if score.translation_m is None else f"{1000 * score.translation_m:.3f}"
        print(
            f"{score.name:{width}}  {rotation:>14}  {translation:>16}  {1000 * score.seconds:9.0f}  {score.status}", flush=True
        )
    summary = summarise(scores)
    if summary["mean_rotation_deg"] is not None:
        mean = f"{summary['mean_rotation_deg']:14.5f}  {1000 * summary['mean_translation_m']:16.3f}"
        print(f"{'mean':{width}}  {mean}  {'':9}  {summary['converged']} of {len(scores)} converged")
    _write_json(options.json, summary)
    return EXIT_DONE if scores and summary["converged"] == len(scores) else EXIT_NOT_CONVERGED


def _measure(options: argparse.Namespace) -> int:
    """All methods: rows, tables, figures and pages in a folder."""
    from torchstickcal.benchmark import METHODS, method, run_benchmark, sources, write_results

    names = options.methods.split(",") if options.methods else list(METHODS)
    for name in names:
        method(name)
    cases = sources(options.place, options.count)
    rows = run_benchmark(Path(options.place).name, cases, names, options.out, options.jobs, _progress_bar)
    if not rows:
        raise CalibrationError("no session with truth", where="benchmark", got=options.place, expected="sessions with truth")
    write_results(rows, options.out)
    print(f"{len(rows)} measurements, tables and figures in {options.out}")
    return EXIT_DONE


def _progress_bar(done: int, total: int, what: str) -> None:
    """On a terminal a bar in place, else a line for each tenth."""
    if sys.stderr.isatty():
        bar = "#" * (30 * done // total)
        print(f"\r[{bar:<30}] {done}/{total} {what:<60.60}", end="\n" if done == total else "", file=sys.stderr, flush=True)
    elif 10 * done // total > 10 * (done - 1) // total:
        print(f"{done}/{total} measured", file=sys.stderr, flush=True)


def _simulate(options: argparse.Namespace) -> int:
    from torchstickcal.simulate import session_specs, write_simulated
    from torchstickcal.simulate.render import write_film

    specs = session_specs(options.name, options.count, options.seed)
    options.out.mkdir(parents=True, exist_ok=True)
    width = max(len(spec.name) for spec in specs)
    for number, spec in enumerate(specs, 1):
        end = "\r" if sys.stderr.isatty() and number < len(specs) else "\n"
        print(f"{number}/{len(specs)} {spec.name:{width}}", end=end, file=sys.stderr, flush=True)
        session = spec.generate()
        write_simulated(options.out / f"{spec.name}.npz", session)
        if options.gif:
            write_film(options.out / f"{spec.name}.gif", session)
    print(f"{len(specs)} session{'s' if len(specs) > 1 else ''} in {options.out}")
    return EXIT_DONE


def _demo(options: argparse.Namespace) -> int:
    from torchstickcal.files import atomic_path
    from torchstickcal.io import write_npz
    from torchstickcal.metrics import pose_errors
    from torchstickcal.pipeline.calibrate import calibrate
    from torchstickcal.show.rig import rig_figure
    from torchstickcal.simulate import Noise, golf_session

    print(
        "A golf swing seen by 6 cameras: 240 frames, 1.5 px noise, 15 % of the keypoints missing, 5 % wrong by up to 150 px.\n"
    )
    observations, truth = golf_session(noise=Noise(sigma_px=1.5, missing=0.15, outliers=0.05), seed=options.seed)
    calibration = calibrate(observations, callback=_Progress(None))
    options.out.mkdir(parents=True, exist_ok=True)
    write_npz(options.out / "session.npz", observations, truth)
    _write(calibration, options.out, {"session": str(options.out / "session.npz"), "config": "default"})
    with atomic_path(options.out / "rig.png") as temporary:
        rig_figure(calibration).savefig(temporary, format="png", dpi=120)
    status = _show(calibration, options.out)
    print(f"picture in {options.out / 'rig.png'}\n\nAgainst the truth:")
    errors = pose_errors(calibration.rotations, calibration.translations, truth.rotations, truth.translations)
    _print_errors(_errors_by_camera(calibration.camera_names, errors))
    return status


class _Progress:
    """Shows the iterations on a terminal's last line; passes everything on to another callback."""

    def __init__(self, following: Callback | None) -> None:
        self._following = following
        self._live = sys.stderr.isatty()

    def on_iteration(self, record: IterationRecord) -> None:
        if self._live:
            line = f"{record.stage}: iteration {record.iteration}, cost {record.cost:.6g}"
            print(f"\r{line:<70}", end="", file=sys.stderr, flush=True)
        if self._following:
            self._following.on_iteration(record)

    def on_end(self, calibration: Calibration) -> None:
        if self._live:
            print(f"\r{'':<70}\r", end="", file=sys.stderr, flush=True)
        if self._following:
            self._following.on_end(calibration)


def _use_threads(count: int) -> None:
    import torch

    if count < 1:
        raise CalibrationError("no threads to compute with", where="--threads", got=count, expected="1 or more")
    torch.set_num_threads(count)


def _monitor(log_dir: Path | None) -> Callback | None:
    if log_dir is None:
        return None
    from torchstickcal.show.tensorboard import TensorBoardMonitor

    return TensorBoardMonitor(log_dir)


def _write(calibration: Calibration, folder: Path, provenance: dict[str, str]) -> None:
    from torchstickcal.io import write_camera_toml
    from torchstickcal.show.report import summary

    folder.mkdir(parents=True, exist_ok=True)
    write_camera_toml(folder / CAMERAS_FILE, calibration)
    calibration.save(folder / POINTS_FILE)
    _write_json(folder / REPORT_FILE, provenance | summary(calibration))


def _show(calibration: Calibration, folder: Path) -> int:
    from torchstickcal.show.report import table

    print(table(calibration))
    print(f"\n{CAMERAS_FILE}, {POINTS_FILE}, {REPORT_FILE} in {folder}")
    if calibration.converged:
        return EXIT_DONE
    print(f"not converged: {calibration.status}", file=sys.stderr)
    return EXIT_NOT_CONVERGED


def _poses(path: Path) -> tuple[tuple[str, ...], Truth]:
    """Camera names and poses of a folder or file of cameras, or of a session that carries them."""
    from torchstickcal.errors import FileFormatError
    from torchstickcal.io import Truth, read_camera_toml, read_session

    file = path / CAMERAS_FILE if path.is_dir() else path
    if file.suffix == ".toml":
        rig = read_camera_toml(file)
        return rig.names, Truth(rig.rotations, rig.translations)
    observations, truth = read_session(file)
    if truth is None:
        raise FileFormatError(
            "a session without truth", where=str(file), got="no rotation", expected="rotation and translation"
        )
    return tuple(map(observations.camera_label, range(observations.num_cameras))), truth


def _errors_by_camera(names: Sequence[str], errors: PoseErrors) -> dict[str, Any]:
    """The errors as JSON can hold them."""
    rows = zip(names, errors.rotation_deg.tolist(), errors.translation_m.tolist(), strict=True)
    return {
        "mean_rotation_deg": errors.mean_rotation_deg,
        "mean_translation_m": errors.mean_translation_m,
        "cameras": [{"name": n, "rotation_deg": rotation, "translation_m": translation} for n, rotation, translation in rows],
    }


def _print_errors(errors: dict[str, Any]) -> None:
    width = max(6, *(len(camera["name"]) for camera in errors["cameras"]))
    print(f"{'camera':{width}}  rotation (deg)  translation (mm)")
    mean = {"name": "mean", "rotation_deg": errors["mean_rotation_deg"], "translation_m": errors["mean_translation_m"]}
    for camera in [*errors["cameras"], mean]:
        print(f"{camera['name']:{width}}  {camera['rotation_deg']:14.5f}  {1000 * camera['translation_m']:16.3f}")


def _write_json(path: Path | None, content: dict[str, Any]) -> None:
    from torchstickcal.files import atomic_path

    if path is not None:
        with atomic_path(path) as temporary:
            temporary.write_text(json.dumps(content, indent=2) + "\n", "utf-8")
