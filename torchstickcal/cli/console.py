"""The console: it shows what it can, and a console that is gone stops no work."""

from __future__ import annotations

import errno
import io
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from typing import TextIO

_CONTROLS = {code: f"\\x{code:02x}" for code in (*range(32), *range(127, 160)) if chr(code) not in "\n\r\t"}
"""Characters that would move the cursor or change colours, as they are shown."""


@contextmanager
def console() -> Iterator[None]:
    """A block whose output is shown as far as the console can, and is dropped once nobody reads it any more."""
    out, error = _Stream(sys.stdout), _Stream(sys.stderr)
    with redirect_stdout(out), redirect_stderr(error):
        try:
            yield
        finally:
            error.flush()
            out.flush()


def print_coloured(before: str, word: str, colour: str, after: str) -> None:
    """Print a line with one coloured word on a terminal, without the colour elsewhere.

    Args:
        before: text before the word.
        word: the word.
        colour: parameters of the terminal's sequence SGR, such as ``31``.
        after: text after it.
    """
    print(before, end="")
    if isinstance(sys.stdout, _Stream) and sys.stdout.isatty():
        sys.stdout.write_coloured(word, colour)
    else:
        print(word, end="")
    print(after)


class _Stream(io.TextIOBase):
    """A text stream that escapes what its encoding does not have; None for one that is closed."""

    def __init__(self, stream: TextIO | None) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        if self._stream is not None:
            encoding = getattr(self._stream, "encoding", None) or "utf-8"
            shown = text.translate(_CONTROLS).encode(encoding, "backslashreplace").decode(encoding)
            self._tried(lambda stream: stream.write(shown))
        return len(text)

    def write_coloured(self, word: str, colour: str) -> None:
        """Write a word of the program's own in a colour."""
        self._tried(lambda stream: stream.write(f"\x1b[{colour}m{word}\x1b[0m"))

    def flush(self) -> None:
        self._tried(lambda stream: stream.flush())

    def isatty(self) -> bool:
        return self._stream is not None and self._stream.isatty()

    def fileno(self) -> int:
        if self._stream is None:
            raise io.UnsupportedOperation("the stream is closed")
        return self._stream.fileno()

    def _tried(self, action: Callable[[TextIO], object]) -> None:
        """Write something; if it cannot be written, write nothing from now on.

        Raises:
            OSError: if it cannot be written for another reason than that nobody reads it.
        """
        if self._stream is None:
            return
        try:
            action(self._stream)
        except OSError as error:
            _empty(self._stream)
            self._stream = None
            if error.errno not in (errno.EPIPE, errno.EINVAL):  # Windows says EINVAL of a closed pipe
                raise


def _empty(stream: TextIO) -> None:
    """Have a stream's last characters go nowhere, so that Python does not fail to write them when it ends."""
    try:
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, stream.fileno())
        os.close(null)
    except (OSError, ValueError):
        pass
