"""The arguments of every command."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any, NoReturn

from torchstickcal.cli.analyse import analyse_session
from torchstickcal.cli.benchmark import benchmark
from torchstickcal.cli.calibrate import calibrate_session
from torchstickcal.cli.calibrate_many import calibrate_sessions
from torchstickcal.cli.check import check_session
from torchstickcal.cli.configuration import calibration_config, chosen_config, triangulation_config
from torchstickcal.cli.convert import convert
from torchstickcal.cli.detect import detect_videos
from torchstickcal.cli.evaluate import evaluate
from torchstickcal.cli.info import info
from torchstickcal.cli.listing import LISTS, list_names
from torchstickcal.cli.outputs import EXIT_DONE, EXIT_UNUSABLE
from torchstickcal.cli.report import report
from torchstickcal.cli.sample import sample
from torchstickcal.cli.simulate import demo, simulate
from torchstickcal.cli.triangulate import triangulate_session
from torchstickcal.files import POINTS_FILE


class _Parser(argparse.ArgumentParser):
    """A parser whose errors are one line, as those of the commands."""

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Parse arguments; ``--world points FILE`` is one option with one value, and ``--print-config`` needs no others."""
        if args is not None:
            args = _with_files_of_worlds(list(args))
            if "--print-config" in args and "--print-config" in self._option_string_actions:
                for action in self._actions:
                    action.required = False
        return super().parse_known_args(args, namespace)

    def error(self, message: str) -> NoReturn:
        self.exit(EXIT_UNUSABLE, f"error: {' '.join(message.split())}; `{self.prog} --help` shows what there is\n")


def _with_files_of_worlds(words: list[str]) -> list[str]:
    """Arguments in which the kind of a frame of the world and its file are one word."""
    joined: list[str] = []
    while words:
        joined.append(words.pop(0))
        if joined[-1] == "--world" and len(words) > 1 and words[0] in ("points", "calibration"):
            joined.append(f"{words.pop(0)} {words.pop(0)}")
    return joined


def _path(text: str) -> Path:
    if not text:
        raise argparse.ArgumentTypeError("an empty text is no path")
    return Path(text)


def parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="torchstickcal",
        description="Calibrate a camera rig, in metres, from an athlete's keypoints and a stick of known length.",
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="show the versions of torchstickcal, torch and Python")
    commands = parser.add_subparsers(metavar="COMMAND", required=True)
    for add in (
        _add_calibrate,
        _add_calibrate_many,
        _add_report,
        _add_check,
        _add_triangulate,
        _add_detect,
        _add_analyse,
        _add_info,
        _add_convert,
        _add_sample,
        _add_evaluate,
        _add_benchmark,
        _add_simulate,
        _add_demo,
        _add_list,
    ):
        add(commands)
    _add_common(parser, default=False)
    for command in commands.choices.values():
        _add_common(command, default=argparse.SUPPRESS)  # what was said before the command holds
    return parser


class _Version(argparse.Action):
    """Shows the versions, and ends."""

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> NoReturn:
        from torchstickcal.outputs import versions

        found = versions()
        print(f"torchstickcal {found['torchstickcal']} (torch {found['torch']}, Python {found['python']})")
        parser.exit(EXIT_DONE)


def _add_common(command: argparse.ArgumentParser, default: Any) -> None:
    """What every command has; it may also be said before the command."""
    add = command.add_argument
    add(
        "--quiet",
        action="store_true",
        default=default,
        help="show nothing but what goes wrong; the exit status says the rest: 0 done, 1 not converged, 2 unusable, 3 poor",
    )
    add("--debug", action="store_true", default=default, help="show where in the program an error was raised")


def _add_calibrate(commands: Any) -> None:
    command = commands.add_parser(
        "calibrate", help="calibrate a session", description="Calibrate a session: keypoints, or videos."
    )
    _add_session(command, "a session; or one video for each camera, with --rtmlib or --weights, --balls, --tape or --shaft")
    _add_out(command, "results")
    _add_format(command, "SESSION")
    _add_given(command)
    _add_config(command)
    _add_refining(command)
    _add_write(command, "the calibration and its points also")
    _add_world(command)
    command.add_argument(
        "--initial", metavar="FILE", type=_path, help="calibration from whose poses to start; they may be up to scale"
    )
    _add_units(command)
    command.add_argument("--tensorboard", metavar="DIR", type=_path, help="write a TensorBoard log of the calibration")
    _add_rrd(command)
    command.add_argument(
        "--split-moved", action="store_true", help="if a camera moved, calibrate again with its places before and after as two"
    )
    _add_detectors(command)
    _add_strict(command)
    command.add_argument("--verbose", action="store_true", help="show every table: lenses, clocks, sticks, points, stages")
    _add_plugin(command)
    command.set_defaults(run=calibrate_session, configuration=calibration_config)


