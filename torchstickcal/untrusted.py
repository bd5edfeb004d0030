"""Files from anywhere: nothing of them is run, and what they declare is checked before memory is given to it."""

from __future__ import annotations

import csv
import importlib.util
import io
import json
import math
import os
import re
import stat
import typing
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO, TypeVar
from xml.etree import ElementTree

import numpy as np
import yaml
from numpy.typing import NDArray

from torchstickcal.errors import CalibrationError, FileFormatError
from torchstickcal.files import parse_toml

_Row = TypeVar("_Row")
GROWTH = 100
"""How much more memory the content of a file may need than the file is long. Keypoints of which one in a hundred is seen stay
below."""
SLACK_BYTES = 16 * 2**20
"""What a file of any size may need in addition."""
LONGEST_TOML_BYTES = 16 * 2**20
LONGEST_YAML_BYTES = 2**20
LONGEST_XML_BYTES = 16 * 2**20
_YAML_HEADER = re.compile(r"\A%YAML[^\n]*\n")
"""The first line of OpenCV's files, which other readers of YAML refuse."""
_LONGEST_CAUSE = 300
"""Characters of a foreign message that an error shows."""
_MOST_EMPTY_ROWS = 10_000
_COMPRESSIONS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
"""Those that NumPy writes; others may ask for memory of their own."""
_HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
_KINDS = "biufcU"
"""Kinds of arrays that are read: numbers, truth values and texts."""


@contextmanager
def reading(path: str | Path, expected: str, what: str = "a file is damaged or not of the expected format") -> Iterator[None]:
    """A block in which a file is read: every exception becomes a FileFormatError that names the file.

    The library's more special errors, and FileNotFoundError, are not changed.

    Args:
        path: of the file.
        expected: what the file should hold.
        what: the problem, in one phrase, if it holds something else.

    Example:
        >>> from torchstickcal import FileFormatError
        >>> try:
        ...     with reading("swing.json", "a length"):
        ...         length_m = {}["length_m"]
        ... except FileFormatError as error:
        ...     print(error)
        a file is damaged or not of the expected format (swing.json): got no 'length_m'; expected a length.
    """
    try:
        yield
    except FileNotFoundError:
        raise
    except CalibrationError as error:
        if type(error) is not CalibrationError:
            raise
        where = f"{path}: {error.where}"
        raise FileFormatError(error.what, where=where, got=error.got, expected=error.expected, remedy=error.remedy) from error
    except Exception as error:
        cause = f"no {error}" if isinstance(error, KeyError) else f"{type(error).__name__}: {error}"
        raise FileFormatError(what, where=str(path), got=_shortened(cause), expected=expected) from error


