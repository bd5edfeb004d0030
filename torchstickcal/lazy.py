"""Values that are computed when they are first needed, without a lock."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Generic, TypeVar, overload

from torch import Tensor

from torchstickcal.inference import ordinary

_Value = TypeVar("_Value")


class cached_property(Generic[_Value]):  # noqa: N801 as functools.cached_property
    """A property that is computed once for each object.

    ``functools.cached_property`` of Python 3.11 holds a lock while it computes. A process that is forked meanwhile inherits the
    lock, but not the thread that would release it, and waits forever. This one has no lock, as from Python 3.12 on: two threads
    that first need a value at the same time both compute it. A tensor that is kept can take part in gradients.

    Example:
        >>> class Square:
        ...     side_m = 3.0
        ...     @cached_property
        ...     def area_m2(self):
        ...         print("computed")
        ...         return self.side_m**2
        >>> square = Square()
        >>> square.area_m2, square.area_m2
        computed
        (9.0, 9.0)
    """

    def __init__(self, function: Callable[[Any], _Value]) -> None:
        self._function = function
        self.__doc__ = function.__doc__

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = name

    @overload
    def __get__(self, instance: None, owner: type) -> cached_property[_Value]: ...
    @overload
    def __get__(self, instance: object, owner: type) -> _Value: ...
    def __get__(self, instance: object | None, owner: type) -> Any:
        if instance is None:
            return self
        value = self._function(instance)
        value = ordinary(value) if isinstance(value, Tensor) else value
        instance.__dict__[self._name] = value  # looked up before this descriptor from now on
        return value
