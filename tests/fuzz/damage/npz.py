"""What may happen to the members of an .npz file, and to what it says of them."""

from __future__ import annotations

import io
import pickle
import re
import struct
import zipfile
from collections.abc import Callable
from typing import Any

import numpy as np

from fuzz.damage import Damage, Program

DAMAGES: dict[str, Damage] = {}


def _members(content: bytes) -> dict[str, bytes]:
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def _archive(members: dict[str, bytes]) -> bytes:
    written = io.BytesIO()
    with zipfile.ZipFile(written, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, member in members.items():
            archive.writestr(name, member)
    return written.getvalue()


def _damage(function: Damage) -> Damage:
    DAMAGES[function.__name__] = function
    return function


def _on_members(function: Callable[[dict[str, bytes], np.random.Generator], object]) -> Callable[..., object]:
    """Register what may happen to the members of an archive, given by name to change in place."""

    def damage(content: bytes, rng: np.random.Generator) -> bytes:
        members = _members(content)
        function(members, rng)
        return _archive(members)

    DAMAGES[function.__name__] = damage
    return function


def _npy(array: Any, **options: Any) -> bytes:
    written = io.BytesIO()
    np.lib.format.write_array(written, np.asanyarray(array), **options)
    return written.getvalue()


def _header(text: str, version: bytes = b"\x01\x00") -> bytes:
    size = struct.pack("<H" if version[0] == 1 else "<I", len(text) + 1)
    return b"\x93NUMPY" + version + size + text.encode() + b"\n"


@_on_members
def a_member_lost(members, rng):
    members.pop(rng.choice(list(members)))


@_on_members
def two_members_swapped(members, rng):
    one, other = rng.choice(list(members), 2, replace=False)
    members[one], members[other] = members[other], members[one]


@_on_members
def a_member_renamed(members, rng):
    members[rng.choice(["x.npy", "../up.npy", "keypoints", "meta.npy", "a" * 60000])] = members.pop(rng.choice(list(members)))


@_on_members
def a_member_is_another_array(members, rng):
    arrays = [
        *(
            np.zeros(()),
            np.zeros(0),
            np.zeros((1, 1, 1, 1)),
            np.zeros((3, 8, 21, 3)),
            np.full((3, 3), np.nan),
            np.array("text"),
        ),
        *(np.array([b"x"]), np.array([1 + 2j]), np.array(["2020"], "datetime64[s]"), np.zeros(3, [("a", "f8"), ("b", "i4")])),
        *(
            np.zeros((3, 3), ">f4"),
            np.zeros((3, 3), "float16"),
            np.array(2**63, "u8"),
            np.array([-1, 10**18]),
            np.array([1e308]),
        ),
        *(np.zeros((0, 3, 3)), np.zeros((2, 0)), np.array(["\ud800"]), np.array(True), np.array("{}"), np.array("[" * 100000)),
    ]
    members[rng.choice(list(members))] = _npy(arrays[rng.integers(len(arrays))])


@_on_members
def a_member_has_another_shape(members, rng):
    name = rng.choice(list(members))
    array = np.lib.format.read_array(io.BytesIO(members[name]), allow_pickle=False)
    shapes = [
        array.ravel(),
        array[None],
        array[..., None],
        array.T,
        array.ravel()[:1],
        array.ravel()[:0],
        np.stack([array, array]),
    ]
    members[name] = _npy(shapes[rng.integers(len(shapes))])


@_on_members
def a_member_has_other_values(members, rng):
    name = rng.choice(list(members))
    array = np.lib.format.read_array(io.BytesIO(members[name]), allow_pickle=False)
    if array.dtype.kind in "fi" and array.size:
        odd = [0, -1, 1e308, 1e18, np.nan, np.inf] if array.dtype.kind == "f" else [0, -1, 2**62, -(2**62)]
        array[rng.random(array.shape) < rng.choice([0.1, 1.0])] = odd[rng.integers(len(odd))]
    members[name] = _npy(array)


@_on_members
def a_member_holds_a_program(members, rng):
    members[rng.choice(list(members))] = _npy(np.array([Program()], dtype=object), allow_pickle=True)


@_on_members
def a_member_claims_to_be_huge(members, rng):
    shapes = ["(1000000000000,)", "(100000, 100000)", "(-1,)", "(3, -8)", "(18446744073709551616,)", "(0, 1000000000000)"]
    dtypes = ["<f8", "<U1000000", "V1000000000", "|b1"]
    shape, dtype = shapes[rng.integers(len(shapes))], dtypes[rng.integers(len(dtypes))]
    text = f"{{'descr': '{dtype}', 'fortran_order': False, 'shape': {shape}, }}"
    members[rng.choice(list(members))] = _header(text) + bytes(64)


@_on_members
def a_member_has_an_odd_header(members, rng):
    texts = [
        *(
            "",
            "{",
            "{}",
            "[]",
            "(" * 300,
            "[" * 3000,
            "{'descr': '<f8'}",
            "{'descr': 1, 'fortran_order': 2, 'shape': 3}",
            "\x00" * 50,
        ),
        *(
            "{'descr': '|O', 'fortran_order': False, 'shape': (1,), }",
            "{'descr': '<f8', 'fortran_order': False, 'shape': (1e3,)}",
        ),
        *("{'descr': [('a', '<f8', (1000000,))], 'fortran_order': False, 'shape': (1000000,)}", "__import__('os')", "é" * 20),
    ]
    version = [b"\x01\x00", b"\x02\x00", b"\x03\x00", b"\x09\x09"][rng.integers(4)]
    members[rng.choice(list(members))] = _header(texts[rng.integers(len(texts))], version) + bytes(64)


@_on_members
def a_member_is_no_array(members, rng):
    members[rng.choice(list(members))] = [b"", b"text", b"\x93NUMPY", pickle.dumps(Program())][rng.integers(4)]


@_on_members
def a_member_more_that_nobody_needs_and_that_unpacks_to_256_mb(members, rng):
    members["unneeded.npy"] = _header(f"{{'descr': '|u1', 'fortran_order': False, 'shape': ({1 << 28},), }}") + bytes(1 << 28)


@_on_members
def thousands_of_members(members, rng):
    members |= {f"a{number}.npy": _npy(0) for number in range(3000)}


@_damage
def another_way_of_packing(content, rng):
    method, flags = rng.choice([12, 14, 99]), rng.choice([0, 1, 0x2000])
    changed = bytearray(content)
    for signature, at in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        for found in re.finditer(re.escape(signature), content):
            struct.pack_into("<HH", changed, found.start() + at, flags, method)
    return bytes(changed)


@_damage
def sizes_of_members_changed(content, rng):
    changed = bytearray(content)
    for found in re.finditer(b"PK\x01\x02", content):
        struct.pack_into("<I", changed, found.start() + rng.choice([16, 20, 24, 42]), int(rng.integers(0, 2**32)))
    return bytes(changed)
