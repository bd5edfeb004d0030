"""Pickle files, read without running anything of them.

A pickle is a program for a small machine. Python's own machine can call any function, gives memory to whatever size a file
declares, and lets a file rebuild NumPy's arrays from inconsistent parts. The machine of this module knows only lists, tuples,
dictionaries, sets, numbers, texts, and NumPy arrays of numbers, which it builds itself from their bytes.
"""

from __future__ import annotations

import pickletools
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchstickcal.errors import FileFormatError
from torchstickcal.untrusted import GROWTH, SLACK_BYTES, check_size, read_bytes, reading

_Number = np.dtype[Any]
_CODE = re.compile(r"[<>|=]?(?:[iuf]|c|b)(?:1|2|4|8|16)|\?")
"""Types of numbers and truth values, as NumPy names them."""
_PLAIN_STATE = (None, None, None, -1, -1, 0)
"""The state of such a type, after its version and its byte order."""
_MARK = object()
_SMALL = (int, float, bool, type(None))
_SMALL_BYTES = 8
"""What such a value needs in an array."""
_CONTAINERS = (list, tuple, set, frozenset)
_VALUES = {
    "BINFLOAT", "FLOAT", "INT", "BININT", "BININT1", "BININT2", "LONG", "LONG1", "LONG4",
    "UNICODE", "SHORT_BINUNICODE", "BINUNICODE", "BINUNICODE8", "STRING", "SHORT_BINSTRING", "BINSTRING",
    "SHORT_BINBYTES", "BINBYTES", "BINBYTES8", "BYTEARRAY8",
}  # fmt: skip
"""Opcodes that put their argument on the stack."""


def load(path: str | Path) -> Any:
    """The content of a pickle file that holds only plain data.

    Args:
        path: of the file.

    Returns:
        NumPy arrays of numbers, lists, tuples, dictionaries, sets, numbers, texts and bytes, as they were saved.

    Raises:
        FileFormatError: if the file is damaged, holds anything else, or would need much more memory than it is long; none of it
            is run.
        FileNotFoundError: if there is no such file.

    Example:
        >>> import pathlib, pickle, tempfile
        >>> from torchstickcal.io import safe_pickle
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = pathlib.Path(folder, "data.pkl")
        ...     _ = path.write_bytes(pickle.dumps({"length_m": 1.2}))
        ...     safe_pickle.load(path)
        {'length_m': 1.2}
    """
    expected = "only NumPy arrays of numbers, lists, dictionaries, numbers and texts"
    try:
        content = read_bytes(path)
        with reading(path, expected, "a pickle file is damaged or holds more than plain data"):
            found = _Machine().run(content)
            _check_size(found, GROWTH * len(content) + SLACK_BYTES)
            return found
    except FileFormatError as error:
        remedy = "Do not open this file with pickle.load: that can run any program."
        raise FileFormatError(error.what, where=error.where, got=error.got, expected=expected, remedy=remedy) from error


def loads(content: bytes) -> Any:
    """The content of a pickle of plain data in memory, such as an attribute of an HDF5 file.

    Raises:
        ValueError: if it holds anything else, or would need much more memory than it is long. Others if it is damaged.

    Example:
        >>> loads(b"(lp0\\nVknob\\np1\\na.")
        ['knob']
    """
    found = _Machine().run(content)
    _check_size(found, GROWTH * len(content) + SLACK_BYTES)
    return found


class _Unfinished:
    """An array or a type whose parts the file has not given yet."""

    def __init__(self, finish: Callable[[Any], Any]) -> None:
        self.finish = finish
        self.places: list[int] = []
        """where the file has noted it for later use"""


