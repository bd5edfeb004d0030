"""The command line. What needs torch is imported when a command runs, so that help and usage errors appear at once."""

from __future__ import annotations

import os
import signal
import sys
import traceback
import warnings
from collections.abc import Sequence
from contextlib import nullcontext

from torchstickcal.cli.arguments import parser
from torchstickcal.cli.configuration import print_config
from torchstickcal.cli.console import console, quiet
from torchstickcal.cli.outputs import EXIT_INTERRUPTED, EXIT_UNUSABLE
from torchstickcal.cli.plugins import import_plugins
from torchstickcal.errors import CalibrationError

_TRACEBACK = "TORCHSTICKCAL_TRACEBACK"
"""The environment variable that asks for the traceback of an error."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command. An error is one line on standard error; ``--debug`` also shows where it was raised, and so does
    ``TORCHSTICKCAL_TRACEBACK=1`` in the environment.

    Args:
        arguments: of the command line; None for those of the process.

    Returns:
        The exit status: 0, 1 if a calibration did not converge, 2 if the input cannot be used or the results cannot be written,
        3 if the verdict on a calibration is poor or failed, 130 if the user interrupted it.
    """
    try:
        with console():
            return _run(arguments)
    except OSError as error:  # the console's own: its disk is full
        return _failed(str(error))


def program() -> int:
    """Run the command of this process, as :func:`main` does, with its signals and streams."""
    for descriptor in range(3):  # a file opened later must not take the place of a closed standard stream
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)
    if not sys.warnoptions:
        warnings.simplefilter("ignore")  # what a user should know is in the results
    interrupted = False

    def interrupt(*_: object) -> None:
        nonlocal interrupted
        interrupted = True
        raise KeyboardInterrupt

    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
        signal.signal(signal.SIGINT, interrupt)
    status = main()
    if interrupted:
        os._exit(EXIT_INTERRUPTED)  # at once: threads that still calculate have nothing to write
    return status


def _run(arguments: Sequence[str] | None) -> int:
    options = parser().parse_args(arguments)
    debug = options.debug or bool(os.environ.get(_TRACEBACK))
    try:
        import_plugins(options.plugin)
        if getattr(options, "print_config", False):
            return print_config(options)
        with quiet() if options.quiet else nullcontext():
            return options.run(options)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return EXIT_INTERRUPTED
    except (CalibrationError, OSError) as error:
        return _failed(str(error), debug)
    except Exception as error:
        return _failed(f"unexpected {type(error).__name__}: {error} (--debug shows where)", debug)


def _failed(message: str, debug: bool = False) -> int:
    """Show an error, with its traceback if that is asked for; returns the exit status."""
    if debug:
        traceback.print_exc()
    print("error:", " ".join(message.split()), file=sys.stderr)
    return EXIT_UNUSABLE
