"""Settings as data: dataclasses built from the tables of a configuration, with errors that name the key.

A field's type says what it may hold: ``float``, ``int``, :data:`Positive`, :data:`PositiveInt`, ``bool``, ``str``, ``Literal``,
a name of a registry, another such dataclass, lists and dictionaries of these, and unions. ``false`` stands for ``None``.
"""

from __future__ import annotations

import dataclasses
import functools
import sys
import types
import typing
from collections.abc import Sequence
from typing import Annotated, Any, Literal

from torchstickcal.errors import ConfigError
from torchstickcal.registry import Registry, suggestion

_ABOVE_ZERO = "above 0"
Positive = Annotated[float, _ABOVE_ZERO]
"""A number above 0, at most 1e9."""
PositiveInt = Annotated[int, _ABOVE_ZERO]
"""A whole number above 0, at most 1e9."""

_LARGEST = 1e9
"""No setting is larger in its unit, and larger numbers overflow when they are squared."""
_UNIONS = (types.UnionType, typing.Union)
_LONGEST_VALUE = 200
"""Characters of a value that a message shows."""


def build(kind: Any, value: Any, where: str, path: tuple[str, ...]) -> Any:
    """A value of a type, from what a configuration gives.

    Args:
        kind: the type. One that has a method ``of_table`` is built by it, with the other arguments.
        value: what is given.
        where: the configuration's name, for messages.
        path: the keys that lead to the value.

    Raises:
        ConfigError: if the type cannot hold the value.
    """
    if isinstance(kind, type) and isinstance(value, kind) and dataclasses.is_dataclass(kind):
        return value
    if hasattr(kind, "of_table"):
        return kind.of_table(value, where, path)
    if dataclasses.is_dataclass(kind):
        return build_dataclass(typing.cast(type, kind), value, where, path)
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin in _UNIONS:
        if value is False and type(None) in arguments:
            return None
        options = [option for option in arguments if option is not type(None)]
        matching = [option for option in options if _fits(option, value)]
        if matching:
            return build(matching[0], value, where, path)
    elif origin is dict and isinstance(value, dict) and all(isinstance(key, str) for key in value):
        return {key: build(arguments[1], item, where, (*path, key)) for key, item in value.items()}
    elif origin is list and isinstance(value, list | tuple):
        return [build(arguments[0], item, where, (*path, str(number))) for number, item in enumerate(value)]
    elif _fits(kind, value):
        return float(typing.cast(float, value)) if _plain(kind) is float else value
    raise _unusable(value, _description(kind), where, path, _remedy(kind, value))


def build_dataclass(kind: type, value: Any, where: str, path: tuple[str, ...]) -> Any:
    """A dataclass from a table; arguments and errors as of :func:`build`."""
    if not isinstance(value, dict):
        raise _unusable(value, "a table", where, path)
    hints, fields = _hints(kind), dataclasses.fields(kind)
    for key in value:
        check_key(key, [field.name for field in fields], where, path)
    required = [field.name for field in fields if field.default is field.default_factory is dataclasses.MISSING]
    missing = [name for name in required if name not in value]
    if missing:
        table = ".".join(path) or "top level"
        raise ConfigError(
            "missing key", where=f"{where}: {table}", got=", ".join(map(str, value)) or "nothing", expected=missing[0]
        )
    return kind(**{key: build(hints[key], item, where, (*path, key)) for key, item in value.items()})


def check_key(key: object, known: Sequence[str], where: str, path: tuple[str, ...]) -> None:
    """Raise a ConfigError for a key of a table that is not known, with the nearest known one."""
    if key not in known:
        raise ConfigError(
            "unknown key",
            where=f"{where}: {'.'.join((*path, str(key)))}",
            got=repr(key),
            expected=f"one of {', '.join(known)}",
            remedy=suggestion(str(key), known),
        )


@functools.cache
def _hints(kind: type) -> dict[str, Any]:
    """The types of a dataclass's fields."""
    return typing.get_type_hints(kind, include_extras=True)


def _unusable(value: object, expected: str, where: str, path: tuple[str, ...], remedy: str = "") -> ConfigError:
    try:
        got = repr(value)
    except (ValueError, RecursionError) as error:  # whole numbers of too many digits; lists that contain themselves
        got = f"{type(value).__name__}: {error}"
    got = got if len(got) < _LONGEST_VALUE else f"{got[:_LONGEST_VALUE]}..."
    place = ".".join(path) or "top level"
    return ConfigError("unusable value", where=f"{where}: {place}", got=got, expected=expected, remedy=remedy)


def _remedy(kind: Any, value: object) -> str:
    """The name of a registry that a misspelt one is most like."""
    registry = _annotation(kind)
    return suggestion(value, registry) if isinstance(registry, Registry) and isinstance(value, str) else ""


def _annotation(kind: Any) -> Any:
    """What is said of a type beside it: the registry whose names it stands for, or that it is above 0; None for nothing."""
    return typing.get_args(kind)[1] if typing.get_origin(kind) is Annotated else None


def _plain(kind: Any) -> Any:
    """A type without what is said beside it."""
    return typing.get_args(kind)[0] if typing.get_origin(kind) is Annotated else kind


def _fits(kind: Any, value: Any) -> bool:
    annotation = _annotation(kind)
    if isinstance(annotation, Registry):
        return isinstance(value, str) and value in annotation
    if annotation == _ABOVE_ZERO:
        return _fits(_plain(kind), value) and 0 < value <= _LARGEST
    if typing.get_origin(kind) is Literal:
        return isinstance(value, str) and value in typing.get_args(kind)
    if typing.get_origin(kind) is list:
        return isinstance(value, list | tuple)
    if dataclasses.is_dataclass(kind):
        return isinstance(value, dict | typing.cast(type, kind))
    if kind is float:
        return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= sys.float_info.max
    if kind is int:
        return isinstance(value, int) and not isinstance(value, bool)
    return isinstance(kind, type) and isinstance(value, kind)


def _description(kind: Any) -> str:
    annotation = _annotation(kind)
    if isinstance(annotation, Registry):
        return f"one of {', '.join(annotation)}"
    if annotation == _ABOVE_ZERO:
        return f"{_description(_plain(kind))} {_ABOVE_ZERO} and at most 1e9"
    if typing.get_origin(kind) is Literal:
        return " or ".join(repr(option) for option in typing.get_args(kind))
    if typing.get_origin(kind) is list:
        return f"a list of {_description(typing.get_args(kind)[0])}"
    if typing.get_origin(kind) in _UNIONS:
        return " or ".join("false" if option is type(None) else _description(option) for option in typing.get_args(kind))
    if dataclasses.is_dataclass(kind):
        return "a table"
    if typing.get_origin(kind) is dict:
        return "a table of tables, whose keys are texts"
    return {float: "a number", int: "a whole number", bool: "true or false", str: "a text"}.get(kind, str(kind))
