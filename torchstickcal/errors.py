"""Errors that the user can fix. Each says what is wrong, where, what was given, what was expected, and how to fix it."""

from __future__ import annotations


class CalibrationError(ValueError):
    """Base class of all errors that torchstickcal raises on purpose.

    Args:
        what: the problem, in one phrase.
        where: the argument, file or key with the problem.
        got: the given value or shape.
        expected: what would be accepted.
        remedy: how to fix the problem, one or more sentences.

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
        message = f"{what} ({where}): got {got}; expected {expected}."
        super().__init__(f"{message} {remedy}" if remedy else message)


class ObservationError(CalibrationError):
    """Observations that cannot be used: shapes, values, sticks, intrinsics."""


class RigError(CalibrationError):
    """Cameras that have too few common points to be placed in one rig."""


class ConfigError(CalibrationError):
    """A configuration that does not exist, or has an unknown key or an invalid value."""


class FileFormatError(CalibrationError):
    """A file that is damaged, unsafe, or not in the expected format."""