def _add_report(commands: Any) -> None:
    command = commands.add_parser(
        "report",
        help="write report.html for results that `calibrate` wrote",
        description="Write report.html, a page that shows the result, into a folder that `calibrate` wrote.",
    )
    command.add_argument("folder", metavar="DIR", type=_path, help="folder that `calibrate` wrote")
    _add_rrd(command)
    command.set_defaults(run=report, plugin=())


def _add_check(commands: Any) -> None:
    command = commands.add_parser(
        "check",
        help="is an old calibration still valid for a new session of the same cameras?",
        description="Say whether an old calibration is still valid for a new session of the same cameras: which camera moved, "
        "how far, and since when. The exit status is 0 if it is valid, 3 if it is not.",
    )
    command.add_argument(
        "calibration", metavar="CALIBRATION", type=_path, help="folder that `calibrate` wrote, or a calibration file"
    )
    _add_session(command)
    _add_format(command, "SESSION")
    _add_given(command)
    command.add_argument("--json", metavar="FILE", type=_path, help="write the verdict and the findings as JSON")
    _add_units(command)
    _add_strict(command)
    _add_plugin(command)
    command.set_defaults(run=check_session)


def _add_calibrate_many(commands: Any) -> None:
    command = commands.add_parser(
        "calibrate-many",
        help="calibrate many sessions, on all processors or on a cluster",
        description="Calibrate many sessions. What the folder of results already has is not calibrated again.",
    )
    add = command.add_argument
    add(
        "sessions",
        metavar="FOLDER|LIST",
        type=_path,
        nargs="+",
        help="a folder of sessions; a list: a .txt file with a path on each line; or a session",
    )
    _add_out(command, "results")
    add("--jobs", metavar="N", type=int, help="number of processes (default: one for each processor)")
    add("--cluster", metavar="ADDRESS", help="address of a Dask scheduler that does the work, such as tcp://10.0.0.1:8786")
    add("--shard", metavar="I/N", help="only every N-th session, from the I-th on; other runs do the others")
    add(
        "--memory",
        metavar="SIZE",
        help="what all processes may need together, such as 8GB; with --cluster what one session may need (default: any)",
    )
    add("--retry", action="store_true", help="try sessions again that have failed before")
    _add_format(command, "all sessions")
    _add_given(command)
    _add_config(command)
    _add_refining(command)
    _add_write(command, "each calibration and its points also")
    _add_rrd(command, " for each session")
    add("--no-page", dest="page", action="store_false", help="do not write report.html for each session")
    _add_world(command)
    _add_units(command)
    _add_plugin(command)
    command.set_defaults(run=calibrate_sessions, configuration=calibration_config)


def _add_evaluate(commands: Any) -> None:
    command = commands.add_parser(
        "evaluate", help="compare a calibration with the truth", description="Compare a calibration with the truth."
    )
    command.add_argument("calibration", metavar="DIR", type=_path, help="folder that `calibrate` wrote, or a calibration file")
    command.add_argument(
        "truth", metavar="TRUTH", type=_path, help="a session that holds its truth, or a calibration as for DIR"
    )
    _add_format(command, "TRUTH, if it is a session")
    command.add_argument("--json", metavar="FILE", type=_path, help="write the errors as JSON")
    _add_units(command)
    _add_plugin(command)
    command.set_defaults(run=evaluate)


def _add_triangulate(commands: Any) -> None:
    command = commands.add_parser(
        "triangulate",
        help="find the points of a recording by cameras that were calibrated before",
        description="Find the points of a recording, in metres, by cameras that were calibrated before and not moved since.",
    )
    _add_session(command, "a recording")
    command.add_argument(
        "--calibration",
        metavar="DIR|FILE",
        type=_path,
        required=True,
        help="folder that `calibrate` wrote, or a calibration file of any format",
    )
    _add_out(command, "results")
    _add_format(command, "SESSION")
    _add_recording(command)
    _add_config(command)
    _add_no_sync(command)
    _add_write(command, "points: trc, c3d, csv, npz (default: npz);")
    command.add_argument(
        "--analyse",
        metavar="SPORT",
        help="also write joint angles, phases and figures of the swings, as `torchstickcal analyse` does, into `analysis` in "
        "DIR: golf, baseball, hockey, kendo or any",
    )
    _add_units(command)
    _add_plugin(command)
    command.set_defaults(run=triangulate_session, configuration=triangulation_config, intrinsics=None)


