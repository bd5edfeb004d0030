"""Torch's inference mode, without what it leaves in results.

In inference mode operations skip what gradients would need, and take a tenth less time. A tensor that was made there can take
no part in gradients. None of them leaves: results, and what objects keep, are made ordinary. So are the arguments of functions
that differentiate.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import fields, is_dataclass, replace
from functools import wraps
from typing import Any, ParamSpec, TypeVar

import torch
from torch import Tensor, nn

_Arguments = ParamSpec("_Arguments")
_Value = TypeVar("_Value")


def ordinary(value: _Value) -> _Value:
    """A value with ordinary tensors in the place of those that were made in inference mode.

    Tensors are looked for in tuples, dictionaries, dataclasses and modules, not in functions.

    Example:
        >>> import torch
        >>> with torch.inference_mode():
        ...     made, found = torch.zeros(2), ordinary({"made": (torch.zeros(2), 1.0)})
        >>> made.is_inference(), found["made"][0].is_inference()
        (True, False)
    """
    if not torch.is_inference_mode_enabled():
        return _ordinary(value)
    with torch.inference_mode(mode=False):
        return _ordinary(value)


def differentiates(function: Callable[_Arguments, _Value]) -> Callable[_Arguments, _Value]:
    """Decorator of a function that needs automatic differentiation inside, whatever the mode is in which it is called."""

    @wraps(function)
    def with_gradients(*arguments: _Arguments.args, **keywords: _Arguments.kwargs) -> _Value:
        if not torch.is_inference_mode_enabled():
            with torch.enable_grad():
                return function(*arguments, **keywords)
        with torch.inference_mode(mode=False), torch.enable_grad():
            return function(*ordinary(arguments), **ordinary(keywords))

    return with_gradients


def _ordinary(value: Any) -> Any:
    if value is None or isinstance(value, float | int | str):
        return value
    if isinstance(value, Tensor):
        return value.clone() if value.is_inference() else value
    if isinstance(value, dict):
        return {name: _ordinary(part) for name, part in value.items()}
    if isinstance(value, tuple):
        parts = [_ordinary(part) for part in value]
        if all(new is old for new, old in zip(parts, value, strict=True)):
            return value
        return type(value)(*parts) if hasattr(value, "_fields") else tuple(parts)
    if isinstance(value, nn.Module):
        module = copy.copy(value)
        module.__dict__.update(_ordinary(vars(value)))
        return module
    if is_dataclass(value) and not isinstance(value, type):
        parts = {field.name: getattr(value, field.name) for field in fields(value)}
        changed = {name: new for name, old in parts.items() if (new := _ordinary(old)) is not old}
        return replace(value, **changed) if changed else value
    return value
