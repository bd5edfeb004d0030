"""Files: written completely or not at all, alone or as a set; TOML as any editor saves it; JSON that every reader accepts."""

from __future__ import annotations

import errno
import json
import math
import os
import re
import shutil
import tempfile
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from torchstickcal.errors import CalibrationError

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

CAMERAS_FILE, POINTS_FILE, REPORT_FILE, PAGE_FILE = "calibration.toml", "points.npz", "report.json", "report.html"
"""The files of a result: its cameras, the saved calibration, what programs and what people read of it."""
RERUN_FILE = "scene.rrd"
"""A recording for the Rerun viewer, of results for which it is asked."""

_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")
"""A key that TOML writes without quotation marks."""
_TEMPORARY = ".torchstickcal-"
_CANNOT_SYNC = {errno.EINVAL, errno.ENOTSUP, errno.ENOSYS, errno.EBADF}
"""What file systems without fsync, or without fsync of folders, answer."""


_unfinished: set[Path] = set()
"""The folders of this process in which sets are being written."""


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """A temporary path in the folder of ``path``. It replaces ``path`` if the block succeeds, and is deleted otherwise.

    A file of a set (:func:`atomic_set`) is written in its place at once: the whole set is temporary.
    """
    path = Path(path)
    if not _unfinished.isdisjoint(path.parents):
        try:
            yield path
        except BaseException:
            path.unlink(missing_ok=True)
            raise
        return
    with _temporary_folder(path.parent) as folder:
        yield folder / path.name
        _to_disk(folder / path.name)
        (folder / path.name).replace(path)


@contextmanager
def atomic_set(folder: str | Path) -> Iterator[Path]:
    """A temporary folder for files that belong together. They take their places in ``folder`` if the block succeeds.

    Files of the same names are replaced; others in ``folder`` stay as they are. ``folder`` is created if it does not exist.
    There may be folders among them, for whose files the same holds.

    If the block fails or is interrupted, the disk is full, or a file cannot be replaced, ``folder`` is as before. No operating
    system exchanges several files at once: where the process is killed or the machine stops during the exchange, which takes a
    few milliseconds, ``folder`` may lack files of the set. It never holds some old and some new ones, because all old ones are
    moved away before the first new one is put in their place. All files are then still in a hidden folder beside them, whose
    name begins with ``.torchstickcal-``: new ones in ``new``, old ones in ``old``.

    Raises:
        OSError: if a file cannot be written.

    Example:
        >>> import pathlib, tempfile
        >>> with tempfile.TemporaryDirectory() as parent:
        ...     with atomic_set(f"{parent}/results") as folder:
        ...         _ = (folder / "cameras.txt").write_text("left, right")
        ...         _ = (folder / "points.txt").write_text("1, 2, 3")
        ...     sorted(path.name for path in pathlib.Path(parent, "results").iterdir())
        ['cameras.txt', 'points.txt']
    """
    folder = Path(folder)
    with _created(folder), _temporary_folder(folder) as temporary:
        new, old = temporary / "new", temporary / "old"
        new.mkdir()
        _unfinished.add(new)
        try:
            yield new
        finally:
            _unfinished.discard(new)
        names = sorted(path.relative_to(new).as_posix() for path in new.rglob("*") if not path.is_dir())
        for name in names:
            _to_disk(new / name)
        with _alone(folder):
            _exchange(folder, names, new, old)
        shutil.rmtree(old, ignore_errors=True)


def remove_remains(folder: str | Path) -> None:
    """Delete what processes that were killed have left of their sets in a folder into which nobody else writes now.

    A set that took the place of older files only in part is kept: it is their only copy.
    """
    for temporary in Path(folder).glob(f"{_TEMPORARY}*"):
        old = temporary / "old"
        if not old.is_dir() or not any(old.iterdir()):
            shutil.rmtree(temporary, ignore_errors=True)


