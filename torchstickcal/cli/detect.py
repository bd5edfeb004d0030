"""The command `detect`."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from torchstickcal.cli.outputs import EXIT_DONE

VIDEO_SUFFIXES = (".avi", ".m4v", ".mkv", ".mov", ".mp4", ".mpg", ".mpeg", ".mts", ".webm", ".wmv")


def add_detect(commands: Any) -> None:
    command = commands.add_parser(
        "detect",
        help="find keypoints of the athlete and of the stick in videos",
        description="Find keypoints of the athlete and of the marked ends of the stick in videos, one for each camera.",
    )
    add = command.add_argument
    add("videos", metavar="VIDEO", type=Path, nargs="+", help="a video for each camera, called after the camera")
    add(
        "--out",
        metavar="DIR",
        type=Path,
        required=True,
        help="folder for the keypoints; a video that is done is not read again",
    )
    add("--skeleton", metavar="NAME|FILE.toml", help="names of the body's points (default: by their number)")
    add_detectors(command)
    add("--plugin", action="append", default=[], help=argparse.SUPPRESS)
    command.set_defaults(run=detect_videos)


def add_detectors(command: argparse.ArgumentParser) -> None:
    """What is looked for in videos."""
    add = command.add_argument
    add("--weights", metavar="FILE.onnx", type=Path, help="videos: network for the body's keypoints, of the kind of RTMPose")
    add(
        "--rtmlib",
        metavar="MODE",
        choices=("lightweight", "balanced", "performance"),
        help="videos: use RTMLib with its own weights, which it loads when first used: lightweight, balanced or performance",
    )
    add(
        "--tape",
        metavar="A,B",
        help="videos: colours of tape or balls on the stick's ends, the end in the hands first: red, orange, yellow, green, "
        "cyan, blue, magenta; the cameras must stand still",
    )


def detect_videos(options: argparse.Namespace) -> int:
    print("\n".join(found_in_videos(options.videos, options.out, options)))
    print(f"\nkeypoints.csv, videos.json in {options.out}")
    return EXIT_DONE


def session_in(paths: Sequence[Path], options: argparse.Namespace) -> Sequence[Path]:
    """Paths of a session as they are, or the folder with what is found in them if they are videos.

    The folder is beside that of the results and is called after it: ``results-keypoints`` for ``results``.

    Raises:
        CalibrationError: for videos among other files, for options for videos without a video, or as detecting raises.
    """
    from torchstickcal.errors import CalibrationError

    videos = [path for path in paths if path.suffix.lower() in VIDEO_SUFFIXES and not path.is_dir()]
    asked = [f"--{name}" for name in ("weights", "rtmlib", "tape") if getattr(options, name) is not None]
    if not videos and not asked:
        return paths
    if len(videos) < len(paths):
        other = next(path for path in paths if path not in videos)
        expected = f"one video for each camera ({', '.join(VIDEO_SUFFIXES)})"
        raise CalibrationError(
            "not a video", where="SESSION", got=str(other), expected=expected,
            remedy=f"Leave {' and '.join(asked)} out to calibrate keypoints." if asked else "Give videos alone.",
        )  # fmt: skip
    folder = options.out.with_name(f"{options.out.resolve().name}-keypoints")
    for note in found_in_videos(videos, folder, options):
        print(f"note: {note}", file=sys.stderr)
    return [folder]


def found_in_videos(videos: Sequence[Path], folder: Path, options: argparse.Namespace) -> list[str]:
    """Find keypoints and write them into a folder; sentences about what was found."""
    from torchstickcal.errors import CalibrationError
    from torchstickcal.files import try_writing
    from torchstickcal.video import RtmlibModel, SimccModel, detect

    if options.weights is not None and options.rtmlib is not None:
        raise CalibrationError("two detectors", where="--rtmlib", got="--weights too", expected="one of the two")
    make_body = None
    if options.weights is not None:
        SimccModel(options.weights)  # raises before a video is read
        make_body = lambda: SimccModel(options.weights)  # noqa: E731
    if options.rtmlib is not None:
        make_body = lambda: RtmlibModel(options.rtmlib)  # noqa: E731
    tapes = [name.strip().lower() for name in options.tape.split(",")] if options.tape else []
    try_writing(folder, ["keypoints.csv", "videos.json"])
    settings = {"weights": None if options.weights is None else str(options.weights), "rtmlib": options.rtmlib}
    return detect(videos, folder, make_body, tapes, options.skeleton, _progress(), settings)


def _progress() -> Any:
    """Shows the frames on the last line of a terminal."""
    if not sys.stderr.isatty():
        return None

    def show(camera: str, done: int, frames: int) -> None:
        end = "\n" if done == frames else ""
        print(f"\r{camera}: frame {done}{f' of {frames}' if frames else ''}", end=end, file=sys.stderr, flush=True)

    return show
