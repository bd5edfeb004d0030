"""The command `detect`."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path

from torchstickcal.cli.console import note
from torchstickcal.cli.outputs import EXIT_DONE
from torchstickcal.cli.progress import Progress, progress

VIDEO_SUFFIXES = (".avi", ".m4v", ".mkv", ".mov", ".mp4", ".mpg", ".mpeg", ".mts", ".webm", ".wmv")


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
    asked = [
        f"--{name}" for name in ("weights", "rtmlib", "tape", "balls", "shaft") if getattr(options, name) not in (None, False)
    ]
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
    for sentence in found_in_videos(videos, folder, options):
        note(sentence)
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
    tapes, balls = (
        [name.strip().lower() for name in given.split(",")] if given else [] for given in (options.tape, options.balls)
    )
    try_writing(folder, ["keypoints.csv", "videos.json"])
    settings = {"weights": None if options.weights is None else str(options.weights), "rtmlib": options.rtmlib}
    with progress(options) as bar:
        shown = _shown(bar, [path.stem for path in videos])
        return detect(videos, folder, make_body, tapes, options.skeleton, shown, settings, options.shaft, balls)


def _shown(bar: Progress, cameras: list[str]) -> Callable[[str, int, int], None]:
    """Shows on a bar how far the videos of some cameras are read."""

    def show(camera: str, done: int, frames: int) -> None:
        share = min(done / frames, 1.0) if frames else 0.0
        bar(cameras.index(camera) + share, len(cameras), f"{camera}: frame {done}{f' of {frames}' if frames else ''}")

    return show
