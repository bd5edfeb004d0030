"""The command `detect`."""

from __future__ import annotations

import argparse
from collections.abc import Callable

from torchstickcal.cli.outputs import EXIT_DONE
from torchstickcal.cli.progress import Progress, progress


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
    with progress(options) as bar:
        shown = _shown(bar, [path.stem for path in options.videos])
        notes = detect(options.videos, options.out, make_body, tapes, options.skeleton, shown, settings)
    print("\n".join(notes))
    print(f"\nkeypoints.csv, videos.json in {options.out}")
    return EXIT_DONE


def _shown(bar: Progress, cameras: list[str]) -> Callable[[str, int, int], None]:
    """Shows on a bar how far the videos of some cameras are read."""

    def show(camera: str, done: int, frames: int) -> None:
        share = min(done / frames, 1.0) if frames else 0.0
        bar(cameras.index(camera) + share, len(cameras), f"{camera}: frame {done}{f' of {frames}' if frames else ''}")

    return show