def open_regular(path: str | Path) -> BinaryIO:
    """A regular file, open for reading: no folder, no device, and nothing that another program writes while it is read.

    Raises:
        FileFormatError: if it is something else, or cannot be opened.
        FileNotFoundError: if there is no such file.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    except FileNotFoundError:
        raise
    except (OSError, ValueError) as error:
        got = f"{type(error).__name__}: {error}"
        if os.path.isdir(path):  # noqa: PTH112 Path.is_dir raises for names that are too long
            raise _not_regular(path, "a folder") from error
        raise FileFormatError(
            "a file cannot be opened", where=str(path), got=got, expected="a file that can be read"
        ) from error
    mode = os.fstat(descriptor).st_mode
    if not stat.S_ISREG(mode):
        os.close(descriptor)
        raise _not_regular(path, "a folder" if stat.S_ISDIR(mode) else "a device, a pipe or a socket")
    return os.fdopen(descriptor, "rb")


def read_head(path: str | Path, size: int) -> bytes:
    """The first bytes of a regular file; errors as of :func:`open_regular`."""
    with reading(path, "a file that can be read"), open_regular(path) as file:
        return file.read(size)


def read_bytes(path: str | Path) -> bytes:
    """The content of a regular file; errors as of :func:`open_regular`."""
    with reading(path, "a file that can be read"), open_regular(path) as file:
        return file.read()


def read_toml(path: str | Path) -> dict[str, Any]:
    """The tables of a TOML file of at most :data:`LONGEST_TOML_BYTES`.

    Raises:
        FileFormatError: if it is no such file; the message says why.
        FileNotFoundError: if there is no such file.
    """
    with reading(path, "a TOML file in UTF-8"), open_regular(path) as file:
        content = file.read(LONGEST_TOML_BYTES + 1)
        if len(content) > LONGEST_TOML_BYTES:
            raise ValueError(f"more than {LONGEST_TOML_BYTES} bytes")
        return parse_toml(content)


def read_text(path: str | Path, longest_bytes: int | None = None) -> str:
    """A text in UTF-8, with or without a byte order mark; errors as of :func:`read_toml`."""
    with reading(path, "a text in UTF-8"), open_regular(path) as file:
        content = file.read() if longest_bytes is None else file.read(longest_bytes + 1)
        if longest_bytes is not None and len(content) > longest_bytes:
            raise ValueError(f"more than {longest_bytes} bytes")
        return content.decode("utf-8-sig")


def read_json(path: str | Path) -> Any:
    """The content of a JSON file; errors as of :func:`read_toml`."""
    text = read_text(path)
    with reading(path, "a JSON file"):
        return json.loads(text)


def read_yaml(path: str | Path) -> Any:
    """The content of a YAML file of at most :data:`LONGEST_YAML_BYTES`, also of OpenCV's; errors as of :func:`read_toml`.

    What a tag such as ``!!opencv-matrix`` stands before is read as if it had none.
    """
    text = read_text(path, LONGEST_YAML_BYTES)
    with reading(path, "a YAML file"):
        return yaml.load(_YAML_HEADER.sub("", text), _PlainLoader)


def read_xml(path: str | Path) -> ElementTree.Element:
    """The root of an XML file of at most :data:`LONGEST_XML_BYTES` without entities; errors as of :func:`read_toml`."""
    text = read_text(path, LONGEST_XML_BYTES)
    with reading(path, "an XML file without a document type"):
        if "<!DOCTYPE" in text or "<!ENTITY" in text:
            raise ValueError("a document type, which may let the file grow without bounds")
        return ElementTree.fromstring(text.encode())


def read_rows(path: str | Path) -> list[list[str]]:
    """The rows of a CSV file, separated by commas, semicolons or tabs, without empty ones; errors as of :func:`read_toml`."""
    text = read_text(path)
    with reading(path, "a table (.csv)"):
        first, _, _ = text.partition("\n")
        delimiter = max(",;\t", key=first.count)
        return [row for row in csv.reader(io.StringIO(text, newline=""), delimiter=delimiter, strict=True) if any(row)]


def read_array(path: str | Path) -> NDArray[Any]:
    """The array of an ``.npy`` file; errors as of :func:`read_toml`."""
    with reading(path, "an array of numbers or texts (.npy)"), open_regular(path) as file:
        _check_header("of the file", file, os.fstat(file.fileno()).st_size)
        file.seek(0)
        array = np.lib.format.read_array(file, allow_pickle=False)
        return array.astype(array.dtype.newbyteorder("="), copy=False)


@contextmanager
def open_h5(path: str | Path) -> Iterator[H5File]:
    """An HDF5 file. Use it within :func:`reading`: looking up a part of a damaged file raises anything.

    Raises:
        FileFormatError: if h5py is not installed.
        FileNotFoundError: if there is no such file.
    """
    try:
        import h5py
    except ImportError as error:
        raise FileFormatError(
            "a file needs a package that is not installed",
            where=str(path),
            got="an HDF5 file (.h5), and no package h5py",
            expected="the package h5py",
            remedy="Install it with `pip install h5py`, or save the file as .csv.",
        ) from error
    with open_regular(path) as file, h5py.File(file, "r") as content:
        yield H5File(content, GROWTH * os.fstat(file.fileno()).st_size + SLACK_BYTES)


def h5_can_be_read() -> bool:
    """Whether h5py, which reads HDF5 files, is installed."""
    return importlib.util.find_spec("h5py") is not None


class H5File:
    """The datasets and attributes of an HDF5 file, read when they are asked for.

    Datasets that are in another file, or in several, are not read. All together may have :data:`GROWTH` times the size of the
    file and :data:`SLACK_BYTES`.
    """

    def __init__(self, content: Any, budget_bytes: int) -> None:
        self._content = content
        self._left_bytes = budget_bytes

    def __contains__(self, name: str) -> bool:
        return self._found(name) is not None

    def groups(self) -> list[str]:
        """The names of what stands at the top of the file."""
        return list(self._content)

    def array(self, name: str) -> NDArray[Any]:
        """A dataset of numbers, texts or records of these.

        Raises:
            KeyError: if there is none of this name in the file itself.
            ValueError: if it holds something else, or is too large.
        """
        dataset = self._found(name)
        if dataset is None or not hasattr(dataset, "dtype"):
            raise KeyError(name)
        if dataset.external or dataset.is_virtual:
            raise ValueError(f"dataset {name!r} is in another file")
        import h5py

        text = h5py.check_string_dtype(dataset.dtype) is not None
        kinds = {dataset.dtype[field].base.kind for field in dataset.dtype.names or ()} or {dataset.dtype.kind}
        if not (text or kinds <= {*_KINDS, "S"}):
            raise ValueError(f"dataset {name!r} is of the type {dataset.dtype}, not of numbers or texts")
        self._left_bytes -= dataset.size * dataset.dtype.itemsize
        if self._left_bytes < 0:
            raise ValueError(f"dataset {name!r} of the shape {dataset.shape}: more than {GROWTH} times the size of the file")
        return dataset[()]

    def texts(self, name: str) -> list[str]:
        """A dataset of texts; errors as of :meth:`array`."""
        return [
            value.decode() if isinstance(value, bytes) else str(value) for value in np.atleast_1d(self.array(name)).tolist()
        ]

    def attribute(self, name: str, key: str) -> Any:
        """An attribute of a dataset or a group.

        Raises:
            KeyError: if there is none.
        """
        owner = self._found(name)
        if owner is None:
            raise KeyError(name)
        return owner.attrs[key]

    def _found(self, name: str) -> Any:
        """What has a path of names, if it and all above it are in this file."""
        import h5py

        owner = self._content
        for part in name.split("/"):
            if not isinstance(owner, h5py.Group) or not isinstance(owner.get(part, getlink=True), h5py.HardLink):
                return None
            owner = owner[part]
        return owner


class _PlainLoader(yaml.SafeLoader):
    """YAML as lists, dictionaries, numbers and texts, whatever tags it has. Aliases, by which a file may grow, are refused."""

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        if self.check_event(yaml.AliasEvent):
            raise ValueError("an alias (*name) for another part of the file")
        return super().compose_node(parent, index)


def _untagged(loader: _PlainLoader, _: str, node: yaml.Node) -> Any:
    if isinstance(node, yaml.MappingNode):
        return loader.construct_mapping(node, deep=True)
    if isinstance(node, yaml.SequenceNode):
        return loader.construct_sequence(node, deep=True)
    assert isinstance(node, yaml.ScalarNode)
    return loader.construct_scalar(node)


_PlainLoader.add_multi_constructor("tag:yaml.org,2002:opencv-", _untagged)


@contextmanager
def open_arrays(path: str | Path) -> Iterator[Mapping[str, NDArray[Any]]]:
    """The arrays of an ``.npz`` file by name. An array is read when it is first asked for; others are not looked at.

    All arrays that are read may together have :data:`GROWTH` times the size of the file and :data:`SLACK_BYTES`. They have the
    byte order of this machine. Use it within :func:`reading`: looking up an array of a damaged file raises anything.

    Example:
        >>> import tempfile
        >>> import numpy as np
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     np.savez(f"{folder}/a.npz", lengths_m=[1.0, 2.0])
        ...     with open_arrays(f"{folder}/a.npz") as arrays:
        ...         list(arrays), arrays["lengths_m"]
        (['lengths_m'], array([1., 2.]))
    """
    with open_regular(path) as file, zipfile.ZipFile(file) as archive:
        yield _Arrays(archive, GROWTH * os.fstat(file.fileno()).st_size + SLACK_BYTES)


class _Arrays(Mapping[str, NDArray[Any]]):
    """The arrays of an archive, read when they are asked for."""

    def __init__(self, archive: zipfile.ZipFile, budget_bytes: int) -> None:
        self._archive = archive
        self._left_bytes = budget_bytes
        self._names = [name.removesuffix(".npy") for name in archive.namelist() if name.endswith(".npy")]
        self._read: dict[str, NDArray[Any]] = {}

    def __getitem__(self, name: str) -> NDArray[Any]:
        if name not in self._names:
            raise KeyError(name)
        if name not in self._read:
            self._read[name] = self._array(name)
        return self._read[name]

    def __iter__(self) -> Iterator[str]:
        return iter(dict.fromkeys(self._names))

    def __len__(self) -> int:
        return len(set(self._names))

    def _array(self, name: str) -> NDArray[Any]:
        info = self._archive.getinfo(f"{name}.npy")
        if info.compress_type not in _COMPRESSIONS:
            raise ValueError(f"array {name!r} is compressed by method {info.compress_type}, which NumPy does not write")
        self._left_bytes -= info.file_size
        if self._left_bytes < 0:
            raise ValueError(f"array {name!r} of {info.file_size} bytes: more than {GROWTH} times the size of the file")
        with self._archive.open(info) as stream:
            _check_header(name, stream, info.file_size)
        with self._archive.open(info) as stream:
            array = np.lib.format.read_array(stream, allow_pickle=False)
        return array.astype(array.dtype.newbyteorder("="), copy=False)


def check_size(shape: tuple[int, ...], dtype: np.dtype[Any], size: int) -> None:
    """Raise a ValueError unless an array of a shape and a type has so many bytes.

    An empty array has few rows: as lists, a million rows of nothing would need memory.
    """
    rows = math.prod(length for length in shape if length)
    if min(shape, default=0) < 0 or math.prod(shape) * dtype.itemsize != size or rows > size + _MOST_EMPTY_ROWS:
        raise ValueError(f"an array declares the shape {shape} but holds {size} bytes")


def _check_header(name: str, stream: Any, size: int) -> None:
    """Refuse an array that is not of numbers or texts, or that declares another size than is there."""
    version = np.lib.format.read_magic(stream)
    if version not in _HEADERS:
        raise ValueError(f"array {name!r} is of version {version} of the format")
    shape, _, dtype = _HEADERS[version](stream)
    if dtype.kind not in _KINDS or dtype.hasobject or dtype.names or dtype.subdtype:
        raise ValueError(f"array {name!r} is of the type {dtype}, not of numbers or texts")
    check_size(shape, dtype, size - stream.tell())


def _not_regular(path: str | Path, got: str) -> FileFormatError:
    return FileFormatError("not a file", where=str(path), got=got, expected="a regular file")


def _shortened(text: str) -> str:
    return text if len(text) <= _LONGEST_CAUSE else f"{text[:_LONGEST_CAUSE]}..."


def row_of(kind: type[_Row], values: dict[str, Any]) -> _Row:
    """A row, a dataclass of numbers and texts, from a line of a file.

    Raises:
        TypeError: if a value is missing, unknown, or of another type.
    """
    row = kind(**values)
    for name, expected in typing.get_type_hints(kind).items():
        value = getattr(row, name)
        if not isinstance(value, expected) and not (type(value) is int and isinstance(0.0, expected)):
            raise TypeError(f"{name} is {value!r}")
    return row
