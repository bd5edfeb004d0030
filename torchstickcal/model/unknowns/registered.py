"""The registered unknowns, and the names by which configurations refine them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, TypeVar

from torchstickcal.model.unknowns.base import CameraUnknown, Sharing
from torchstickcal.model.unknowns.trial import try_unknown
from torchstickcal.registry import Registry


class Refinement(NamedTuple):
    """What a name in a configuration's ``refine`` stands for."""

    unknown: CameraUnknown
    sharing: Sharing


REFINEMENTS = Registry[Refinement]("camera parameter", "torchstickcal.model.unknowns")
"""What may be refined, by the names that configurations use."""


_Unknown = TypeVar("_Unknown", bound=CameraUnknown)


def register_unknown(unknown: type[_Unknown], *, replace: bool = False) -> type[_Unknown]:
    """Class decorator: make an unknown known under the names of its :attr:`CameraUnknown.variants`.

    Args:
        unknown: the class.
        replace: whether the names may already be taken, as when a notebook's cell runs again.

    Raises:
        ConfigError: if a name is taken, or if the unknown, tried on some cameras, does not do what :class:`CameraUnknown` says.
    """
    instance = unknown()
    try_unknown(instance, [refinement.unknown for refinement in REFINEMENTS.registered().values()], replace)
    for name, sharing in unknown.variants.items():
        REFINEMENTS.register(name, Refinement(instance, sharing), replace=replace)
    return unknown


def all_unknowns() -> dict[str, CameraUnknown]:
    """Every registered unknown, by its name."""
    return {refinement.unknown.name: refinement.unknown for refinement in REFINEMENTS.values()}


def clock_refinements() -> set[str]:
    """The refinements that say when a camera exposed its images."""
    return {name for name, refinement in REFINEMENTS.items() if refinement.unknown.family == "clock"}


def with_refinements(names: Sequence[str], more: Sequence[str]) -> tuple[str, ...]:
    """Refinements with others added. Where an unknown is refined in two variants, own values take the place of shared ones."""
    together = [REFINEMENTS[name] for name in {*names, *more}]
    own = {refinement.unknown.name for refinement in together if refinement.sharing is not Sharing.GROUP}

    def kept(name: str) -> bool:
        refinement = REFINEMENTS[name]
        return refinement in together and (refinement.sharing is not Sharing.GROUP or refinement.unknown.name not in own)

    return tuple(filter(kept, REFINEMENTS))
