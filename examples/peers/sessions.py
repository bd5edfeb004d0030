"""What the scripts of all programs share: reading sessions, and writing one JSON line of camera poses per session.

Only NumPy is needed, so it runs in the environment of any program. Sessions are calibrated in a separate process, one after
another, so that a session that takes too long can be stopped. The time of the first session of a process includes what the
program loads at its first use.
"""

from __future__ import annotations

import argparse
import json
import logging
import multiprocessing
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Session:
    """What a program is given: C cameras, F frames, P points."""

    name: str
    keypoints: Array
    """(C, F, P, 2) pixels, NaN where not seen"""
    confidence: Array
    """(C, F, P), the weight of a keypoint: its variance is divided by it"""
    matrices: Array
    """(C, 3, 3)"""
    distortion: Array
    """(C, 5), OpenCV's order"""
    sizes: NDArray[np.int64]
    """(C, 2), width and height"""
    fps: float
    stick: tuple[int, int]
    """the points at its ends"""
    stick_length_m: float

    @property
    def visible(self) -> NDArray[np.bool_]:
        """(C, F, P)"""
        return np.isfinite(self.keypoints).all(-1) & (self.confidence > 0)


class Found(NamedTuple):
    """The result of a program: poses world to camera in metres, the time of its calibration, and its warnings."""

    rotations: Array
    """(C, 3, 3)"""
    translations: Array
    """(C, 3)"""
    seconds: float
    """wall time from keypoints in the program's own data structures to poses in metres"""
    status: str = "done"


Calibrate = Callable[[Session], Found]


class NotCalibratedError(Exception):
    """A program cannot calibrate a session, or not all of its cameras."""


def read(path: Path) -> Session:
    """Read a session that ``torchstickcal simulate`` wrote, without its truth."""
    with np.load(path, allow_pickle=False) as file:
        data = {name: file[name] for name in file.files}
    keypoints = data["keypoints"]
    cameras = len(keypoints)
    distortion = np.broadcast_to(data.get("distortion", np.zeros(5)), (cameras, np.shape(data.get("distortion", [0] * 5))[-1]))
    return Session(
        name=path.stem,
        keypoints=keypoints,
        confidence=data.get("confidence", np.ones(keypoints.shape[:3])),
        matrices=np.broadcast_to(data["intrinsics"], (cameras, 3, 3)).copy(),
        distortion=distortion.copy(),
        sizes=np.broadcast_to(data["image_size"], (cameras, 2)).astype(int),
        fps=float(data.get("fps", 30.0)),
        stick=(int(data["stick_start"][0]), int(data["stick_end"][0])),
        stick_length_m=float(data["stick_length_m"][0]),
    )


def stick_scale(session: Session, points: Array) -> float:
    """Known divided by median reconstructed length of the stick, from points (F, P, 3), NaN where not known.

    Raises:
        NotCalibratedError: if no frame has both ends.
    """
    start, end = session.stick
    lengths = np.linalg.norm(points[:, end] - points[:, start], axis=-1)
    if not np.isfinite(lengths).any():
        raise NotCalibratedError("the stick is in no frame of the reconstruction")
    return session.stick_length_m / float(np.nanmedian(lengths))


def session_files(paths: list[Path]) -> list[Path]:
    """The files of sessions, and those in folders, sorted by name."""
    return [file for path in paths for file in (sorted(path.glob("*.npz")) if path.is_dir() else [path])]


def main(calibrate: Calibrate, describe: str | None) -> None:
    """The command line of a script: write one JSON line for each session to ``--out``, and print its status."""
    parser = arguments(describe)
    parser.add_argument("--out", type=Path, required=True, help="file of JSON lines; results are appended")
    options = parser.parse_args()
    with options.out.open("a", encoding="utf-8") as out:
        for line in measured(calibrate, session_files(options.sessions), options.timeout, options.repeats):
            out.write(json.dumps(line) + "\n")
            out.flush()
            print(f"{line['name']:40} {line['seconds']:8.2f} s  {line['status']}", flush=True)


def arguments(describe: str | None) -> argparse.ArgumentParser:
    """The arguments of every script."""
    parser = argparse.ArgumentParser(description=describe, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sessions", type=Path, nargs="+", help="files or folders of sessions")
    parser.add_argument("--timeout", type=float, default=120.0, help="time limit for a session, seconds (default: 120)")
    parser.add_argument("--repeats", type=int, default=1, help="number of calibrations of each session (default: 1)")
    return parser


def measured(calibrate: Calibrate, files: list[Path], timeout: float, repeats: int) -> Iterator[dict[str, Any]]:
    """Calibrate sessions one after another. Yields the name, time and status of each, and the poses if there are any."""
    worker: _Worker | None = None
    for file in [file for file in files for _ in range(repeats)]:
        worker = worker or _Worker(calibrate)
        began = time.perf_counter()
        answer = worker.ask(file, timeout)
        if answer is None:
            worker = None
            answer = {"seconds": time.perf_counter() - began, "status": f"time-out after {timeout:g} s"}
        yield {"name": file.stem} | answer
    if worker:
        worker.end()


class _Worker:
    """A process that calibrates one session after another."""

    def __init__(self, calibrate: Calibrate) -> None:
        context = multiprocessing.get_context("fork")
        self._connection, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(calibrate, theirs), daemon=True)
        self._process.start()

    def ask(self, file: Path, timeout: float) -> dict[str, Any] | None:
        """The result of a session. If it takes too long, stop the process and return None."""
        self._connection.send(file)
        if self._connection.poll(timeout):
            try:
                return self._connection.recv()
            except EOFError:
                self._process.join()
                return {"seconds": 0.0, "status": f"process died, exit code {self._process.exitcode}"}
        self.end()
        return None

    def end(self) -> None:
        """Stop the process."""
        self._process.kill()
        self._process.join()


def _serve(calibrate: Calibrate, connection: Connection) -> None:
    logging.disable(logging.CRITICAL)
    while True:
        session = read(connection.recv())
        began = time.perf_counter()
        try:
            found = calibrate(session)
        except Exception as error:
            seconds = time.perf_counter() - began
            connection.send({"seconds": seconds, "status": f"{type(error).__name__}: {error}".splitlines()[0][:200]})
            continue
        if not (np.isfinite(found.rotations).all() and np.isfinite(found.translations).all()):
            connection.send({"seconds": found.seconds, "status": "poses are not finite"})
            continue
        poses = {"rotations": found.rotations.tolist(), "translations": found.translations.tolist()}
        connection.send({"seconds": found.seconds, "status": found.status} | poses)
