"""What may happen to a TOML file: to its lines, values and encoding."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from fuzz.damage import Damage

DAMAGES: dict[str, Damage] = {}

ODD_TEXTS = [
    *(
        "0",
        "-1",
        "nan",
        "inf",
        "1e308",
        "1" + "0" * 400,
        "1" + "0" * 5000,
        "true",
        '""',
        '"text"',
        "[]",
        "[[]]",
        "{}",
        "2020-01-01",
    ),
    *(
        "[1, 'a']",
        "[1e308, 1e308, 1e308]",
        "[nan, nan, nan]",
        "[0, 0, 0]",
        "[1, 2]",
        "[[1, 0, 0], [0, 1, 0]]",
        "[" * 3000 + "]" * 3000,
    ),
    *('"\\u0000"', '"\\uD800"', '"' + "a" * 100000 + '"', "[{}]", "0x10", "'''", "#", "= ="),
]


def _damage(function: Damage) -> Damage:
    DAMAGES[function.__name__] = function
    return function


def _on_lines(function: Callable[[list[str], np.random.Generator], object]) -> Callable[..., object]:
    """Register what may happen to the lines of a text, given as a list to change in place."""

    def damage(content: bytes, rng: np.random.Generator) -> bytes:
        lines = content.decode().splitlines(keepends=True)
        function(lines, rng)
        return "".join(lines).encode()

    DAMAGES[function.__name__] = damage
    return function


@_on_lines
def a_line_lost(lines, rng):
    lines.pop(rng.integers(len(lines)))


@_on_lines
def a_line_twice(lines, rng):
    place = rng.integers(len(lines))
    lines.insert(place, lines[place])


@_on_lines
def lines_swapped(lines, rng):
    one, other = rng.integers(len(lines), size=2)
    lines[one], lines[other] = lines[other], lines[one]


@_on_lines
def an_odd_text(lines, rng):
    place = rng.choice([number for number, line in enumerate(lines) if "=" in line])
    lines[place] = f"{lines[place].split('=')[0]}= {ODD_TEXTS[rng.integers(len(ODD_TEXTS))]}\n"


@_on_lines
def a_table_is_a_value(lines, rng):
    lines.insert(0, f"cam_9 = {ODD_TEXTS[rng.integers(len(ODD_TEXTS))]}\n")


@_damage
def another_encoding(content, rng):
    encodings = ["utf-16", "utf-32", "utf-8-sig", "latin1", "cp037"]
    return ("# é\n" + content.decode()).encode(encodings[rng.integers(len(encodings))], "replace")
