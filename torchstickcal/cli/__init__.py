"""The command line. What needs torch is imported when a command runs, so that help and usage errors appear at once."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from torchstickcal.cli.arguments import parser
from torchstickcal.cli.outputs import EXIT_UNUSABLE
from torchstickcal.cli.plugins import import_plugins
from torchstickcal.errors import CalibrationError


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command.

    Args:
        arguments: of the command line; None for those of the process.

    Returns:
        The exit status: 0, 1 if a calibration did not converge, 2 if the input cannot be used.
    """
    options = parser().parse_args(arguments)
    try:
        import_plugins(options.plugin)
        return options.run(options)
    except (CalibrationError, OSError) as error:
        print("error:", " ".join(str(error).splitlines()), file=sys.stderr)
        return EXIT_UNUSABLE
