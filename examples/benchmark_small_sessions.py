"""What a small session costs: operations of torch by part, processor times, and many sessions on some processes.

python examples/benchmark_small_sessions.py --cameras 8 --frames 50
python examples/benchmark_small_sessions.py --cameras 6 --frames 50 --many 1000 --jobs 2
"""

from __future__ import annotations

import argparse
import collections
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Any

import torch
from torch.utils._python_dispatch import TorchDispatchMode

from torchstickcal import Observations, ResultFiles, calibrate, calibrate_many
from torchstickcal.simulate import Noise, SessionSpec
from torchstickcal.workers import on_worker

PARTS = {
    "calibrate": {
        "begin": "start of the rig, and the first points",
        "gauss_newton": "Gauss-Newton",
        "minimum_near": "Newton's method for cameras and noise",
        "decided": "noise, and which keypoints take part",
        "sigma_px": "noise, and which keypoints take part",
        "levels": "noise, and which keypoints take part",
        "_relabelling": "labels",
        "conclude": "covariances and result",
    },
    "verdict": {
        "suggestion": "what the keypoints say of lenses and clocks",
        "accepted": "acceptance test",
        "_motion_among": "cameras that moved",
        "unsynchronised": "clocks by the motion in the images",
    },
}
"""By the function that is called: the part of the work. An operation belongs to the innermost of them."""


class Counted(TorchDispatchMode):
    """Counts operations by part, in this thread."""

    def __init__(self, parts: dict[str, str]) -> None:
        super().__init__()
        self._parts, self.counts = parts, collections.Counter[str]()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.counts[self._part(sys._getframe(1))] += 1
        return func(*args, **(kwargs or {}))

    def _part(self, frame: FrameType | None) -> str:
        while frame is not None:
            if frame.f_code.co_name in self._parts and "torchstickcal" in frame.f_code.co_filename:
                return self._parts[frame.f_code.co_name]
            frame = frame.f_back
        return "the rest"


def session(seed: int, cameras: int, frames: int) -> Observations:
    """A golf swing with 2 px of noise."""
    return SessionSpec("golf", "golf", seed, cameras, frames, regimes=(Noise(2.0),)).generate().observations


def milliseconds(function: Callable[[], object]) -> float:
    """Processor time of a call."""
    began = time.process_time()
    function()
    return 1000 * (time.process_time() - began)


def one(cameras: int, frames: int, runs: int) -> None:
    """Operations and times of one session."""
    observations = session(3, cameras, frames)
    calibration = calibrate(observations)
    print(f"{cameras} cameras, {frames} frames, {observations.num_points} points; torch {torch.__version__}\n")
    for name, work in (("calibrate", lambda: calibrate(observations)), ("verdict", lambda: calibration.quality)):
        with Counted(PARTS[name]) as counted:
            work()
        print(f"{'operations of the ' + name if name == 'verdict' else 'operations of ' + name:46} {counted.counts.total():7}")
        for part, count in counted.counts.most_common():
            print(f"    {part:42} {count:7}")
    times: dict[str, list[float]] = collections.defaultdict(list)
    for _ in range(runs):
        found: list[Any] = []
        times["calibrate"].append(milliseconds(lambda found=found: found.append(calibrate(observations))))
        times["verdict"].append(milliseconds(lambda found=found: found[0].quality))
        for label, page in (("writing all files", True), ("writing all but the page", False)):
            with tempfile.TemporaryDirectory() as folder:
                write = partial(ResultFiles(page=page), found[0], Path(folder), {})
                times[label].append(milliseconds(write))
    print(f"\nprocessor time, median of {runs} runs")
    for label, values in times.items():
        print(f"    {label:42} {statistics.median(values):7.1f} ms")


def many(count: int, jobs: int, cameras: int, frames: int) -> None:
    """Many sessions, generated where they are calibrated."""
    import resource  # not on Windows

    began = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        sessions = [partial(session, seed, cameras, frames) for seed in range(count)]
        done = calibrate_many(sessions, out=folder, jobs=jobs)
    seconds, own = time.perf_counter() - began, resource.getrusage(resource.RUSAGE_SELF)
    theirs = resource.getrusage(resource.RUSAGE_CHILDREN)
    processor = theirs.ru_utime + theirs.ru_stime
    print(f"\n{count} sessions on {jobs} processes: {dict(collections.Counter(row.verdict for row in done.rows))}")
    print(f"    {1000 * processor / count:.0f} ms of processor time each, with the start of the processes")
    print(f"    {1000 * seconds / count:.0f} ms each by the clock")
    print(f"    {theirs.ru_maxrss / 1e3:.0f} MB at most in one of the processes, {own.ru_maxrss / 1e3:.0f} MB in this one")


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cameras", type=int, default=4)
    parser.add_argument("--frames", type=int, default=20)
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--many", type=int, default=0, metavar="N", help="so many sessions on some processes")
    parser.add_argument("--jobs", type=int, default=2, metavar="N", help="processes")
    options = parser.parse_args()
    on_worker(torch.device("cpu"), one, options.cameras, options.frames, options.runs)
    if options.many:
        many(options.many, options.jobs, options.cameras, options.frames)


if __name__ == "__main__":
    main()
