"""What can be found of a result: one file for each family of findings, and those that a user's own module adds."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

from torchstickcal.errors import ConfigError
from torchstickcal.quality.evidence import Evidence
from torchstickcal.quality.finding import Finding
from torchstickcal.registry import Registry

Look = Callable[[Evidence], Iterable[Finding]]
"""A function that looks at a session where its calibration ended, and gives what it finds."""


@dataclass(frozen=True)
class Family:
    """Findings of one kind.

    Args:
        description: one line, for lists.
        look: finds them.
        tries: whether it tries to explain what others found. It is asked only where something is wrong.
        small: whether its findings are small errors, found by linearising. They are not said where a trial finds a larger one.
        direct: whether its causes follow from what was given, however wrong the result is. They are not tried again.
    """

    description: str
    look: Look
    tries: bool = False
    small: bool = False
    direct: bool = False


FAMILIES: Registry[Family] = Registry("family of findings", "torchstickcal.quality.findings")
"""The families of findings, by name."""


def findings(
    name: str, description: str, *, tries: bool = False, small: bool = False, direct: bool = False, replace: bool = False
) -> Callable[[Look], Look]:
    """Register a function that makes findings, as a decorator.

    Args:
        name: of the family.
        description: one line, for lists.
        tries: whether it tries to explain what others found. It is asked only where the verdict is poor or failed.
        small: whether its findings are small errors, found by linearising. They are not said where a trial finds a larger one.
        direct: whether its causes follow from what was given, however wrong the result is. They are not tried again.
        replace: whether it may take the place of another of that name.

    Raises:
        ConfigError: if the name is taken, or what is decorated is no function.

    Example::

        @findings("slow", "sessions of a low frame rate")
        def slow(evidence):
            if (evidence.observations.fps or 100) < 25:
                yield Finding("low_frame_rate", Severity.CAUTION, "The frame rate is low.")
    """

    def register(look: Look) -> Look:
        if not callable(look):
            raise ConfigError("not a function", where=f"findings({name!r})", got=look, expected="a function of an Evidence")
        FAMILIES.register(name, Family(description, look, tries, small, direct), replace=replace)
        return look

    return register
