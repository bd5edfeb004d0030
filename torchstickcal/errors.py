"""Errors that the user can fix. Each says what is wrong, where, what was given, what was expected, and how to fix it."""

from __future__ import annotations

import pickle
from typing import Any, Self, SupportsIndex

_LONGEST_TEXT = 500


def quoted(value: object) -> object:
    """A text in quotation marks, as errors show it; every other value as it is."""
    return repr(value) if isinstance(value, str) else value


class CalibrationError(ValueError):
    """Base class of all errors that torchstickcal raises on purpose.

    Args:
        what: the problem, in one phrase.
        where: the argument, file or key with the problem.
        got: the given value or shape.
        expected: what would be accepted.
        remedy: how to fix the problem, one or more sentences.

    It can be copied and sent to other processes with all of these; ``got`` arrives as a text if it cannot be sent itself.

    Example:
        >>> import torch
        >>> from torchstickcal import CalibrationError, Observations, Stick
        >>> keypoints = torch.zeros(3, 10, 21)
        >>> try:
        ...     Observations(keypoints, torch.eye(3), Stick(19, 20, length_m=1.0))
        ... except CalibrationError as error:
        ...     print(type(error).__name__, error.where, error.got)
        ObservationError keypoints (3, 10, 21)
    """

    def __init__(self, what: str, *, where: str, got: object, expected: str, remedy: str = "") -> None:
        self.what, self.where, self.got, self.expected, self.remedy = what, where, got, expected, remedy
        message = f"{what} ({where}): got {_text(got)}; expected {expected}."
        super().__init__(f"{message} {remedy}" if remedy else message)

    def __reduce_ex__(self, protocol: SupportsIndex) -> tuple[Any, ...]:
        state = {name: value if _can_be_sent(value, protocol) else _text(value) for name, value in self.__dict__.items()}
        return _restored, (type(self), self.args, state)

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        return pickle.loads(pickle.dumps(self))


class ObservationError(CalibrationError):
    """Observations that cannot be used: shapes, values, sticks, intrinsics."""


class RigError(CalibrationError):
    """Cameras that have too few common points to be placed in one rig.

    Args:
        parts: names of the cameras of each part into which the rig falls, the smallest part first; empty where that is not the
            reason.
    """

    def __init__(self, *arguments: Any, parts: tuple[tuple[str, ...], ...] = (), **named: Any) -> None:
        super().__init__(*arguments, **named)
        self.parts = parts


class ConfigError(CalibrationError):
    """A configuration that does not exist, or has an unknown key or an invalid value."""


class FileFormatError(CalibrationError):
    """A file that is damaged, unsafe, or not in the expected format."""


class ObservationWarning(UserWarning):
    """Observations that can be used, but probably do not mean what they say."""


def _restored(kind: type[CalibrationError], arguments: tuple[Any, ...], state: dict[str, Any]) -> CalibrationError:
    """An error as it was before it was copied or sent."""
    error = kind.__new__(kind, *arguments)
    error.__dict__.update(state)
    return error


def _can_be_sent(value: object, protocol: SupportsIndex) -> bool:
    try:
        pickle.loads(pickle.dumps(value, int(protocol)))
    except Exception:  # whatever the value itself raises
        return False
    return True


def _text(value: object) -> str:
    """A value as a text of bounded length, whatever it is."""
    try:
        text = str(value)
    except Exception:  # such as for an integer of more than 4300 digits
        text = f"a value of type {type(value).__name__} that cannot be shown"
    return text if len(text) <= _LONGEST_TEXT else f"{text[:_LONGEST_TEXT]}..."
