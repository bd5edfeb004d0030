"""The executor of a Dask cluster."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import contextmanager

from torchstickcal.errors import CalibrationError


@contextmanager
def cluster_executor(address: str) -> Iterator[Executor]:
    """The executor of the Dask cluster whose scheduler has an address, such as ``tcp://10.0.0.1:8786``.

    Every worker needs this package and the same files at the same paths.

    Raises:
        CalibrationError: if the package ``distributed`` is not installed, or if the scheduler does not answer.
    """
    try:
        from distributed import Client  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise CalibrationError(
            "a cluster needs the package distributed",
            where="cluster",
            got=str(error),
            expected="Dask",
            remedy="Install it with `pip install 'torchstickcal[cluster]'`.",
        ) from error
    try:
        client = Client(address)
    except (OSError, ValueError) as error:
        got = f"{type(error).__name__}: {error}"
        expected = "the address of a Dask scheduler that runs, such as tcp://10.0.0.1:8786"
        raise CalibrationError("the cluster does not answer", where=f"cluster {address}", got=got, expected=expected) from error
    with client, client.get_executor(pure=False) as executor:
        yield executor
