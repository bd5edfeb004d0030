"""Output formats by name: of cameras, of 3D points, or of whole calibrations.

A new format is one decorated function, in a file of this folder or in a module of your own. :func:`write_calibration` and the
command line then know it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar

from torchstickcal.errors import CalibrationError
from torchstickcal.files import check_text
from torchstickcal.io.motion import Motion
from torchstickcal.io.rig import Rig
from torchstickcal.registry import Registry
from torchstickcal.result import Calibration

_FORBIDDEN = set('/\\:*?"<>|') | set(map(chr, range(32)))
"""Characters that the name of a file cannot have, on one system or another."""


@dataclass(frozen=True)
class Writer:
    """A file format that can be written.

    Args:
        function: writes a path.
        file_name: name of the file that the command line writes, or of the folder.
        description: the format in one line.
        writes: what the function gets: a :class:`~torchstickcal.Calibration`, its cameras as a :class:`~torchstickcal.io.Rig`,
            or its points as a :class:`~torchstickcal.io.Motion`.
        files: the files in the folder that it writes; empty for a format of one file. They are called so, or in some folder
            below.
        needs_rate: whether points can only be written with a frame rate.
    """

    function: Callable[[Path, Any], None]
    file_name: str
    description: str
    writes: Literal["calibration", "cameras", "points"] = "calibration"
    files: tuple[str, ...] = ()
    needs_rate: bool = False

    def write(self, path: str | Path, content: Calibration | Rig | Motion) -> None:
        """Write a calibration, or what of it the format holds.

        Raises:
            CalibrationError: if the format cannot hold it, or if the function fails.
            OSError: if the file cannot be written.
        """
        try:
            self.function(Path(path), self._part(content))
        except (CalibrationError, OSError):
            raise
        except Exception as error:
            raise CalibrationError(
                "a calibration cannot be written in this format",
                where=f"{self.function.__module__}.{self.function.__name__}",
                got=f"{type(error).__name__}: {error}",
                expected=self.description,
            ) from error

    def _part(self, content: Calibration | Rig | Motion) -> Calibration | Rig | Motion:
        """What the function gets of a content.

        Raises:
            CalibrationError: if the content has no such part.
        """
        if self.writes == "cameras":
            part = Rig.of_calibration(content) if isinstance(content, Calibration) else content
        elif self.writes == "points":
            part = content if isinstance(content, Rig) else Motion.of(content)
        else:
            part = content
        kind = {"calibration": Calibration, "cameras": Rig, "points": Motion}[self.writes]
        if not isinstance(part, kind):
            has = {Rig: "cameras", Motion: "points"}.get(type(part), type(part).__name__)
            raise CalibrationError(
                f"a format that holds {self.writes}" if self.writes != "calibration" else "a format of whole calibrations",
                where=self.description,
                got=f"{has} alone",
                expected=self.writes if self.writes != "calibration" else "what `calibrate` has found",
            )
        return part


CALIBRATION_WRITERS: Registry[Writer] = Registry("output format", "torchstickcal.io")
"""The formats that can be written, by name. :func:`calibration_writer`, :func:`camera_writer`, :func:`point_writer` add one."""

_SUFFIXES = {".trc": "trc", ".c3d": "c3d", ".csv": "csv", ".npz": "npz", ".toml": "pose2sim", ".py": "blender"}
"""The format of a file by the end of its name, where its whole name says nothing else."""

_Function = TypeVar("_Function", bound=Callable[..., None])


def calibration_writer(
    name: str, description: str, *, file_name: str, replace: bool = False
) -> Callable[[_Function], _Function]:
    """A decorator that registers a function as the writer of an output format, and returns the function unchanged.

    The function is called with a path and a :class:`~torchstickcal.Calibration`, of which it writes the cameras, the points,
    or both. It writes through :func:`torchstickcal.files.atomic_path`, so that an error leaves no incomplete file.

    Args:
        name: of the format.
        description: the format in one line.
        file_name: name of the file that the command line writes.
        replace: whether to replace a format of that name.

    Raises:
        ConfigError: if the name is in use.

    Example::

        from torchstickcal.files import atomic_path
        from torchstickcal.io import calibration_writer

        @calibration_writer("toy", "names of the cameras, one per line", file_name="names.txt")
        def write_toy(path, calibration):
            with atomic_path(path) as temporary:
                temporary.write_text("\\n".join(calibration.camera_names))
    """
    return _registering(name, Writer(_nothing, file_name, description), replace)


def camera_writer(
    name: str, description: str, *, file_name: str, files: Sequence[str] = (), replace: bool = False
) -> Callable[[_Function], _Function]:
    """A decorator as :func:`calibration_writer`, for a function that is called with a path and a :class:`Rig`.

    So the format can also be the target of ``torchstickcal convert``. ``files`` are the names of the files in a folder, if the
    function writes a folder.
    """
    return _registering(name, Writer(_nothing, file_name, description, "cameras", tuple(files)), replace)


def point_writer(
    name: str, description: str, *, file_name: str, needs_rate: bool = False, replace: bool = False
) -> Callable[[_Function], _Function]:
    """A decorator as :func:`calibration_writer`, for a function that is called with a path and a :class:`Motion`.

    So the format can also be written by ``torchstickcal triangulate``. ``needs_rate`` says whether it needs a frame rate.
    """
    return _registering(name, Writer(_nothing, file_name, description, "points", needs_rate=needs_rate), replace)


def write_calibration(path: str | Path, calibration: Calibration | Rig | Motion, format: str) -> None:
    """Write a calibration for another program.

    :meth:`torchstickcal.Calibration.save` writes everything that a calibration holds, for
    :meth:`torchstickcal.Calibration.load`.

    Args:
        path: of the file, or of the folder for formats of several files.
        calibration: the calibration; its cameras alone for formats that hold nothing else, its points alone likewise.
        format: name of the format, a key of :data:`CALIBRATION_WRITERS`.

    Raises:
        ConfigError: for an unknown format.
        CalibrationError: if the format cannot hold the calibration.
        OSError: if the file cannot be written.

    Example:
        >>> import tempfile
        >>> from torchstickcal import calibrate
        >>> from torchstickcal.io import read_calibration, write_calibration
        >>> from torchstickcal.simulate import golf_session
        >>> calibration = calibrate(golf_session(cameras=3, frames=10)[0])
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_calibration(f"{folder}/calibration.toml", calibration, "pose2sim")
        ...     rig = read_calibration(f"{folder}/calibration.toml")
        >>> rig.names, rig.translations.shape
        (('cam01', 'cam02', 'cam03'), torch.Size([3, 3]))
    """
    CALIBRATION_WRITERS[format].write(path, calibration)


def writer_of(file_name: str, format: str | None = None, where: str = "--write") -> tuple[str, Writer]:
    """A file's name and its writer, by the name of the format, else by that of the file.

    Raises:
        CalibrationError: if nothing says which format it is.
    """
    if format is not None:
        return file_name, CALIBRATION_WRITERS[format]
    for writer in CALIBRATION_WRITERS.values():
        if writer.file_name == file_name:
            return file_name, writer
    suffix = Path(file_name).suffix.lower()
    if suffix in _SUFFIXES:
        return file_name, CALIBRATION_WRITERS[_SUFFIXES[suffix]]
    known = ", ".join(f"{writer.file_name} ({name})" for name, writer in CALIBRATION_WRITERS.items())
    raise CalibrationError(
        "the format of a file to be written is not known",
        where=where,
        got=file_name,
        expected=f"a name that says it, such as {known}",
        remedy="Say it with --to." if where == "TARGET" else "",
    )


def file_names(names: Sequence[str]) -> list[str]:
    """Names of files for cameras: their own, without what no file can be called.

    Raises:
        CalibrationError: if two become the same, or if one cannot be written.

    Example:
        >>> file_names(["cam01", "left/wide"])
        ['cam01', 'left_wide']
    """
    found = []
    for number, name in enumerate(names):
        check_text(name, "camera_names")
        plain = "".join("_" if letter in _FORBIDDEN else letter for letter in name).strip(" .")
        found.append(plain or f"camera_{number}")
    if len({name.lower() for name in found}) != len(found):
        expected = "names that differ by more than upper and lower case"
        raise CalibrationError("two cameras of one name", where="camera_names", got=", ".join(names), expected=expected)
    return found


def _nothing(path: Path, content: object) -> None:
    """Stands in the place of a writer's function until it is decorated."""


def _registering(name: str, writer: Writer, replace: bool) -> Callable[[_Function], _Function]:
    def register(function: _Function) -> _Function:
        CALIBRATION_WRITERS.register(name, dataclasses.replace(writer, function=function), replace=replace)
        return function

    return register
