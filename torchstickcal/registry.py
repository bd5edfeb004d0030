"""Things found by name: those in a folder of the package, and those that a user's own module adds.

One file in the right folder is all that a new loss, camera unknown, file format, sport or comparison method needs: the folder's
modules are imported when a name is first looked up, and register what they define.
"""

from __future__ import annotations

import difflib
import importlib
import pkgutil
import sys
import threading
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, TypeVar

from torchstickcal.errors import ConfigError

_Thing = TypeVar("_Thing")

_being_imported: set[str] = set()
"""The folders whose modules are being imported by a registry."""


class Registry(Mapping[str, _Thing]):
    """A mapping from names to things of one kind.

    Args:
        kind: what is registered, in the singular, for messages.
        folder: dotted name of the package whose modules register the things that are shipped.

    Example:
        >>> units = Registry[float]("unit", "torchstickcal.configs")
        >>> units.register("inch", 0.0254)
        0.0254
        >>> units["inch"], list(units)
        (0.0254, ['inch'])
    """

    def __init__(self, kind: str, folder: str) -> None:
        self.kind = kind
        self._folder = folder
        self._things: dict[str, _Thing] = {}
        self._imported = False
        self._importing: set[int] = set()
        """threads that import the folder's modules; another one waits for each module until it is complete, as Python has it"""

    def register(self, name: str, thing: _Thing, *, replace: bool = False) -> _Thing:
        """Add a thing under a name; returns the thing.

        Args:
            name: what it is found by.
            thing: what is found.
            replace: whether it may take the place of another of that name, as when a notebook's cell runs again.

        Raises:
            ConfigError: if the name is taken.
        """
        if not self._is_being_imported():
            self._import_shipped()
        if name in self._things and not replace:
            raise ConfigError(
                "the name is taken",
                where=f"register: {self.kind}",
                got=repr(name),
                expected="another name, or replace=True",
            )
        self._things[name] = thing
        return thing

    def registered(self) -> dict[str, _Thing]:
        """What has been registered so far, whether or not the folder's modules have all been imported."""
        return dict(self._things)

    def __getitem__(self, name: str) -> _Thing:
        """The thing of a name.

        Raises:
            ConfigError: if there is none, with the names that there are.
        """
        self._import_shipped()
        if name not in self._things:
            raise ConfigError(
                f"unknown {self.kind}",
                where=self.kind,
                got=repr(name),
                expected=f"one of {', '.join(self._things)}",
                remedy=suggestion(name, self._things),
            )
        return self._things[name]

    def get(self, name: str, default: Any = None) -> Any:
        """The thing of a name, or a default if there is none."""
        self._import_shipped()
        return self._things.get(name, default)

    def __contains__(self, name: object) -> bool:
        self._import_shipped()
        return name in self._things

    def __iter__(self) -> Iterator[str]:
        self._import_shipped()
        return iter(tuple(self._things))

    def __len__(self) -> int:
        self._import_shipped()
        return len(self._things)

    def __eq__(self, other: object) -> bool:
        return self is other

    def __hash__(self) -> int:
        return id(self)

    def _import_shipped(self) -> None:
        """Import the folder's modules, in the order of their names; they register what they define."""
        thread = threading.get_ident()
        if self._imported or thread in self._importing:
            return
        self._importing.add(thread)
        outermost = self._folder not in _being_imported
        _being_imported.add(self._folder)
        try:
            package = importlib.import_module(self._folder)
            for name in sorted(module.name for module in pkgutil.iter_modules(package.__path__)):
                importlib.import_module(f"{self._folder}.{name}")
            self._imported = True
        finally:
            self._importing.discard(thread)
            if outermost:
                _being_imported.discard(self._folder)

    def _is_being_imported(self) -> bool:
        """Whether the folder's modules are being imported, so that one of them may be registering what it defines.

        Importing the others then would give an incomplete module to those that build on the one that is registering.
        """
        package = getattr(sys.modules.get(self._folder), "__spec__", None)
        return self._folder in _being_imported or getattr(package, "_initializing", False)


def suggestion(name: str, known: Iterable[str], cutoff: float = 0.6) -> str:
    """The known name most like a misspelt one, as a question; empty if none is similar, from 0 to 1, by ``cutoff``."""
    near = difflib.get_close_matches(name, list(known), n=1, cutoff=cutoff)
    return f"Did you mean {near[0]!r}?" if near else ""
