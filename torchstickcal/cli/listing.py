"""The command `list`: what has a name, with one line each."""

from __future__ import annotations

import argparse
import inspect
import re
from collections.abc import Callable, Iterator

from torchstickcal.cli.outputs import EXIT_DONE


def list_names(options: argparse.Namespace) -> int:
    print("\n\n".join(map(_section, [options.kind] if options.kind else LISTS)))
    return EXIT_DONE


def _section(kind: str) -> str:
    title, entries = LISTS[kind]
    rows = list(entries())
    width = max(len(name) for name, _ in rows)
    return "\n".join([f"{kind}: {title}", *(f"  {name:{width}}  {what}" for name, what in rows)])


def _losses() -> Iterator[tuple[str, str]]:
    from torchstickcal.losses import LOSSES

    for name, settings in LOSSES.items():
        yield name, f"{_first_sentence(settings.__doc__)}; settings: {', '.join(inspect.signature(settings).parameters)}"


def _unknowns() -> Iterator[tuple[str, str]]:
    from torchstickcal.model.unknowns import REFINEMENTS

    for name, (unknown, sharing) in REFINEMENTS.items():
        unit = f" ({unknown.unit})" if unknown.unit else ""
        yield name, f"{unknown.label}{unit}; {sharing.value}"


def _formats() -> Iterator[tuple[str, str]]:
    from torchstickcal.io import CALIBRATION_READERS, CALIBRATION_WRITERS, KEYPOINT_READERS, SESSION_READERS

    for name, reader in SESSION_READERS.items():
        yield name, f"reads sessions: {reader.description}"
    for name, reader in KEYPOINT_READERS.items():
        yield name, f"reads keypoints: {reader.description}"
    for name, reader in CALIBRATION_READERS.items():
        yield name, f"reads calibrations: {reader.description}"
    for name, writer in CALIBRATION_WRITERS.items():
        yield name, f"writes {writer.file_name}: {writer.description}"


def _findings() -> Iterator[tuple[str, str]]:
    from torchstickcal.quality.registry import FAMILIES

    for name, family in FAMILIES.items():
        yield name, family.description


def _sports() -> Iterator[tuple[str, str]]:
    from torchstickcal.simulate import SPORTS

    for name, action in SPORTS.items():
        start, end = action.stick_names
        yield name, f"stick of {action.stick_m:g} m from {start} to {end}; one repetition takes {action.period_s:g} s"


def _presets() -> Iterator[tuple[str, str]]:
    from torchstickcal.simulate import PRESETS, preset

    for name in PRESETS:
        specs = preset(name)
        sports, cameras = dict.fromkeys(spec.sport for spec in specs), sorted({spec.cameras for spec in specs})
        yield name, f"{len(specs)} sessions of {', '.join(sports)}; number of cameras: {', '.join(map(str, cameras))}"


def _baselines() -> Iterator[tuple[str, str]]:
    from torchstickcal.benchmark import BASELINES, METHODS
    from torchstickcal.config import config_names

    for name in [name for name in METHODS if name not in config_names()]:
        title = METHODS[name].title.replace("`", "")
        baseline = BASELINES.get(name)
        needs = f"; needs {', '.join(baseline.needs)}" if baseline and baseline.needs else ""
        yield name, f"{title}: {_first_sentence(baseline.estimate.__doc__)}{needs}" if baseline else title


def _configs() -> Iterator[tuple[str, str]]:
    from importlib import resources

    from torchstickcal.config import config_names

    for name in config_names():
        text = (resources.files("torchstickcal.configs") / f"{name}.toml").read_text("utf-8")
        yield name, _first_sentence(re.sub(r"(?m)^# ?", "", text.partition("\n\n")[0]))


LISTS: dict[str, tuple[str, Callable[[], Iterator[tuple[str, str]]]]] = {
    "losses": ("keys in the table of a stage of a configuration", _losses),
    "unknowns": ("for --refine, and the key `refine` of a configuration", _unknowns),
    "findings": ("families of what is found of a calibration, for its verdict", _findings),
    "formats": ("files that can be read (--format takes those of sessions and keypoints) and written (--export)", _formats),
    "sports": ("for simulate", _sports),
    "presets": ("sets of sessions, for simulate and benchmark", _presets),
    "baselines": ("other methods of calibration, for benchmark --methods", _baselines),
    "configs": ("for --config, and benchmark --methods", _configs),
}
"""For each kind of things that have names: what they are for, and their names with one line each."""


def _first_sentence(text: str | None) -> str:
    """The first sentence of a docstring or a comment, without markup and full stop."""
    sentence = re.split(r"\.(?=\s|$)|\n\s*\n", (text or "").strip(), maxsplit=1)[0]
    return " ".join(re.sub(r":\w+:(?=`)|`", "", sentence).split())