def _add_info(commands: Any) -> None:
    command = commands.add_parser(
        "info",
        help="show what a recording holds",
        description="Show what a recording holds: cameras, frames, which camera sees which point how often, and which pairs "
        "of cameras see the same.",
    )
    _add_session(command)
    _add_format(command, "SESSION")
    _add_given(command)
    command.add_argument("--json", metavar="FILE", type=_path, help="write the same as JSON")
    _add_plugin(command)
    command.set_defaults(run=info)


def _add_detect(commands: Any) -> None:
    command = commands.add_parser(
        "detect",
        help="find keypoints of the athlete and of the stick in videos",
        description="Find keypoints of the athlete and of the marked ends of the stick in videos, one for each camera.",
    )
    add = command.add_argument
    add("videos", metavar="VIDEO", type=_path, nargs="+", help="a video for each camera, called after the camera")
    help = "folder for the keypoints, created if it does not exist; a video that is done is not read again"
    add("--out", metavar="DIR", type=_path, required=True, help=help)
    add("--skeleton", metavar="NAME|FILE.toml", help="names of the body's points (default: by their number)")
    _add_detectors(command)
    _add_plugin(command)
    command.set_defaults(run=detect_videos)


def _add_detectors(command: argparse.ArgumentParser) -> None:
    """What is looked for in videos."""
    add = command.add_argument
    add("--weights", metavar="FILE.onnx", type=_path, help="videos: network for the body's keypoints, of the kind of RTMPose")
    add(
        "--rtmlib",
        metavar="MODE",
        choices=("lightweight", "balanced", "performance"),
        help="videos: use RTMLib with its own weights, which it loads when first used: lightweight, balanced or performance",
    )
    add(
        "--balls",
        metavar="A,B",
        help="videos: colours of two balls on the stick, that nearest to the hands first: red, orange, yellow, green, cyan, "
        "blue, magenta; the cameras must stand still",
    )
    add("--tape", metavar="A,B", help="videos: as --balls, for bands of tape around the stick")
    help = "videos: find a stick without marks as a line from the hands, by the body's keypoints; the cameras must stand still"
    add("--shaft", action="store_true", help=help)


def _add_analyse(commands: Any) -> None:
    command = commands.add_parser(
        "analyse",
        help="joint angles, stick kinematics and phases of the swings of a calibrated session",
        description="Joint angles, stick kinematics, phases and repeated swings of a calibrated session, with their "
        "standard deviations.",
    )
    add = command.add_argument
    add("calibration", metavar="DIR", type=_path, help=f"folder that `calibrate` wrote, or its {POINTS_FILE}")
    add("--out", metavar="DIR", type=_path, help="folder for tables and pictures (default: `analysis` in DIR)")
    add("--sport", default="any", help="golf, baseball, hockey, kendo or any: whose rule for the impact is used (default: any)")
    add("--fps", metavar="HZ", type=float, help="frames per second (default: the session's)")
    add(
        "--up",
        metavar=("X", "Y", "Z"),
        nargs=3,
        type=float,
        help="the vertical in the frame of the results (default: from the cameras, if they stand level, or from the frame)",
    )
    help = "write the points in these formats too: c3d (with the phases as events), trc, csv, npz"
    add("--write", metavar="A,B", help=help)
    add("--stick", metavar="N", type=int, default=0, help="which stick, counted from 0 (default: 0)")
    _add_plugin(command)
    command.set_defaults(run=analyse_session)


def _add_convert(commands: Any) -> None:
    command = commands.add_parser(
        "convert",
        help="write a calibration in the format of another program",
        description="Write a calibration, or the points of a folder of results, in the format of another program.",
    )
    command.add_argument(
        "source", metavar="SOURCE", type=_path, help="folder that `calibrate` wrote, or a calibration file of any format"
    )
    command.add_argument(
        "target", metavar="TARGET", type=_path, help="file to be written (a folder for COLMAP, EasyMocap, OpenCap and OpenCV)"
    )
    command.add_argument("--from", metavar="NAME", help="format of SOURCE (default: recognised by the content)")
    command.add_argument("--to", metavar="NAME", help="format of TARGET (default: by its name)")
    _add_units(command)
    _add_plugin(command)
    command.set_defaults(run=convert)


