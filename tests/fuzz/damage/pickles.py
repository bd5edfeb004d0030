"""What may happen to a pickle: to the dictionary that it holds, and to the operations that build it."""

from __future__ import annotations

import contextlib
import pickle
import pickletools
import struct
from collections.abc import Callable
from typing import Any

import numpy as np

from fuzz.damage import CANARY, Damage

DAMAGES: dict[str, Damage] = {}


def _operations(content: bytes) -> list[bytes]:
    """The bytes of each operation of a pickle. From the first damaged operation on, the rest of the bytes is one item."""
    places: list[int] = []
    with contextlib.suppress(ValueError):
        for _, _, place in pickletools.genops(content):
            places.append(place or 0)
    return [content[start:end] for start, end in zip(places, [*places[1:], len(content)], strict=True)]


def _text(text: str) -> bytes:
    return b"X" + struct.pack("<I", len(text.encode())) + text.encode()


def _int(number: int) -> bytes:
    return b"J" + struct.pack("<i", number)


def _dtype(name: str, state: bytes = b"") -> bytes:
    return b"cnumpy\ndtype\n(" + _text(name) + b"\x89\x88tR" + state


_STATE = b"(" + _int(3) + _text("|") + b"NNN" + _int(-1) + _int(-1) + _int(0) + b"tb"


def _buffer(dtype: bytes, size: int, shape: int, module: str = "numpy.core.numeric") -> bytes:
    data = b"B" + struct.pack("<I", size) + b"A" * size
    return b"c" + module.encode() + b"\n_frombuffer\n(" + data + dtype + b"(" + _int(shape) + b"t" + _text("C") + b"tR"


def _doubling(steps: int) -> bytes:
    """Tuples in tuples: of a few bytes, and of 2 ** steps things when gone through."""
    return b"K\x01" + b"2\x86" * steps


RUN = [
    b"cos\nsystem\n(" + _text(f"touch {CANARY}") + b"tR",
    b"cbuiltins\neval\n(" + _text(f"open({str(CANARY)!r}, 'w')") + b"tR",
    b"cposix\nsystem\n",
    b"cnumpy\nload\n(" + _text("x") + b"tR",
    b"ccollections\nOrderedDict\n)R(K\x01K\x02u",
    b"ccollections\nOrderedDict\n)R}(" + _text("__class__") + b"K\x01ub",
]
"""Values that run programs, or set what they should not."""

OBJECTS = [
    _buffer(_dtype("O8", _STATE), 32, 4),
    _buffer(_dtype("O8", _STATE), 32, 4, "numpy._core.numeric"),
    _dtype("f8", _STATE),
    _dtype("O8", _STATE),
    b"cnumpy.core.multiarray\nscalar\n(" + _dtype("O8") + b"C\x08AAAAAAAAtR",
    b"cnumpy._core.multiarray\nscalar\n(" + _dtype("f8") + b"C\x01AtR",
]
"""Values that take the file's bytes for objects in memory."""

SIZES = [
    b"cnumpy\nndarray\n)R",
    b"cnumpy\nndarray\n(J\xff\xff\xff\x7ftR",
    b"cnumpy.core.multiarray\n_reconstruct\n(cnumpy\nndarray\n(J\xff\xff\xff\x7ftC\x01btR",
    b"cnumpy.core.multiarray\n_reconstruct\n(cnumpy\nndarray\n(K\x00tC\x01btR(K\x01(K\x05t" + _dtype("f8") + b"\x89C\x04AAAAtb",
    _dtype("f8" * 100),
    _dtype("V2000000000"),
    _buffer(_dtype("f8"), 32, 4),
    _buffer(_dtype("f8"), 32, 10**9),
    _buffer(_dtype("f8"), 31, -1),
    _doubling(20),
    _doubling(60),
    b"]2a",
    b"}2K\x002s",
    b"]" * 1000 + b"a" * 999,
    b"\x8b\x08\x00\x00\x00AAAAAAAA",
    b"\x8e" + struct.pack("<Q", 2**40) + b"A",
    b"X\xff\xff\xff\x7fA",
    b"r\xff\xff\xff\x7f",
    b"j\xff\xff\xff\x7f",
]
"""Values that claim to be larger or smaller than they are, hold themselves, or are of endless depth."""

