"""File formats by name: readers of sessions, of detectors' keypoints and of calibrations. Writers are in ``writers.py``.

A new format is one decorated function, in a file of this folder or in a module of your own.
:func:`~torchstickcal.io.read_session`, :func:`read_calibration` and the command line then know it.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

from torchstickcal.errors import FileFormatError
from torchstickcal.files import check_text
from torchstickcal.io.recording import Recording, View, in_folder
from torchstickcal.io.rig import Rig
from torchstickcal.io.truth import Truth
from torchstickcal.io.writers import CALIBRATION_WRITERS, Writer, calibration_writer, camera_writer, point_writer
from torchstickcal.observations import Observations
from torchstickcal.registry import Registry
from torchstickcal.untrusted import read_head, reading

__all__ = [
    "CALIBRATION_READERS", "CALIBRATION_WRITERS", "HEAD_BYTES", "KEYPOINT_READERS", "SESSION_READERS", "Reader", "Session",
    "Writer", "calibration_reader", "calibration_writer", "camera_reader", "camera_writer", "find_reader", "head_of",
    "is_folder", "keypoint_reader", "point_writer", "read_calibration", "reader_of", "reading", "session_of", "session_reader",
]  # fmt: skip
"""All that a new format needs."""

HEAD_BYTES = 4096
"""Number of bytes from the beginning of a file that a recogniser is given."""

_FIRST_ENTRIES = 50
"""Number of entries of a folder among which one is looked for by which the folder is recognised."""

Session = tuple[Observations, Truth | None]
"""What a session reader returns: the observations, and the truth if the file holds it."""

_Content = TypeVar("_Content")


@dataclass(frozen=True)
class Reader(Generic[_Content]):
    """A file format that can be read.

    Args:
        function: reads a file or a folder.
        recognises: whether a path is of this format, decided by its content. It is called with the path and with the first
            :data:`HEAD_BYTES` bytes of the file (all of a shorter file, none of a folder).
        description: the format in one line.
        is_content: whether a value is what such a function returns.
    """

    function: Callable[[Path], _Content]
    recognises: Callable[[Path, bytes], bool]
    description: str
    is_content: Callable[[object], bool]

    def read(self, path: str | Path) -> _Content:
        """The content of a file or a folder.

        Raises:
            FileFormatError: if it cannot be opened, or is not of the format.
            ObservationError: if the session that it holds cannot be used for a calibration.
            FileNotFoundError: if there is no such file.
        """
        with reading(path, self.description):
            content = self.function(Path(path))
            if not self.is_content(content):
                raise FileFormatError(
                    "a reader returns something else than it should",
                    where=f"{self.function.__module__}.{self.function.__name__}",
                    got=type(content).__name__,
                    expected="for a session (Observations, Truth or None), for keypoints a Recording, for a calibration a Rig",
                )
            return content

    def takes(self, path: Path, head: bytes) -> bool:
        """Whether it recognises a path; not where it fails to decide."""
        try:
            return self.recognises(path, head)
        except Exception:
            return False


SESSION_READERS: Registry[Reader[Session]] = Registry("session format", "torchstickcal.io")
"""The formats of sessions that can be read, by name. :func:`session_reader` adds one."""

KEYPOINT_READERS: Registry[Reader[Recording]] = Registry("session format", "torchstickcal.io")
"""The formats of detectors' keypoints that can be read, by name. :func:`keypoint_reader` and :func:`camera_reader` add one."""

CALIBRATION_READERS: Registry[Reader[Rig]] = Registry("calibration format", "torchstickcal.io")
"""The formats of calibrations that can be read, by name. :func:`calibration_reader` adds one."""

_SessionFunction = TypeVar("_SessionFunction", bound=Callable[[Path], Session])
_RecordingFunction = TypeVar("_RecordingFunction", bound=Callable[[Path], Recording])
_ViewFunction = TypeVar("_ViewFunction", bound=Callable[[Path], View])
_RigFunction = TypeVar("_RigFunction", bound=Callable[[Path], Rig])


def session_reader(
    name: str, description: str, *, recognises: Callable[[Path, bytes], bool], replace: bool = False
) -> Callable[[_SessionFunction], _SessionFunction]:
    """A decorator that registers a function as the reader of a session format, and returns the function unchanged.

    The function is called with a path and returns the :class:`~torchstickcal.Observations` and the :class:`Truth`, or None
    where the file holds no truth. Any exception that it raises becomes a :class:`~torchstickcal.FileFormatError` that names
    the file.

    Args:
        name: of the format.
        description: the format in one line.
        recognises: whether a path is of this format, as for :class:`Reader`.
        replace: whether to replace a format of that name.

    Raises:
        ConfigError: if the name is in use.

    Example::

        import json

        from torchstickcal import Observations, Stick
        from torchstickcal.io import session_reader

        @session_reader("toy", "keypoints (C, F, P, 2) as JSON", recognises=lambda path, head: head.startswith(b'{"toy"'))
        def read_toy(path):
            keypoints = json.loads(path.read_text())["toy"]
            return Observations(keypoints, None, Stick(0, 1, length_m=1.2), image_size=(640, 480)), None
    """

    def register(function: _SessionFunction) -> _SessionFunction:
        SESSION_READERS.register(name, Reader(function, recognises, description, _is_session), replace=replace)
        return function

    return register