class _Machine:
    """The machine that builds the content of a pickle."""

    def __init__(self) -> None:
        self._stack: list[Any] = []
        self._memo: dict[int, Any] = {}

    def run(self, content: bytes) -> Any:
        stack = self._stack
        operations: Iterator[tuple[Any, Any, Any]] = pickletools.genops(content)
        for opcode, argument, _ in operations:
            name = opcode.name
            if name in _VALUES:
                stack.append(argument)
            elif name == "MEMOIZE":
                self.note(len(self._memo))
            elif name in ("PUT", "BINPUT", "LONG_BINPUT"):
                self.note(argument)
            elif name in ("GET", "BINGET", "LONG_BINGET"):
                stack.append(self._memo[argument])
            elif name in _STEPS:
                _STEPS[name](self, argument)
            elif name not in ("PROTO", "FRAME", "STOP"):
                raise ValueError(f"the file asks for {name}")
        (found,) = stack
        return found

    def note(self, place: int) -> None:
        value = self._memo[place] = self._stack[-1]
        if isinstance(value, _Unfinished):
            value.places.append(place)

    def push(self, value: Any) -> None:
        self._stack.append(value)

    def pop(self) -> Any:
        if self._stack[-1] is _MARK:
            raise ValueError("a value is missing")
        return self._stack.pop()

    def popped(self, count: int) -> tuple[Any, ...]:
        return tuple(self.pop() for _ in range(count))[::-1]

    def since_mark(self) -> list[Any]:
        """The values from the last mark on, taken from the stack with it."""
        start = next(index for index in range(len(self._stack) - 1, -1, -1) if self._stack[index] is _MARK)
        values = self._stack[start + 1 :]
        del self._stack[start:]
        return values

    def append(self, values: list[Any]) -> None:
        _of_type(self._stack[-1], list).extend(values)

    def set_items(self, values: list[Any]) -> None:
        _of_type(self._stack[-1], dict).update(_pairs(values))

    def add(self, values: list[Any]) -> None:
        _of_type(self._stack[-1], set).update(map(_key, values))

    def name(self) -> None:
        name, module = self.pop(), self.pop()
        self.push(_function(module, name))

    def call(self) -> None:
        arguments, function = self.pop(), self.pop()
        if function not in _FUNCTIONS.values():
            raise ValueError("the file calls what is not a function")
        self.push(function(*_of_type(arguments, tuple)))

    def build(self) -> None:
        state, unfinished = self.pop(), _of_type(self.pop(), _Unfinished)
        finished = unfinished.finish(_of_type(state, tuple))
        for place in unfinished.places:
            self._memo[place] = finished
        self.push(finished)


_STEPS: dict[str, Callable[[_Machine, Any], None]] = {
    "NONE": lambda machine, _: machine.push(None),
    "NEWTRUE": lambda machine, _: machine.push(True),
    "NEWFALSE": lambda machine, _: machine.push(False),
    "MARK": lambda machine, _: machine.push(_MARK),
    "EMPTY_LIST": lambda machine, _: machine.push([]),
    "EMPTY_DICT": lambda machine, _: machine.push({}),
    "EMPTY_TUPLE": lambda machine, _: machine.push(()),
    "EMPTY_SET": lambda machine, _: machine.push(set()),
    "TUPLE1": lambda machine, _: machine.push(machine.popped(1)),
    "TUPLE2": lambda machine, _: machine.push(machine.popped(2)),
    "TUPLE3": lambda machine, _: machine.push(machine.popped(3)),
    "TUPLE": lambda machine, _: machine.push(tuple(machine.since_mark())),
    "LIST": lambda machine, _: machine.push(machine.since_mark()),
    "DICT": lambda machine, _: machine.push(dict(_pairs(machine.since_mark()))),
    "FROZENSET": lambda machine, _: machine.push(frozenset(map(_key, machine.since_mark()))),
    "APPEND": lambda machine, _: machine.append([machine.pop()]),
    "APPENDS": lambda machine, _: machine.append(machine.since_mark()),
    "SETITEM": lambda machine, _: machine.set_items(list(machine.popped(2))),
    "SETITEMS": lambda machine, _: machine.set_items(machine.since_mark()),
    "ADDITEMS": lambda machine, _: machine.add(machine.since_mark()),
    "GLOBAL": lambda machine, argument: machine.push(_function(*argument.split(" ", 1))),
    "STACK_GLOBAL": lambda machine, _: machine.name(),
    "REDUCE": lambda machine, _: machine.call(),
    "BUILD": lambda machine, _: machine.build(),
}  # fmt: skip
"""What the machine does for each other opcode, with the opcode's argument."""


def _function(module: str, name: str) -> Any:
    """What stands in this machine for a function of NumPy or Python."""
    module = _of_type(module, str).replace("numpy._core", "numpy.core").replace("__builtin__", "builtins")
    found = _FUNCTIONS.get((module, _of_type(name, str)))
    if found is None:
        raise ValueError(f"the file asks for {module}.{name}")
    return found


def _dtype(code: str, *_: Any) -> _Unfinished:
    if not _CODE.fullmatch(_of_type(code, str)):
        raise ValueError(f"an array of the type {code!r}, not of numbers")
    dtype = np.dtype(code)

    def finish(state: tuple[Any, ...]) -> _Number:
        if len(state) < 2 or state[0] not in (3, 4) or state[1] not in ("<", ">", "|", "=") or state[2:8] != _PLAIN_STATE:
            raise ValueError("a type of numbers with a state of its own")
        return dtype if state[1] == "|" else dtype.newbyteorder(state[1])

    return _Unfinished(finish)