HOSTILE_VALUES = [*RUN, *OBJECTS, *SIZES, b"N", b"\x88", b"G" + b"\x7f" * 8]
"""Operations that leave one value, or try to."""


def _on_operations(function: Callable[[list[bytes], np.random.Generator], object]) -> Callable[..., object]:
    """Register what may happen to the operations of a pickle, given as a list to change in place."""

    def damage(content: bytes, rng: np.random.Generator) -> bytes:
        operations = _operations(content)
        function(operations, rng)
        return b"".join(operations)

    DAMAGES[function.__name__] = damage
    return function


def _on_sequence(function: Callable[[dict[str, Any], np.random.Generator], object]) -> Callable[..., object]:
    """Register what may happen to the dictionary that a pickle holds, given to change in place."""

    def damage(content: bytes, rng: np.random.Generator) -> bytes:
        data = pickle.loads(content)
        function(data, rng)
        return pickle.dumps(data, protocol=int(rng.integers(2, 5)))

    DAMAGES[function.__name__] = damage
    return function


@_on_sequence
def a_key_lost(data, rng):
    data.pop(rng.choice(list(data)))


@_on_sequence
def two_values_swapped(data, rng):
    one, other = rng.choice(list(data), 2, replace=False)
    data[one], data[other] = data[other], data[one]


@_on_sequence
def an_odd_value(data, rng):
    endless: list[Any] = []
    endless.append(endless)
    odd = [
        *(None, 0, -1, 1e308, float("nan"), 10**400, "text", b"bytes", [], {}, [[1], [1, 2]], endless, (), {"a": 1}, True),
        *(
            np.zeros(0),
            np.zeros((3, 0, 2)),
            np.array("x"),
            np.array([None]),
            np.float32(1),
            np.zeros((3, 8, 19, 3)),
            np.array(1j),
        ),
    ]
    data[rng.choice(list(data))] = odd[rng.integers(len(odd))]


@_on_sequence
def another_shape(data, rng):
    name = rng.choice([name for name, value in data.items() if isinstance(value, np.ndarray)])
    array = data[name]
    data[name] = [array[:1], array[..., :1], array.ravel(), array[None], array.T, array.tolist(), array[:0]][rng.integers(7)]


@_on_sequence
def no_dictionary(data, rng):
    data.clear()


@_on_operations
def operations_lost(operations, rng):
    for _ in range(rng.integers(1, 4)):
        operations.pop(rng.integers(len(operations)))


@_on_operations
def operations_swapped(operations, rng):
    one, other = rng.integers(len(operations), size=2)
    operations[one], operations[other] = operations[other], operations[one]


@_on_operations
def an_operation_repeated(operations, rng):
    place = rng.integers(len(operations))
    operations[place:place] = [operations[place]] * int(rng.integers(1, 50))


@_on_operations
def a_value_is_hostile(operations, rng):
    values = [
        place for place, operation in enumerate(operations) if operation[:1] in b"XCBKJGN]}\x8c\x8d\x8e\x94" and place > 1
    ]
    operations[rng.choice(values or [-1])] = HOSTILE_VALUES[rng.integers(len(HOSTILE_VALUES))]


@_on_operations
def the_first_value_is_hostile(operations, rng):
    hostile = HOSTILE_VALUES[rng.integers(len(HOSTILE_VALUES))]
    names = ["all_pose_projections_2d", "all_projection_masks", "all_observed_points_2d", "K", "stick_length", "cameras"]
    fields = [_text(name) + hostile for name in names]
    operations[:] = [b"\x80\x02}(", *fields, b"u."]


@_on_operations
def random_operations(operations, rng):
    codes = [operation.code.encode("latin1") for operation in pickletools.opcodes]
    place = rng.integers(len(operations) + 1)
    operations[place:place] = [codes[number] + rng.bytes(rng.integers(0, 5)) for number in rng.integers(len(codes), size=6)]
