"""Losses by the names that configurations use: how a stage's table becomes a loss of a session."""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, TypeVar

from torch import Tensor

from torchstickcal.errors import ConfigError
from torchstickcal.losses.base import Loss
from torchstickcal.registry import Registry


@dataclass(frozen=True)
class LossContext:
    """What a loss may take from the sessions that it is built for, and from where their estimate stands.

    Args:
        point: gives the index of a named point; raises ObservationError if no point has the name.
        stick_sigma_m: (S,), tolerances of the sticks' lengths, metres.
        sigma_px: (B, P), estimated noise of each point's keypoints, pixels.
        correlation_frames: gives the numbers (B, P) of keypoints that count as one, because their errors are alike; for
            ``estimated``, or for a number of frames.
        acceleration_m: estimates (B, F - 2, P), the standard deviation of each point's second difference over frames, metres.
    """

    point: Callable[[str], int]
    stick_sigma_m: Tensor
    sigma_px: Tensor
    correlation_frames: Callable[[float | str], Tensor]
    acceleration_m: Callable[[], Tensor]


class LossSettings(ABC):
    """The settings of a loss, as a stage's table in a configuration gives them: a frozen dataclass with a default for each.

    :mod:`torchstickcal.settings` lists the types that a setting can have.
    """

    loss: ClassVar[type[Loss]]
    """what is built"""

    @abstractmethod
    def build(self, context: LossContext) -> Loss:
        """The loss."""


LOSSES = Registry[type[LossSettings]]("loss", "torchstickcal.losses")
"""Settings of losses by the name that configurations use."""


_Settings = TypeVar("_Settings", bound=LossSettings)


def register_loss(name: str, *, replace: bool = False) -> Callable[[type[_Settings]], type[_Settings]]:
    """Class decorator: make the settings of a loss known under a name, which any stage can then use.

    Args:
        name: the key in a stage's table.
        replace: whether the name may already be taken, as when a notebook's cell runs again.

    Raises:
        ConfigError: if the name is taken, or if what is decorated are not the settings of a loss.
    """
    if not isinstance(name, str):
        raise ConfigError(
            "a loss needs a name", where="register_loss", got=repr(name), expected='@register_loss("name"), above the settings'
        )

    def register(settings: type[_Settings]) -> type[_Settings]:
        is_settings = isinstance(settings, type) and issubclass(settings, LossSettings) and dataclasses.is_dataclass(settings)
        if not is_settings or not issubclass(getattr(settings, "loss", object), Loss):
            raise ConfigError(
                "not the settings of a loss",
                where=f"register_loss {name!r}",
                got=getattr(settings, "__name__", repr(settings)),
                expected="a subclass of LossSettings that is a dataclass, with the class of its loss as `loss`",
                remedy="The order is @register_loss(...), @dataclass(frozen=True), class.",
            )
        LOSSES.register(name, settings, replace=replace)
        return settings

    return register