def _add_sample(commands: Any) -> None:
    command = commands.add_parser(
        "sample",
        help="write a small recording to try the other commands with",
        description="Write a small recording: a golf swing seen by four cameras, as OpenPose and Pose2Sim write it.",
    )
    command.add_argument("folder", metavar="FOLDER", type=_path, help="where to; created if it does not exist")
    command.set_defaults(run=sample, plugin=())


def _add_benchmark(commands: Any) -> None:
    command = commands.add_parser(
        "benchmark",
        help="measure errors on sessions with truth",
        description="Measure the errors of a configuration on sessions with truth, or with --out those of all methods, with "
        "tables and figures.",
    )
    command.add_argument(
        "place",
        metavar="DIR|PRESET|SPORT",
        help="folder of sessions, or name from `torchstickcal list presets` or `list sports`",
    )
    command.add_argument("--count", metavar="N", type=int, help="only the first N sessions")
    command.add_argument("--json", metavar="FILE", type=_path, help="write the errors as JSON (without --out)")
    _add_config(command)
    command.add_argument("--out", metavar="DIR", type=_path, help="folder for the results; what it holds is not measured again")
    command.add_argument(
        "--methods",
        metavar="A,B",
        help="with --out: names from `torchstickcal list configs` and `torchstickcal list baselines` (default: all)",
    )
    command.add_argument("--jobs", metavar="N", type=int, default=1, help="with --out: number of processes (default: 1)")
    command.add_argument(
        "--external",
        metavar="NAME=FOLDER",
        action="append",
        default=[],
        help="also measure poses that were computed elsewhere: a folder with a calibration for each session, called after the "
        "session, of any format; where its unit is not known, its size is fitted to the truth; may be given several times",
    )
    _add_units(command)
    _add_plugin(command)
    command.set_defaults(run=benchmark, configuration=chosen_config)


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
    command.set_defaults(run=simulate)


def _add_demo(commands: Any) -> None:
    command = commands.add_parser(
        "demo",
        help="calibrate a simulated golf swing",
        description="Simulate a golf swing seen by six cameras, with noise, gaps and outliers; calibrate it; show the result.",
    )
    command.add_argument(
        "--out", metavar="DIR", type=_path, default=Path("demo"), help="folder for the results (default: demo)"
    )
    command.add_argument("--seed", metavar="N", type=int, default=0, help="seed of all random numbers (default: 0)")
    command.set_defaults(run=demo, plugin=())


def _add_list(commands: Any) -> None:
    command = commands.add_parser(
        "list",
        help="list configurations, file formats, losses and whatever else has a name",
        description="List what the other commands take by name.",
    )
    command.add_argument("kind", nargs="?", choices=list(LISTS), help="what to list (default: everything)")
    _add_plugin(command)
    command.set_defaults(run=list_names)


def _add_out(command: argparse.ArgumentParser, what: str) -> None:
    help = f"folder for the {what}; created if it does not exist"
    command.add_argument("--out", metavar="DIR", type=_path, required=True, help=help)


def _add_rrd(command: argparse.ArgumentParser, of_each: str = "") -> None:
    help = f"write scene.rrd{of_each}, a recording for the Rerun viewer (needs torchstickcal[rerun])"
    command.add_argument("--rrd", action="store_true", help=help)


def _add_strict(command: argparse.ArgumentParser) -> None:
    command.add_argument("--strict", action="store_true", help="count the verdict `usable` as poor: exit status 3 instead of 0")


def _add_session(command: argparse.ArgumentParser, what: str = "a session") -> None:
    command.add_argument(
        "session", metavar="SESSION", type=_path, nargs="+", help=f"file or folder of {what}; or one file for each camera"
    )


def _add_no_sync(command: argparse.ArgumentParser) -> None:
    command.add_argument("--no-sync", action="store_true", help="do not estimate clocks: the cameras are synchronised")


