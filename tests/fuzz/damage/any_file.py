"""What may happen to the bytes of any file."""

from __future__ import annotations

from fuzz.damage import Damage

DAMAGES: dict[str, Damage] = {}


def _damage(function: Damage) -> Damage:
    DAMAGES[function.__name__] = function
    return function


@_damage
def bytes_flipped(content, rng):
    changed = bytearray(content)
    for _ in range(rng.integers(1, 20)):
        changed[rng.integers(len(changed))] ^= int(rng.integers(1, 256))
    return bytes(changed)


@_damage
def cut_short(content, rng):
    return content[: rng.integers(len(content) + 1)]


@_damage
def beginning_lost(content, rng):
    return content[rng.integers(1, 64) :]


@_damage
def a_piece_lost(content, rng):
    start = rng.integers(len(content) + 1)
    return content[:start] + content[start + rng.integers(1, 500) :]


@_damage
def a_piece_zeroed(content, rng):
    start, size = rng.integers(len(content) + 1), int(rng.integers(1, 500))
    return content[:start] + bytes(size) + content[start + size :]


@_damage
def a_piece_twice(content, rng):
    start, size = rng.integers(len(content) + 1), int(rng.integers(1, 500))
    return content[: start + size] + content[start:]


@_damage
def garbage_inserted(content, rng):
    start = rng.integers(len(content) + 1)
    return content[:start] + rng.bytes(rng.integers(1, 100)) + content[start:]


@_damage
def twice_in_a_row(content, rng):
    return content + content


@_damage
def nothing_but_its_start(content, rng):
    return content[:4] + rng.bytes(500)