def _reconstruct(*_: Any) -> _Unfinished:
    def finish(state: tuple[Any, ...]) -> NDArray[Any]:
        _, shape, dtype, is_fortran, data = state
        return _array(data, dtype, shape, "F" if is_fortran else "C")

    return _Unfinished(finish)


def _array(data: Any, dtype: Any, shape: Any, order: Any = "C") -> NDArray[Any]:
    data = data.encode("latin-1") if isinstance(data, str) else _of_type(data, bytes | bytearray)
    shape = tuple(_of_type(size, int) for size in _of_type(shape, tuple))
    dtype = _of_type(dtype, np.dtype)
    check_size(shape, dtype, len(data))
    array = np.frombuffer(data, dtype).reshape(shape, order="F" if order == "F" else "C")
    return array.astype(dtype.newbyteorder("="))


def _scalar(dtype: Any, data: Any) -> Any:
    return _array(data, dtype, ())[()]


def _encoded(text: str, encoding: str) -> bytes:
    if encoding not in ("latin1", "latin-1"):
        raise ValueError(f"the file asks for the encoding {encoding!r}")
    return _of_type(text, str).encode("latin-1")


def _set(values: Any) -> set[Any]:
    return set(map(_key, _of_type(values, list)))


def _frozenset(values: Any) -> frozenset[Any]:
    return frozenset(_set(values))


def _empty_bytes() -> bytes:
    return b""


def _empty_dictionary() -> dict[Any, Any]:
    return {}


def _never(*_: Any) -> Any:
    raise ValueError("the file calls a class that it may only name")


_FUNCTIONS: dict[tuple[str, str], Callable[..., Any]] = {
    ("numpy", "dtype"): _dtype,
    ("numpy", "ndarray"): _never,
    ("numpy.core.multiarray", "_reconstruct"): _reconstruct,
    ("numpy.core.multiarray", "scalar"): _scalar,
    ("numpy.core.numeric", "_frombuffer"): _array,
    ("builtins", "bytes"): _empty_bytes,
    ("builtins", "set"): _set,
    ("builtins", "frozenset"): _frozenset,
    ("collections", "OrderedDict"): _empty_dictionary,
    ("_codecs", "encode"): _encoded,
}
"""By their modules and names, what stands for the functions with which NumPy and Python rebuild plain data."""


def _of_type(value: Any, kind: Any) -> Any:
    if not isinstance(value, kind):
        raise ValueError(f"{type(value).__name__} where {getattr(kind, '__name__', kind)} is expected")
    return value


def _key(value: Any) -> Any:
    """A key of a dictionary: nothing that takes long to be hashed."""
    return _of_type(value, str | bytes | int | float | None)


def _pairs(values: list[Any]) -> list[tuple[Any, Any]]:
    return [(_key(key), value) for key, value in zip(values[::2], values[1::2], strict=True)]


def _check_size(content: Any, most_bytes: int) -> None:
    """Refuse content that would need too much memory with everything that it repeats written out, or that holds itself."""
    sizes: dict[int, int] = {}
    begun: set[int] = set()
    waiting = [content]
    while waiting:
        value = waiting[-1]
        held = value.values() if isinstance(value, dict) else value if isinstance(value, _CONTAINERS) else ()
        inner = [one for one in held if type(one) not in _SMALL]
        unknown = [one for one in inner if id(one) not in sizes]
        if id(value) not in sizes and unknown:
            if any(id(one) in begun for one in (value, *unknown)):
                raise ValueError("a list that holds itself")
            begun.add(id(value))
            waiting += unknown
        else:
            small_bytes = _SMALL_BYTES * (len(held) - len(inner))
            sizes[id(value)] = _own_size(value) + small_bytes + sum(sizes[id(one)] for one in inner)
            waiting.pop()
    if sizes[id(content)] > most_bytes:
        raise ValueError(f"written out, the content needs {sizes[id(content)]} bytes")


def _own_size(value: Any) -> int:
    """What a value needs without what it holds, bytes."""
    if isinstance(value, np.ndarray):
        return value.nbytes
    if isinstance(value, str | bytes | bytearray):
        return len(value)
    if isinstance(value, (*_SMALL, *_CONTAINERS, dict, np.generic)):
        return _SMALL_BYTES
    raise ValueError(f"{type(value).__name__} where plain data is expected")
