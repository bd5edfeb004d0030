"""The command `detect`."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

from torchstickcal.cli.outputs import EXIT_DONE


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
    add("--weights", metavar="FILE.onnx", type=Path, help="network for the body's keypoints, of the kind of RTMPose")
    add(
        "--rtmlib",
        metavar="MODE",
        choices=("lightweight", "balanced", "performance"),
        help="use RTMLib with its own weights, which it loads when first used: lightweight, balanced or performance",
    )
    add("--skeleton", metavar="NAME|FILE.toml", help="names of the body's points (default: by their number)")
    add(
        "--tape",
        metavar="A,B",
        help="colours of tape or balls on the stick's ends, the end in the hands first: red, orange, yellow, green, cyan, "
        "blue, magenta; the cameras must stand still",
    )
    add("--plugin", action="append", default=[], help=argparse.SUPPRESS)
    command.set_defaults(run=detect_videos)


def detect_videos(options: argparse.Namespace) -> int:
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
    try_writing(options.out, ["keypoints.csv", "videos.json"])
    settings = {"weights": None if options.weights is None else str(options.weights), "rtmlib": options.rtmlib}
    notes = detect(options.videos, options.out, make_body, tapes, options.skeleton, _progress(), settings)
    print("\n".join(notes))
    print(f"\nkeypoints.csv, videos.json in {options.out}")
    return EXIT_DONE


def _progress() -> Any:
    """Shows the frames on the last line of a terminal."""
    if not sys.stderr.isatty():
        return None

    def show(camera: str, done: int, frames: int) -> None:
        end = "\n" if done == frames else ""
        print(f"\r{camera}: frame {done}{f' of {frames}' if frames else ''}", end=end, file=sys.stderr, flush=True)

    return show
