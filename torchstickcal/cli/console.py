"""The console: it shows what it can, and a console that is gone stops no work."""

from __future__ import annotations

import errno
import io
import os
import shutil
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from typing import TextIO

_CONTROLS = {code: f"\\x{code:02x}" for code in (*range(32), *range(127, 160)) if chr(code) not in "\n\r\t"}
"""Characters that would move the cursor or change colours, as they are shown."""


@contextmanager
def console() -> Iterator[None]:
    """A block whose output is shown as far as the console can, and is dropped once nobody reads it any more."""
    error = _Stream(sys.stderr)
    out = _Stream(sys.stdout, error)
    with redirect_stdout(out), redirect_stderr(error):
        try:
            yield
        finally:
            error.show_status("")
            error.flush()
            out.flush()


@contextmanager
def quiet() -> Iterator[None]:
    """A block that shows nothing but what goes wrong: no output, no notes, no progress."""
    with redirect_stdout(_Nothing()):
        yield


def is_quiet() -> bool:
    return isinstance(sys.stdout, _Nothing)


def note(text: str) -> None:
    """Show, beside the output, what a user should know of it."""
    if not is_quiet():
        print(f"note: {text}", file=sys.stderr)


def show_status(text: str) -> None:
    """Show a text on the last line of a terminal, in place of the one before, until something else is shown; elsewhere nothing.

    An empty text takes it away.
    """
    if isinstance(sys.stderr, _Stream) and shows_status():
        sys.stderr.show_status(text)


def shows_status() -> bool:
    """Whether there is a terminal whose last line is seen."""
    return sys.stderr.isatty() and not is_quiet()


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


class _Nothing(io.TextIOBase):
    """A text stream that goes nowhere."""

    def write(self, text: str) -> int:
        return len(text)


class _Stream(io.TextIOBase):
    """A text stream that escapes what its encoding does not have.

    Args:
        stream: where to; None for one that is closed.
        last_line: the stream that shows the last line of the terminal, which goes away before anything is written; None for
            itself.
    """

    def __init__(self, stream: TextIO | None, last_line: _Stream | None = None) -> None:
        self._stream = stream
        self._last_line = last_line or self
        self._status = ""

    def show_status(self, text: str) -> None:
        """Show a text on the last line in place of the one before; none if it is empty."""
        text = text[: shutil.get_terminal_size().columns - 1].translate(_CONTROLS)
        if text != self._status:
            self._status, line = "", f"\r{text:<{len(self._status)}}\r{text}"
            self.write(line)
            self.flush()
            self._status = text

    def write(self, text: str) -> int:
        self._last_line.show_status("")
        if self._stream is not None:
            encoding = getattr(self._stream, "encoding", None) or "utf-8"
            shown = text.translate(_CONTROLS).encode(encoding, "backslashreplace").decode(encoding)
            self._tried(lambda stream: stream.write(shown))
        return len(text)

    def write_coloured(self, word: str, colour: str) -> None:
        """Write a word of the program's own in a colour."""
        self._last_line.show_status("")
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