def try_writing(folder: str | Path, names: Iterable[str] = (), where: str = "--out") -> None:
    """Try whether files can be written to a folder, and leave no trace of it.

    Args:
        folder: which; it need not exist.
        names: of the files.
        where: what gave the folder, for the message.

    Raises:
        CalibrationError: if they cannot.
    """
    folder = Path(folder)
    try:
        with _created(folder, keep=False), _temporary_folder(folder) as temporary:
            for name in names:
                (temporary / name).write_bytes(b"?")
        taken = [name for name in names if (folder / name).is_dir()]
    except (OSError, ValueError) as error:
        got = f"{type(error).__name__}: {error}"
        expected = "a folder that exists or can be created, in which files can be written"
        raise CalibrationError("results cannot be written", where=f"{where} {folder}", got=got, expected=expected) from error
    if taken:
        raise CalibrationError(
            "results cannot be written", where=f"{where} {folder}", got=f"a folder {taken[0]}", expected="none of that name"
        )


def check_text(text: str, where: str) -> None:
    """Raise a CalibrationError for a text that no file can hold: one with half of a surrogate pair."""
    try:
        text.encode()
    except UnicodeEncodeError as error:
        expected = "characters of Unicode, without halves of surrogate pairs"
        raise CalibrationError("a text that cannot be written", where=where, got=ascii(text), expected=expected) from error


def without_nan(content: Any) -> Any:
    """Lists and dictionaries as JSON can hold them: None in the place of NaN and infinities.

    Example:
        >>> without_nan({"lengths_m": [1.0, float("nan")]})
        {'lengths_m': [1.0, None]}
    """
    if isinstance(content, dict):
        return {key: without_nan(value) for key, value in content.items()}
    if isinstance(content, list | tuple):
        return [without_nan(value) for value in content]
    return None if isinstance(content, float) and not math.isfinite(content) else content


def json_text(content: Any, indent: bool = True) -> str:
    """JSON that every reader accepts: null in the place of NaN and infinities.

    Args:
        content: dictionaries with texts as keys, lists, texts, numbers, true, false and None.
        indent: whether lists and dictionaries that hold others have a line for each entry; otherwise everything is on one line,
            without spaces.

    Example:
        >>> print(json_text({"name": "left", "centre": {"x": 0.5, "y": float("nan")}}))
        {
          "name": "left",
          "centre": {"x": 0.5, "y": null}
        }
        >>> json_text({"name": "left", "centre": {"x": 0.5, "y": float("nan")}}, indent=False)
        '{"name":"left","centre":{"x":0.5,"y":null}}'
    """
    write = _indented if indent else _on_one_line
    try:
        return write(content)
    except ValueError:  # NaN or infinity, which are rare
        return write(without_nan(content))


_on_one_line = json.JSONEncoder(allow_nan=False, separators=(",", ":")).encode
_in_line = json.JSONEncoder(allow_nan=False).encode


def _indented(content: Any, margin: str = "\n") -> str:
    """JSON with an indentation of two spaces; ``margin`` is a line's end and what the next line begins with.

    Raises:
        ValueError: for NaN and infinities.
    """
    values = content.values() if isinstance(content, dict) else content if isinstance(content, list | tuple) else ()
    if not any(isinstance(value, dict | list | tuple) for value in values):
        return _in_line(content)
    inner = margin + "  "
    if isinstance(content, dict):
        entries = [f"{inner}{_in_line(str(key))}: {_indented(value, inner)}" for key, value in content.items()]
        return f"{{{','.join(entries)}{margin}}}"
    return f"[{','.join(inner + _indented(value, inner) for value in content)}{margin}]"


def write_json(path: str | Path, content: Any) -> None:
    """Write a file of JSON, as :func:`json_text` has it."""
    with atomic_path(path) as temporary:
        temporary.write_text(json_text(content) + "\n", "utf-8")


def parse_toml(content: bytes) -> dict[str, Any]:
    r"""The tables of a TOML file in UTF-8, with or without a byte order mark.

    Raises:
        ValueError: if it is not such a file; the message says why.

    Example:
        >>> parse_toml(b"\xef\xbb\xbf[cam_0]\nsize = [640, 480]")
        {'cam_0': {'size': [640, 480]}}
    """
    try:
        return tomllib.loads(content.decode("utf-8-sig"))
    except UnicodeDecodeError as error:
        raise ValueError(f"a byte at position {error.start} that is not UTF-8; save the file as UTF-8") from error
    except RecursionError as error:
        raise ValueError("brackets within brackets, too many to be read") from error


