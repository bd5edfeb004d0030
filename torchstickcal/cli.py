"""The command line. What needs torch is imported when a command runs, so that help and usage errors appear at once."""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import inspect
import json
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchstickcal.errors import CalibrationError

if TYPE_CHECKING:
    from torchstickcal.benchmark import SequenceScore
    from torchstickcal.config import Config
    from torchstickcal.io import Truth, Writer
    from torchstickcal.metrics import PoseErrors
    from torchstickcal.observations import Observations
    from torchstickcal.pipeline.calibrate import Callback
    from torchstickcal.result import Calibration
    from torchstickcal.solvers import IterationRecord

EXIT_DONE, EXIT_NOT_CONVERGED, EXIT_UNUSABLE = 0, 1, 2
CAMERAS_FORMAT = "pose2sim"
CAMERAS_FILE, POINTS_FILE, REPORT_FILE = "calibration.toml", "points.npz", "report.json"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command.

    Args:
        arguments: of the command line; None for those of the process.

    Returns:
        The exit status: 0, 1 if a calibration did not converge, 2 if the input cannot be used.
    """
    options = _parser().parse_args(arguments)
    try:
        _import_plugins(options.plugin)
        return options.run(options)
    except (CalibrationError, OSError) as error:
        print("error:", " ".join(str(error).splitlines()), file=sys.stderr)
        return EXIT_UNUSABLE


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="torchstickcal",
        description="Calibrate a camera rig, in metres, from an athlete's keypoints and a stick of known length.",
    )
    commands = parser.add_subparsers(metavar="COMMAND", required=True)
    for add in (_add_calibrate, _add_evaluate, _add_benchmark, _add_simulate, _add_demo, _add_list):
        add(commands)
    return parser


def _add_calibrate(commands: Any) -> None:
    command = commands.add_parser("calibrate", help="calibrate a session", description="Calibrate a session.")
    command.add_argument("session", metavar="SESSION", type=Path, help="file or folder of a session")
    _add_out(command, "results")
    _add_format(command, "SESSION")
    _add_config(command)
    command.add_argument(
        "--refine",
        metavar="A,B|auto|none",
        help="what to estimate of the cameras beside their poses: names from `torchstickcal list unknowns`, `none`, or `auto` "
        "for what the keypoints contradict (default: as in the configuration, else auto)",
    )
    command.add_argument("--no-sync", action="store_true", help="do not estimate clocks: the cameras are synchronised")
    command.add_argument(
        "--stick-length", metavar="M", type=float, help="length of the stick in metres (default: the session's)"
    )
    command.add_argument(
        "--stick-sigma",
        metavar="M",
        type=float,
        help="standard deviation of that length in metres: how well it is known (default: the session's)",
    )
    command.add_argument(
        "--export", metavar="A,B", help="write the calibration also in these formats, from `torchstickcal list formats`"
    )
    command.add_argument("--tensorboard", metavar="DIR", type=Path, help="write a TensorBoard log of the calibration")
    _add_plugin(command)
    command.set_defaults(run=_calibrate)


def _add_evaluate(commands: Any) -> None:
    command = commands.add_parser(
        "evaluate", help="compare a calibration with the truth", description="Compare a calibration with the truth."
    )
    command.add_argument("calibration", metavar="DIR", type=Path, help="folder that `calibrate` wrote, or a calibration file")
    command.add_argument(
        "truth", metavar="TRUTH", type=Path, help="a session that holds its truth, or a calibration as for DIR"
    )
    _add_format(command, "TRUTH, if it is a session")
    command.add_argument("--json", metavar="FILE", type=Path, help="write the errors as JSON")
    _add_plugin(command)
    command.set_defaults(run=_evaluate)


def _add_benchmark(commands: Any) -> None:
    command = commands.add_parser(
        "benchmark",
        help="measure errors on sessions with truth",
        description="Measure the errors of a configuration on sessions with truth, or with --out those of all methods, with "
        "tables and figures.",
    )
    command.add_argument(
        "place", metavar="DIR|PRESET", help="folder of sessions, or a preset from `torchstickcal list presets`"
    )
    command.add_argument("--count", metavar="N", type=int, help="only the first N sessions")
    command.add_argument("--json", metavar="FILE", type=Path, help="write the errors as JSON (without --out)")
    _add_config(command)
    command.add_argument("--out", metavar="DIR", type=Path, help="folder for the results; what it holds is not measured again")
    command.add_argument(
        "--methods",
        metavar="A,B",
        help="with --out: names from `torchstickcal list configs` and `torchstickcal list baselines` (default: all)",
    )
    command.add_argument("--jobs", metavar="N", type=int, default=1, help="with --out: number of processes (default: 1)")
    _add_plugin(command)
    command.set_defaults(run=_benchmark)


def _add_simulate(commands: Any) -> None:
    command = commands.add_parser(
        "simulate",
        help="generate sessions with truth",
        description="Generate sessions with truth: a preset, or a sport seen by six cameras.",
    )
    command.add_argument(
        "name", metavar="PRESET|SPORT", help="name from `torchstickcal list presets` or `torchstickcal list sports`"
    )
    _add_out(command, "sessions")
    command.add_argument("--count", metavar="N", type=int, help="number of sessions (default: all of a preset, one of a sport)")
    command.add_argument("--seed", metavar="N", type=int, default=0, help="added to the seeds of the sessions (default: 0)")
    command.add_argument("--gif", action="store_true", help="also write an animation of each session")
    _add_plugin(command)
    command.set_defaults(run=_simulate)


def _add_demo(commands: Any) -> None:
    command = commands.add_parser(
        "demo",
        help="calibrate a simulated golf swing",
        description="Simulate a golf swing seen by six cameras, with noise, gaps and outliers; calibrate it; show the result.",
    )
    command.add_argument("--out", metavar="DIR", type=Path, default=Path("demo"), help="folder for the results (default: demo)")
    command.add_argument("--seed", metavar="N", type=int, default=0, help="seed of all random numbers (default: 0)")
    command.set_defaults(run=_demo, plugin=())


def _add_list(commands: Any) -> None:
    command = commands.add_parser(
        "list",
        help="list configurations, file formats, losses and whatever else has a name",
        description="List what the other commands take by name.",
    )
    command.add_argument("kind", nargs="?", choices=list(_LISTS), help="what to list (default: everything)")
    _add_plugin(command)
    command.set_defaults(run=_list)


def _add_out(command: argparse.ArgumentParser, what: str) -> None:
    help = f"folder for the {what}; created if it does not exist"
    command.add_argument("--out", metavar="DIR", type=Path, required=True, help=help)


def _add_config(command: argparse.ArgumentParser) -> None:
    help = "name from `torchstickcal list configs`, or a TOML file (default: default)"
    command.add_argument("--config", metavar="NAME|FILE", default="default", help=help)


def _add_format(command: argparse.ArgumentParser, what: str) -> None:
    help = f"format of {what}: name from `torchstickcal list formats` (default: recognised by the content)"
    command.add_argument("--format", metavar="NAME", help=help)


def _add_plugin(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--plugin",
        metavar="MODULE|FILE.py",
        action="append",
        default=[],
        help="a Python module of yours that registers losses, camera unknowns, file formats, sports or baselines; may be given "
        "several times. It is a program that is run with your rights: use only what you trust",
    )


def _import_plugins(plugins: Sequence[str]) -> None:
    """Import modules by their dotted names, or from ``.py`` files.

    Raises:
        CalibrationError: if one cannot be imported.
    """
    for plugin in plugins:
        try:
            if plugin.endswith(".py"):
                _import_file(Path(plugin))
            else:
                importlib.import_module(plugin)
        except (Exception, SystemExit) as error:
            missing = isinstance(error, ModuleNotFoundError)
            raise CalibrationError(
                "a plugin cannot be imported",
                where=f"--plugin {plugin}",
                got=f"{type(error).__name__}: {error}".rstrip("."),
                expected="a Python module that can be imported, or a .py file",
                remedy="Modules are found if they are installed or in a folder of PYTHONPATH." if missing else "",
            ) from error


def _import_file(path: Path) -> None:
    """Import a file as a module, once in a process."""
    name = f"torchstickcal_plugin_{path.stem}"
    if name in sys.modules and sys.modules[name].__file__ == str(path.resolve()):
        return
    spec = importlib.util.spec_from_file_location(name, path.resolve())
    assert spec is not None
    assert spec.loader is not None
    sys.modules[name] = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(sys.modules[name])
    except BaseException:
        del sys.modules[name]
        raise


def _calibrate(options: argparse.Namespace) -> int:
    from torchstickcal.config import load_config
    from torchstickcal.io import read_session
    from torchstickcal.pipeline.calibrate import calibrate

    config, refine = _refining(load_config(options.config), options.refine, options.no_sync)
    writers = _writers(options.export)
    observations, _ = read_session(options.session, options.format)
    observations = _with_stick(observations, options.stick_length, options.stick_sigma)
    calibration = calibrate(observations, config, _Progress(_monitor(options.tensorboard)), refine)
    _write(calibration, options.out, writers, {"session": str(options.session), "config": options.config})
    return _show(calibration, options.out, writers)


def _refining(config: Config, option: str | None, no_sync: bool) -> tuple[Config, Any]:
    """The configuration, and what to refine instead of what it says; None to do as it says.

    Raises:
        CalibrationError: for an unknown name, or if clocks are to be refined despite ``--no-sync``.
    """
    from torchstickcal.model.unknowns import REFINEMENTS, clock_refinements

    refine: Any = option
    if option is None:
        refine = None if config.refine else "auto"
    elif option != "auto":
        refine = [] if option == "none" else option.split(",")
        for name in refine:
            REFINEMENTS[name]  # raises for an unknown name
    if no_sync and refine is not None and clock_refinements() & set(refine):
        raise CalibrationError(
            "clocks cannot be refined if the cameras are synchronised",
            where="--no-sync",
            got=f"--refine {option}",
            expected="one of the two",
        )
    return (replace(config, synchronise=False) if no_sync else config), refine


def _with_stick(observations: Observations, length_m: float | None, sigma_m: float | None) -> Observations:
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


def _writers(names: str | None) -> dict[str, Writer]:
    """The writers of the camera file and of further formats, by the names of the files that they write.

    Raises:
        CalibrationError: for an unknown format, or if two files have the same name.
    """
    from torchstickcal.io import CALIBRATION_WRITERS

    writers: dict[str, Writer] = {}
    further = names.split(",") if names else []
    for name in dict.fromkeys([CAMERAS_FORMAT, *further]):
        writer = CALIBRATION_WRITERS[name]
        if writer.file_name in {*writers, POINTS_FILE, REPORT_FILE}:
            raise CalibrationError(
                "two files of one name", where=f"--export {name}", got=writer.file_name, expected="another file name"
            )
        writers[writer.file_name] = writer
    return writers


def _evaluate(options: argparse.Namespace) -> int:
    """Cameras are matched by name if both sides have the same names, else by their order."""
    from torchstickcal.io import Truth
    from torchstickcal.metrics import pose_errors

    names, estimate = _poses(options.calibration, None)
    truth_names, truth = _poses(options.truth, options.format)
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


def _poses(path: Path, format: str | None) -> tuple[tuple[str, ...], Truth]:
    """Names and poses of the cameras of a calibration, or of a session that holds its truth.

    Args:
        path: a file, or a folder that holds a camera file.
        format: of the session; None if the content decides.
    """
    from torchstickcal.errors import FileFormatError
    from torchstickcal.io import CALIBRATION_READERS, SESSION_READERS, Rig, Truth, find_reader

    if format is None and (path / CAMERAS_FILE).is_file():
        path = path / CAMERAS_FILE
    reader = SESSION_READERS[format] if format else find_reader(path, CALIBRATION_READERS, SESSION_READERS)
    content = reader.read(path)
    if isinstance(content, Rig):
        return content.names, Truth(content.rotations, content.translations)
    observations, truth = content
    if truth is None:
        raise FileFormatError("a session without truth", where=str(path), got="no poses", expected="the poses of its cameras")
    return observations.camera_labels, truth


def _benchmark(options: argparse.Namespace) -> int:
    return _score(options) if options.out is None else _measure(options)


def _score(options: argparse.Namespace) -> int:
    """The errors of one configuration."""
    from torchstickcal.benchmark import score_sequence, sources, summarise
    from torchstickcal.config import load_config

    config = load_config(options.config)
    cases = sources(options.place, options.count)
    width = max(len(case.name) for case in cases)
    scores = []
    print(f"{'session':{width}}  rotation (deg)  translation (mm)  time (ms)  status")
    for case in cases:
        score = score_sequence(case, config)
        if score is None:
            print(f"{case.name} skipped: it holds no truth", file=sys.stderr)
            continue
        scores.append(score)
        print(_score_line(score, width), flush=True)
    summary = summarise(scores)
    if summary["mean_rotation_deg"] is not None:
        mean = f"{summary['mean_rotation_deg']:14.5f}  {1000 * summary['mean_translation_m']:16.3f}"
        print(f"{'mean':{width}}  {mean}  {'':9}  {summary['converged']} of {len(scores)} converged")
    _write_json(options.json, summary)
    return EXIT_DONE if scores and summary["converged"] == len(scores) else EXIT_NOT_CONVERGED


def _score_line(score: SequenceScore, width: int) -> str:
    rotation = "-" if score.rotation_deg is None else f"{score.rotation_deg:.5f}"
    translation = "-" if score.translation_m is None else f"{1000 * score.translation_m:.3f}"
    return f"{score.name:{width}}  {rotation:>14}  {translation:>16}  {1000 * score.seconds:9.0f}  {score.status}"


def _measure(options: argparse.Namespace) -> int:
    """The errors of all methods: a folder with measurements, tables, figures and pages."""
    from torchstickcal.benchmark import METHODS, run_benchmark, sources, write_results

    names = options.methods.split(",") if options.methods else list(METHODS)
    cases = sources(options.place, options.count)
    prepare = partial(_import_plugins, options.plugin)
    rows = run_benchmark(Path(options.place).name, cases, names, options.out, options.jobs, _progress_bar, prepare)
    if not rows:
        raise CalibrationError("no session with truth", where="benchmark", got=options.place, expected="sessions with truth")
    write_results(rows, options.out)
    print(f"{len(rows)} measurements, tables and figures in {options.out}")
    return EXIT_DONE


def _progress_bar(done: int, total: int, what: str) -> None:
    """A bar in a terminal; elsewhere a line after each tenth of the measurements."""
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
    writers = _writers(None)
    _write(calibration, options.out, writers, {"session": str(options.out / "session.npz"), "config": "default"})
    with atomic_path(options.out / "rig.png") as temporary:
        rig_figure(calibration).savefig(temporary, format="png", dpi=120)
    status = _show(calibration, options.out, writers)
    print(f"picture in {options.out / 'rig.png'}\n\nAgainst the truth:")
    errors = pose_errors(calibration.rotations, calibration.translations, truth.rotations, truth.translations)
    _print_errors(_errors_by_camera(calibration.camera_names, errors))
    return status


def _list(options: argparse.Namespace) -> int:
    print("\n\n".join(map(_section, [options.kind] if options.kind else _LISTS)))
    return EXIT_DONE


def _section(kind: str) -> str:
    title, entries = _LISTS[kind]
    rows = list(entries())
    width = max(len(name) for name, _ in rows)
    return "\n".join([f"{kind}: {title}", *(f"  {name:{width}}  {what}" for name, what in rows)])


def _losses() -> Iterator[tuple[str, str]]:
    from torchstickcal.losses import LOSSES

    for name, settings in LOSSES.items():
        yield name, f"{_first_sentence(settings.__doc__)}; settings: {', '.join(inspect.signature(settings).parameters)}"


def _unknowns() -> Iterator[tuple[str, str]]:
    from torchstickcal.model.unknowns import REFINEMENTS

    for name, (unknown, sharing) in REFINEMENTS.items():
        unit = f" ({unknown.unit})" if unknown.unit else ""
        yield name, f"{unknown.label}{unit}; {sharing.value}"


def _formats() -> Iterator[tuple[str, str]]:
    from torchstickcal.io import CALIBRATION_READERS, CALIBRATION_WRITERS, SESSION_READERS

    for name, reader in SESSION_READERS.items():
        yield name, f"reads sessions: {reader.description}"
    for name, reader in CALIBRATION_READERS.items():
        yield name, f"reads calibrations: {reader.description}"
    for name, writer in CALIBRATION_WRITERS.items():
        yield name, f"writes {writer.file_name}: {writer.description}"


def _sports() -> Iterator[tuple[str, str]]:
    from torchstickcal.simulate import SPORTS

    for name, action in SPORTS.items():
        start, end = action.stick_names
        yield name, f"stick of {action.stick_m:g} m from {start} to {end}; one repetition takes {action.period_s:g} s"


def _presets() -> Iterator[tuple[str, str]]:
    from torchstickcal.simulate import PRESETS, preset

    for name in PRESETS:
        specs = preset(name)
        sports, cameras = dict.fromkeys(spec.sport for spec in specs), sorted({spec.cameras for spec in specs})
        yield name, f"{len(specs)} sessions of {', '.join(sports)}; number of cameras: {', '.join(map(str, cameras))}"


def _baselines() -> Iterator[tuple[str, str]]:
    from torchstickcal.benchmark import BASELINES, METHODS
    from torchstickcal.config import config_names

    for name in [name for name in METHODS if name not in config_names()]:
        title = METHODS[name].title.replace("`", "")
        baseline = BASELINES.get(name)
        needs = f"; needs {', '.join(baseline.needs)}" if baseline and baseline.needs else ""
        yield name, f"{title}: {_first_sentence(baseline.estimate.__doc__)}{needs}" if baseline else title


def _configs() -> Iterator[tuple[str, str]]:
    from importlib import resources

    from torchstickcal.config import config_names

    for name in config_names():
        text = (resources.files("torchstickcal.configs") / f"{name}.toml").read_text("utf-8")
        yield name, _first_sentence(re.sub(r"(?m)^# ?", "", text.partition("\n\n")[0]))


_LISTS: dict[str, tuple[str, Callable[[], Iterator[tuple[str, str]]]]] = {
    "losses": ("keys in the table of a stage of a configuration", _losses),
    "unknowns": ("for --refine, and the key `refine` of a configuration", _unknowns),
    "formats": ("files that can be read (--format takes those of sessions) and written (--export)", _formats),
    "sports": ("for simulate", _sports),
    "presets": ("sets of sessions, for simulate and benchmark", _presets),
    "baselines": ("other methods of calibration, for benchmark --methods", _baselines),
    "configs": ("for --config, and benchmark --methods", _configs),
}
"""For each kind of things that have names: what they are for, and their names with one line each."""


def _first_sentence(text: str | None) -> str:
    """The first sentence of a docstring or a comment, without markup and full stop."""
    sentence = re.split(r"\.(?=\s|$)|\n\s*\n", (text or "").strip(), maxsplit=1)[0]
    return " ".join(re.sub(r":\w+:(?=`)|`", "", sentence).split())


class _Progress:
    """Shows the iterations on the last line of a terminal, and passes all calls on to another callback."""

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


def _monitor(log_dir: Path | None) -> Callback | None:
    if log_dir is None:
        return None
    from torchstickcal.show.tensorboard import TensorBoardMonitor

    return TensorBoardMonitor(log_dir)


def _write(calibration: Calibration, folder: Path, writers: dict[str, Writer], provenance: dict[str, str]) -> None:
    from torchstickcal.show.report import summary

    folder.mkdir(parents=True, exist_ok=True)
    for file_name, writer in writers.items():
        writer.function(folder / file_name, calibration)
    calibration.save(folder / POINTS_FILE)
    _write_json(folder / REPORT_FILE, provenance | summary(calibration))


def _show(calibration: Calibration, folder: Path, writers: dict[str, Writer]) -> int:
    from torchstickcal.show.report import table

    print(table(calibration))
    print(f"\n{', '.join([*writers, POINTS_FILE, REPORT_FILE])} in {folder}")
    if calibration.converged:
        return EXIT_DONE
    print(f"not converged: {calibration.status}", file=sys.stderr)
    return EXIT_NOT_CONVERGED


def _errors_by_camera(names: Sequence[str], errors: PoseErrors) -> dict[str, Any]:
    """The errors as a dictionary that can be written as JSON."""
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
