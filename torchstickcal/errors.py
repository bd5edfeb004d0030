"""The errors a user can meet: each says what is wrong, where, what came, what was expected and the mend."""

from __future__ import annotations


class CalibrationError(ValueError):
    """Base of every error raised on purpose by torchstickcal.

    Args:
        what: the thing that is wrong, in one phrase.
        where: the argument, file or key that holds it.
        got: the offending value or shape.
        expected: what would have been accepted.
        remedy: how to mend it.
    """

    def __init__(self, what: str, *, where: str, got: object, expected: str, remedy: str = "") -> None:
        self.what, self.where, self.got, self.expected, self.remedy = what, where, got, expected, remedy
        message = f"{what} ({where}): got {got}; expected {expected}."
        super().__init__(f"{message} {remedy}" if remedy else message)


class ObservationError(CalibrationError):
    """The observations cannot be used: shapes, values, sticks, intrinsics."""


class RigError(CalibrationError):
    """The cameras do not share enough of the scene to be placed in one rig."""


class ConfigError(CalibrationError):
    """A configuration is unknown, has an unknown key or an unusable value."""


class FileFormatError(CalibrationError):
    """A file is damaged, hostile or not of the format it claims to be."""