def _add_config(command: argparse.ArgumentParser) -> None:
    help = "name from `torchstickcal list configs`, or a TOML file (default: default)"
    command.add_argument("--config", metavar="NAME|FILE", default="default", help=help)
    command.add_argument(
        "--set",
        metavar="KEY=VALUE",
        action="append",
        default=[],
        help="set one key of the configuration, as TOML, such as stages.metric.reject_sigmas=5; may be given several times",
    )
    command.add_argument(
        "--print-config", action="store_true", help="show the whole configuration as a file that --config takes, and end"
    )


def _add_format(command: argparse.ArgumentParser, what: str) -> None:
    help = f"format of {what}: name from `torchstickcal list formats` (default: recognised by the content)"
    command.add_argument("--format", metavar="NAME", help=help)


def _add_write(command: argparse.ArgumentParser, what: str) -> None:
    command.add_argument(
        "--write",
        metavar="A,B",
        help=f"write {what} in these formats, from `torchstickcal list formats`, or into files whose names say their formats",
    )
    command.add_argument("--export", dest="write", default=argparse.SUPPRESS, help=argparse.SUPPRESS)  # its earlier name


def _add_world(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--world",
        metavar="camera|athlete|floor|points FILE|calibration FILE",
        default="athlete",
        help="frame of the results: of the first camera; of the athlete: z up, the origin on the floor below the feet at "
        "first, x where the athlete faces; of the floor: z up, the origin below the first camera; of points at known places "
        "(.csv); of another calibration of the same cameras (default: athlete, where head and ankles are known)",
    )


def _add_units(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--units",
        choices=("m", "cm", "mm"),
        help="unit of length of a calibration file that does not say it (aniposelib, COLMAP)",
    )


def _add_given(command: argparse.ArgumentParser) -> None:
    """What the files of a detector do not say, of lenses too."""
    _add_recording(command)
    command.add_argument(
        "--intrinsics", metavar="FILE", type=_path, help="calibration of which the intrinsics are used (default: the session's)"
    )


def _add_recording(command: argparse.ArgumentParser) -> None:
    """What the files of a detector do not say."""
    add = command.add_argument
    add(
        "--stick",
        metavar=("START", "END", "METRES"),
        nargs=3,
        action="append",
        help="a stick: two points and the metres between them; may be given several times (default: the session's)",
    )
    add(
        "--stick-offset",
        metavar=("POINT", "METRES"),
        nargs=2,
        action="append",
        help="how far inside the stick this end of a --stick is detected: a grip that the hands hide; `unknown` to estimate "
        "it, where another stick sets the scale",
    )
    add(
        "--stick-points", metavar="PATH", type=_path, help="keypoints of the stick's ends, where they are in files of their own"
    )
    add("--turned", choices=("left", "right", "back"), help="images were turned so after the calibration: left, right, or back")
    add("--image-size", metavar=("WIDTH", "HEIGHT"), type=float, nargs=2, help="size of the images, pixels")
    add("--fps", metavar="HZ", type=float, help="frames per second")
    add("--skeleton", metavar="NAME|FILE.toml", help="names of the points (default: by their number)")
    add(
        "--person",
        metavar="largest|central|moving|stick|N",
        default="auto",
        help="who the athlete is, of several people (default: who is nearest to the stick of --stick-points, else the largest)",
    )


def _add_refining(command: argparse.ArgumentParser) -> None:
    """What is estimated, and how well the stick is known."""
    command.add_argument(
        "--refine",
        metavar="A,B|auto|none",
        help="what to estimate of the cameras beside their poses: names from `torchstickcal list unknowns`, `none`, or `auto` "
        "for what the keypoints contradict (default: as in the configuration, else auto)",
    )
    _add_no_sync(command)
    command.add_argument(
        "--height",
        metavar="M",
        type=float,
        help="body height of the athlete in metres, which sets the scale, to about 3 %%, where there is no stick",
    )
    command.add_argument(
        "--stick-length", metavar="M", type=float, help="length of the stick in metres (default: the session's)"
    )
    command.add_argument(
        "--stick-sigma",
        metavar="M",
        type=float,
        help="standard deviation of that length in metres: how well it is known (default: the session's)",
    )


def _add_plugin(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--plugin",
        metavar="MODULE|FILE.py",
        action="append",
        default=[],
        help="a Python module of yours that registers losses, camera unknowns, findings, file formats, sports or baselines; "
        "may be given several times. It is a program that is run with your rights: use only what you trust",
    )
