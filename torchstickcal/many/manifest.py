"""What was done of many sessions: one row for each, appended to a file as soon as the session has ended."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

from torchstickcal.errors import CalibrationError, FileFormatError
from torchstickcal.files import json_text
from torchstickcal.untrusted import read_bytes, row_of

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

CONVERGED, NOT_CONVERGED, FAILED = "converged", "not converged", "failed"
MANIFESTS = "manifest*.jsonl"
"""The manifests in a folder of results: one, or one for each shard."""


@dataclass(frozen=True)
class SessionRow:
    """What became of one session."""

    name: str
    origin: str
    """path of its files; ``observations`` or ``function`` where it came from neither"""
    settings: str
    """a short code that is the same for the same configuration and options"""
    outcome: str
    """``converged``, ``not converged`` (the figures are those of the last estimate), or ``failed``"""
    status: str
    """``converged``, which stage did not and why, or ``failed``"""
    error: str | None
    """why it failed"""
    verdict: str | None
    """whether the result can be used"""
    cameras: int | None
    frames: int | None
    keypoints: int | None
    """number of keypoints that were used"""
    reprojection_px: float | None
    """median length of the residuals of the keypoints that were used"""
    centre_std_m: float | None
    rotation_std_deg: float | None
    """largest standard deviation of a camera's centre and of its rotation"""
    scale_std: float | None
    """relative standard deviation of the scale"""
    refined: str
    """what was estimated of the cameras beside their poses, with commas between"""
    warnings: int | None
    """number of warnings of the result"""
    seconds: float
    """time from reading the session to its written results"""
    folder: str | None
    """of its results, in the folder of all"""


def manifest_name(shard: tuple[int, int] | None) -> str:
    """The file of all sessions, or of a shard: the first of 4 is ``manifest.1-of-4.jsonl``."""
    return "manifest.jsonl" if shard is None else f"manifest.{shard[0]}-of-{shard[1]}.jsonl"


def read_manifests(folder: str | Path) -> dict[str, SessionRow]:
    """The last row of each session in all manifests of a folder of results, by name.

    An incomplete last line, of a run that was interrupted or still writes, does not count.

    Raises:
        FileFormatError: if a line is not a row.
    """
    rows: dict[str, SessionRow] = {}
    for file in sorted(Path(folder).glob(MANIFESTS)):
        for row in _rows(file):
            known = rows.get(row.name)
            if known is None or known.outcome == FAILED or row.outcome != FAILED:
                rows[row.name] = row
    return rows


class Manifest:
    """A manifest that is open for writing, by one process alone."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor

    def append(self, rows: Sequence[SessionRow]) -> None:
        """Write rows, whole, to the disk."""
        _write_whole(self._descriptor, "".join(json_text(asdict(row), indent=False) + "\n" for row in rows).encode())


@contextmanager
def open_manifest(file: Path) -> Iterator[Manifest]:
    """A manifest to append to; an incomplete last line, of a run that was interrupted, is removed.

    Raises:
        CalibrationError: if another process has it open.
    """
    descriptor = os.open(file, os.O_RDWR | os.O_CREAT | os.O_APPEND | getattr(os, "O_BINARY", 0), 0o666)
    try:
        _lock(descriptor, file)
        content = read_bytes(file)
        os.ftruncate(descriptor, content.rfind(b"\n") + 1)
        yield Manifest(descriptor)
    finally:
        os.close(descriptor)


def _rows(file: Path) -> Iterator[SessionRow]:
    """The whole lines of a manifest.

    Raises:
        FileFormatError: if a line is not a row.
    """
    content = read_bytes(file)
    for number, line in enumerate(content[: content.rfind(b"\n") + 1].splitlines(), 1):
        try:
            yield row_of(SessionRow, json.loads(line))
        except (ValueError, TypeError, RecursionError) as error:
            where = f"{file}, line {number}"
            raise FileFormatError("not a manifest", where=where, got=str(error), expected="a row of a session") from error


def _write_whole(descriptor: int, content: bytes) -> None:
    """Append bytes; after an error, such as of a full disk, the file is as before."""
    size = os.fstat(descriptor).st_size
    try:
        written = os.write(descriptor, content)
        while written < len(content):
            written += os.write(descriptor, content[written:])
        os.fsync(descriptor)
    except OSError:
        os.ftruncate(descriptor, size)
        raise


def _lock(descriptor: int, file: Path) -> None:
    """Keep other processes from writing to a file, where the system can.

    Raises:
        CalibrationError: if another process already writes to it.
    """
    if fcntl is None:
        return
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise CalibrationError(
            "another run writes to this folder",
            where=str(file),
            got="a file that is in use",
            expected="one run at a time",
            remedy="Wait until it has ended, or divide the sessions among several runs with shards.",
        ) from error
    except OSError:  # a file system without locks
        return
