"""The configuration that the options of a command give."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from torchstickcal.cli.outputs import EXIT_DONE
from torchstickcal.errors import CalibrationError

if TYPE_CHECKING:
    from torchstickcal.config import Config


def print_config(options: argparse.Namespace) -> int:
    """Show the whole configuration of a command, as a file that ``--config`` takes."""
    from torchstickcal.config import config_toml

    print(config_toml(options.configuration(options)), end="")
    return EXIT_DONE


def chosen_config(options: argparse.Namespace) -> Config:
    """The configuration of ``--config``, with what ``--set`` sets.

    Raises:
        ConfigError: if there is none such.
    """
    from torchstickcal.config import load_config, with_settings

    return with_settings(load_config(options.config), options.set)


def triangulation_config(options: argparse.Namespace) -> Config:
    """The configuration of :func:`chosen_config`, without clocks if the cameras are synchronised."""
    config = chosen_config(options)
    return replace(config, synchronise=False) if options.no_sync else config


def calibration_config(options: argparse.Namespace) -> Config:
    """The configuration of :func:`triangulation_config`, with what ``--height`` and ``--refine`` say; what the keypoints
    contradict is refined where nothing is said.

    Raises:
        ConfigError: also for an unknown name.
        CalibrationError: if clocks are to be refined although the cameras are synchronised.
    """
    from torchstickcal.config import with_refine
    from torchstickcal.model.unknowns import REFINEMENTS, clock_refinements

    config = triangulation_config(options)
    if options.height is not None:
        config = replace(config, height_m=options.height, scale=None)
    refine: Any = options.refine
    if refine is None:
        return config if config.refine else with_refine(config, "auto")
    if refine != "auto":
        refine = [] if refine == "none" else refine.split(",")
        for name in refine:
            REFINEMENTS[name]  # raises for an unknown name
    if options.no_sync and clock_refinements() & set(refine):
        raise CalibrationError(
            "clocks cannot be refined if the cameras are synchronised",
            where="--no-sync",
            got=f"--refine {options.refine}",
            expected="one of the two",
        )
    return with_refine(config, refine)


def made_with(config: str, settings: Sequence[str]) -> dict[str, Any]:
    """The name of a configuration and what was set of it, as JSON can hold them."""
    return {"config": config} | ({"set": list(settings)} if settings else {})