def toml_text(tables: Mapping[str, Any]) -> str:
    """TOML of tables within tables, whose values are texts, numbers, true, false, and lists of these.

    Example:
        >>> print(toml_text({"relabel": True, "stages": {"metric": {"reject_sigmas": 6.0, "refine": ["focal"]}}}))
        relabel = true
        <BLANKLINE>
        [stages.metric]
        reject_sigmas = 6.0
        refine = ["focal"]
        <BLANKLINE>
    """
    return "\n".join(text for text in _toml_tables(tables, ()) if text)


def toml_string(text: str) -> str:
    """A text as TOML: JSON, with the one character escaped that JSON allows and TOML does not."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def _toml_tables(table: Mapping[str, Any], path: tuple[str, ...]) -> Iterator[str]:
    """The texts of a table and of those within it, by the keys that lead to it."""
    values = {key: value for key, value in table.items() if not isinstance(value, Mapping)}
    lines = [f"{_toml_key(key)} = {_toml_value(value)}\n" for key, value in values.items()]
    header = f"[{'.'.join(map(_toml_key, path))}]\n" if path and (lines or not table) else ""
    yield header + "".join(lines)
    for key, value in table.items():
        if isinstance(value, Mapping):
            yield from _toml_tables(value, (*path, key))


def _toml_key(key: str) -> str:
    return key if _BARE_KEY.fullmatch(key) else toml_string(key)


def _toml_value(value: Any) -> str:
    if isinstance(value, str):
        return toml_string(value)
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_toml_value, value))}]"
    return str(value).lower() if isinstance(value, bool) else repr(value)


@contextmanager
def _temporary_folder(folder: Path) -> Iterator[Path]:
    """A folder in another one, deleted at the end unless it still holds old files of a set in ``old``."""
    temporary = Path(tempfile.mkdtemp(dir=folder, prefix=_TEMPORARY))
    try:
        yield temporary
    except OSError as error:
        if error.errno is not None and error.filename is None:  # as of a full disk
            raise OSError(error.errno, error.strerror, str(folder)) from error
        raise
    finally:
        old = temporary / "old"
        if not old.is_dir() or not any(old.iterdir()):
            shutil.rmtree(temporary, ignore_errors=True)


@contextmanager
def _created(folder: Path, keep: bool = True) -> Iterator[None]:
    """A folder that is created, with those above it, if it does not exist; removed if the block fails or it is not kept."""
    missing = [path for path in (folder, *folder.parents) if not os.path.lexists(path)]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        yield
    except BaseException:
        keep = False
        raise
    finally:
        for path in () if keep else missing:
            if path.is_dir() and not any(path.iterdir()):
                path.rmdir()


def _exchange(folder: Path, names: list[str], new: Path, old: Path) -> None:
    """Move files from ``folder`` to ``old``, then those of the same names from ``new`` to ``folder``; undo it on an error."""
    for name in names:
        if (folder / name).is_dir():
            raise IsADirectoryError(f"a folder has the name of a file to be written: {folder / name}")
    moves: list[tuple[Path, Path]] = []
    try:
        for source, target in ((folder, old), (new, folder)):
            own = [name for name in names if os.path.lexists(source / name)]
            for name in own:
                (target / name).parent.mkdir(parents=True, exist_ok=True)
                moves.append((source / name, target / name))
                (source / name).rename(target / name)
            if own:
                _to_disk(folder)
    except BaseException:
        for source, target in reversed(moves):
            if os.path.lexists(target) and not os.path.lexists(source):
                target.rename(source)
        raise


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """A block that no two processes run at once for the same folder, where the system can lock folders."""
    if fcntl is None:
        yield
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        with suppress(OSError):
            fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


def _to_disk(path: Path) -> None:
    """Have the operating system put a file, or the entries of a folder, on the disk, where it can."""
    if os.name == "nt" and path.is_dir():
        return
    descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_BINARY", 0))
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in _CANNOT_SYNC:
            raise
    finally:
        os.close(descriptor)