def keypoint_reader(
    name: str, description: str, *, recognises: Callable[[Path, bytes], bool], replace: bool = False
) -> Callable[[_RecordingFunction], _RecordingFunction]:
    """A decorator that registers a function as the reader of keypoints of all cameras, and returns the function unchanged.

    The function is called with a path and returns the :class:`~torchstickcal.io.Recording`. Any exception that it raises
    becomes a :class:`~torchstickcal.FileFormatError` that names the file.

    Args:
        name: of the format.
        description: the format in one line.
        recognises: whether a path is of this format, as for :class:`Reader`.
        replace: whether to replace a format of that name.

    Raises:
        ConfigError: if the name is in use.

    Example::

        import json
        import numpy as np
        from torchstickcal.io import Recording, View, keypoint_reader

        @keypoint_reader("tiny", "tracks (F, P, 2) of each camera as JSON", recognises=lambda path, head: b'"tiny"' in head)
        def read_tiny(path):
            cameras = json.loads(path.read_text())["tiny"]
            return Recording.of([View.of_tracks(name, np.array(tracks)[None]) for name, tracks in cameras.items()])
    """

    def register(function: _RecordingFunction) -> _RecordingFunction:
        KEYPOINT_READERS.register(name, Reader(function, recognises, description, _is_recording), replace=replace)
        return function

    return register


def camera_reader(
    name: str, description: str, *, recognises: Callable[[Path, bytes], bool], replace: bool = False
) -> Callable[[_ViewFunction], _ViewFunction]:
    """A decorator that registers a function as the reader of keypoints of one camera, and returns the function unchanged.

    What is read is one file (or folder) of a camera, or a folder with one of them for each camera. The function is called with
    the path of one camera and returns its :class:`~torchstickcal.io.View`. Any exception that it raises becomes a
    :class:`~torchstickcal.FileFormatError` that names the file.

    Args:
        name: of the format.
        description: the format in one line.
        recognises: whether a path is that of one camera in this format, as for :class:`Reader`.
        replace: whether to replace a format of that name.

    Raises:
        ConfigError: if the name is in use.

    Example::

        import numpy as np
        from torchstickcal.io import View, camera_reader

        @camera_reader("words", "a line of numbers for each frame", recognises=lambda path, head: head.startswith(b"words"))
        def read_words(path):
            rows = [list(map(float, line.split())) for line in path.read_text().splitlines()[1:]]
            return View.of_tracks(path.stem, np.array(rows).reshape(1, len(rows), -1, 2))
    """

    def register(function: _ViewFunction) -> _ViewFunction:
        @functools.wraps(function)
        def read(path: Path) -> Recording:
            cameras, others = _cameras_of(path, recognises)
            if not cameras:
                cameras, others = [path], []  # the format is forced: the function says what is wrong
            views = []
            for camera in cameras:
                with reading(camera, description):
                    views.append(function(camera))
            ignored = f"Not read in {path}: {', '.join(others[:3])}{', ...' if len(others) > 3 else ''}."
            return Recording.of(views).with_notes(*([ignored] if others else []))

        def takes(path: Path, head: bytes) -> bool:
            return recognises(path, head) or bool(_cameras_of(path, recognises, first=_FIRST_ENTRIES)[0])

        KEYPOINT_READERS.register(name, Reader(read, takes, description, _is_recording), replace=replace)
        return function

    return register


def calibration_reader(
    name: str, description: str, *, recognises: Callable[[Path, bytes], bool], replace: bool = False
) -> Callable[[_RigFunction], _RigFunction]:
    """A decorator that registers a function as the reader of a calibration format, and returns the function unchanged.

    The function is called with a path and returns the :class:`Rig`. Any exception that it raises becomes a
    :class:`~torchstickcal.FileFormatError` that names the file.

    Args:
        name: of the format.
        description: the format in one line.
        recognises: whether a path is of this format, as for :class:`Reader`.
        replace: whether to replace a format of that name.

    Raises:
        ConfigError: if the name is in use.

    Example::

        import numpy as np
        import torch
        from torchstickcal.io import Rig, calibration_reader

        @calibration_reader("toy", "camera matrices and poses as .npy", recognises=lambda path, head: b"NUMPY" in head[:6])
        def read_toy(path):
            matrices, rotations, translations = torch.from_numpy(np.load(path)).split([3, 3, 1], dim=2)  # (C, 3, 7)
            count = len(matrices)
            return Rig(
                names=tuple(f"camera {number}" for number in range(count)),
                intrinsics=matrices,
                distortion=(torch.zeros(5, dtype=torch.float64),) * count,
                fisheye=(False,) * count,
                image_size=2 * matrices[:, :2, 2],
                rotations=rotations,
                translations=translations[..., 0],
            )
    """

    def register(function: _RigFunction) -> _RigFunction:
        CALIBRATION_READERS.register(name, Reader(function, recognises, description, _is_rig), replace=replace)
        return function

    return register


