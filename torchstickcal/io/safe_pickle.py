"""Reading pickles without running what they hold."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

from torchstickcal.errors import FileFormatError

_ADMITTED = {
    (module, name)
    for package in ("numpy.core", "numpy._core")
    for module, name in (
        (f"{package}.multiarray", "_reconstruct"),
        (f"{package}.multiarray", "scalar"),
        (f"{package}.numeric", "_frombuffer"),
    )
} | {("numpy", "ndarray"), ("numpy", "dtype"), ("collections", "OrderedDict")}


class _ArraysOnly(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        if (module, name) in _ADMITTED:
            return super().find_class(module.replace("numpy.core", "numpy._core"), name)
        raise pickle.UnpicklingError(f"it wants to load {module}.{name}")


def load(path: str | Path) -> Any:
    """The content of a pickle that holds nothing but numpy arrays and Python's plain containers, numbers and texts.

    Raises:
        FileFormatError: if the file is damaged or holds anything else, before any of it is run.
    """
    try:
        with Path(path).open("rb") as file:
            return _ArraysOnly(file).load()
    except OSError:
        raise
    except Exception as error:
        raise FileFormatError(
            "a pickle is damaged or not plain data",
            where=str(path),
            got=f"{type(error).__name__}: {error}",
            expected="numpy arrays, lists, dictionaries, numbers and texts only",
            remedy="Do not open this file with pickle.load: a pickle can run any program.",
        ) from error
