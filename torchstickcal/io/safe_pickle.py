"""Pickle files, read without running the code that they may contain."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

from torchstickcal.errors import FileFormatError

_ALLOWED = {
    (module, name)
    for package in ("numpy.core", "numpy._core")
    for module, name in (
        (f"{package}.multiarray", "_reconstruct"),
        (f"{package}.multiarray", "scalar"),
        (f"{package}.numeric", "_frombuffer"),
    )
} | {("numpy", "ndarray"), ("numpy", "dtype"), ("collections", "OrderedDict")}
"""The functions and classes that a file may use: those with which NumPy rebuilds arrays."""


class _ArraysOnly(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        if (module, name) in _ALLOWED:
            return super().find_class(module.replace("numpy.core", "numpy._core"), name)
        raise pickle.UnpicklingError(f"the file asks for {module}.{name}")


def load(path: str | Path) -> Any:
    """The content of a pickle file that holds only plain data.

    Args:
        path: of the file.

    Returns:
        NumPy arrays, lists, tuples, dictionaries, numbers and strings, as they were saved.

    Raises:
        FileFormatError: if the file is damaged, or asks for any other class or function; none of it is run.
        OSError: if the file cannot be opened.

    Example:
        >>> import pathlib, pickle, tempfile
        >>> from torchstickcal.io import safe_pickle
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = pathlib.Path(folder, "data.pkl")
        ...     _ = path.write_bytes(pickle.dumps({"length_m": 1.2}))
        ...     safe_pickle.load(path)
        {'length_m': 1.2}
    """
    try:
        with Path(path).open("rb") as file:
            return _ArraysOnly(file).load()
    except OSError:
        raise
    except Exception as error:
        raise FileFormatError(
            "a pickle file is damaged or holds more than plain data",
            where=str(path),
            got=f"{type(error).__name__}: {error}",
            expected="only NumPy arrays, lists, dictionaries, numbers and strings",
            remedy="Do not open this file with pickle.load: that can run any program.",
        ) from error