def read_calibration(path: str | Path, format: str | None = None) -> Rig:
    """Read the cameras of a calibration.

    Args:
        path: of the file or the folder.
        format: name of its format, a key of :data:`CALIBRATION_READERS`; None to recognise it by its content.

    Raises:
        FileFormatError: if no format is recognised, or if the file is damaged or cannot be opened.
        ConfigError: for an unknown format.
        FileNotFoundError: if there is no such file.

    Example: see :func:`~torchstickcal.io.write_calibration`.
    """
    return reader_of(path, CALIBRATION_READERS, format).read(path)


def reader_of(path: str | Path, registry: Registry[Reader[_Content]], format: str | None) -> Reader[_Content]:
    """The reader of a format; None for the one that recognises the path. Raises as :func:`read_calibration`."""
    return find_reader(path, registry) if format is None else registry[format]


def find_reader(path: str | Path, *registries: Registry[Any]) -> Reader[Any]:
    """The reader that recognises a file or a folder by its content.

    Formats that were registered last are asked first: a format of your own may be a special case of a shipped one.

    Args:
        path: of the file or the folder.
        registries: the readers that are asked: :data:`SESSION_READERS`, :data:`CALIBRATION_READERS`, or both.

    Raises:
        FileFormatError: if no reader recognises it (the message lists the known formats), or if it cannot be opened.
        FileNotFoundError: if there is no such file.

    Example:
        >>> import tempfile
        >>> from torchstickcal.io import CALIBRATION_READERS, SESSION_READERS, find_reader, write_npz
        >>> from torchstickcal.simulate import golf_session
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_npz(f"{folder}/swing.dat", *golf_session(cameras=3, frames=10))
        ...     find_reader(f"{folder}/swing.dat", SESSION_READERS, CALIBRATION_READERS).function.__name__
        'read_npz'
    """
    path = Path(path)
    head = head_of(path)
    for registry in registries:
        for reader in reversed(tuple(registry.values())):
            if reader.takes(path, head):
                return reader
    known = (f"{name} = {reader.description}" for registry in registries for name, reader in registry.items())
    raise FileFormatError(
        f"no {' or '.join(dict.fromkeys(registry.kind for registry in registries))} is recognised",
        where=str(path),
        got="a folder" if is_folder(path) else f"a file that starts with {head[:16]!r}" if head else "an empty file",
        expected=f"one of: {'; '.join(known)}",
        remedy="If it is one of these, give the name of the format.",
    )


def is_folder(path: Path) -> bool:
    """Whether a path is that of a folder, whatever its name is."""
    return os.path.isdir(path)  # noqa: PTH112 Path.is_dir raises for names that are too long


def head_of(path: Path) -> bytes:
    """What a recogniser is given of a path: the first :data:`HEAD_BYTES` bytes of a file, none of a folder.

    Raises:
        FileFormatError: if it cannot be opened.
        FileNotFoundError: if there is no such file.
    """
    return b"" if is_folder(path) else read_head(path, HEAD_BYTES)


def session_of(observations: Observations, truth: Truth | None) -> Session:
    """A session that was read from a file.

    Raises:
        CalibrationError: if the truth is that of another session, or if a name cannot be written to a file.
    """
    if truth is not None:
        truth.check_belongs_to(observations)
    for name in (*observations.camera_labels, *(observations.point_names or ())):
        check_text(name, "names of cameras and points")
    return observations, truth


def _is_session(content: object) -> bool:
    """Whether a value is a session; errors as of :func:`session_of` for one whose parts do not belong together."""
    if not isinstance(content, tuple) or len(content) != 2:
        return False
    observations, truth = content
    if not isinstance(observations, Observations) or not isinstance(truth, Truth | None):
        return False
    session_of(observations, truth)
    return True


def _cameras_of(
    path: Path, recognises: Callable[[Path, bytes], bool], first: int | None = None
) -> tuple[list[Path], list[str]]:
    """The paths of the cameras, which a path is or holds, and the names of what else it holds.

    Args:
        path: of one camera, or of a folder.
        recognises: whether a path is that of one camera.
        first: how many entries of the folder are looked at; None for all.
    """

    def is_camera(entry: Path) -> bool:
        try:
            return recognises(entry, head_of(entry))
        except Exception:
            return False

    if is_camera(path):
        return [path], []
    entries = in_folder(path)[:first] if is_folder(path) else []
    cameras = [entry for entry in entries if is_camera(entry)]
    return cameras, [entry.name for entry in entries if entry not in cameras]


def _is_recording(content: object) -> bool:
    return isinstance(content, Recording)


def _is_rig(content: object) -> bool:
    return isinstance(content, Rig)
