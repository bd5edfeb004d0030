"""Files: written completely or not at all, and TOML as any editor saves it."""

from __future__ import annotations

import os
import tempfile
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """A temporary path in the folder of ``path``. It replaces ``path`` if the block succeeds, and is deleted otherwise."""
    path = Path(path)
    descriptor, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    os.close(descriptor)
    temporary = Path(name)
    try:
        yield temporary
        temporary.chmod(0o666 & ~_umask())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def parse_toml(content: bytes) -> dict[str, Any]:
    r"""The tables of a TOML file in UTF-8, with or without a byte order mark.

    Raises:
        ValueError: if it is not such a file; the message says why.

    Example:
        >>> parse_toml(b"\xef\xbb\xbf[cam_0]\nsize = [640, 480]")
        {'cam_0': {'size': [640, 480]}}
    """
    try:
        return tomllib.loads(content.decode("utf-8-sig"))
    except UnicodeDecodeError as error:
        raise ValueError(f"a byte at position {error.start} that is not UTF-8; save the file as UTF-8") from error
    except RecursionError as error:
        raise ValueError("brackets within brackets, too many to be read") from error


def _umask() -> int:
    """The umask of this process, which can only be read by setting it."""
    mask = os.umask(0)
    os.umask(mask)
    return mask
