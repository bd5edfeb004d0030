"""Configurations: what the calibration does, as data.

A configuration is a TOML file. Those shipped with the package are found by name; a user's own may start from one of them
with ``extends = "default"`` and state only what differs. ``false`` in place of a loss's table removes the loss.
"""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
from torch import Tensor

from torchstickcal.errors import ConfigError
from torchstickcal.files import parse_toml, toml_text
from torchstickcal.losses import LOSSES, CameraPointLoss, LossSettings, ReprojectionSettings
from torchstickcal.model.unknowns import REFINEMENTS
from torchstickcal.registry import suggestion
from torchstickcal.settings import Positive, PositiveInt, build, build_dataclass, check_key
from torchstickcal.untrusted import read_bytes

_EXTENDS = "extends"
_SET = "--set"
_HEIGHTS_M = 0.5, 2.5

Refine = Annotated[str, REFINEMENTS]
"""A name in :data:`torchstickcal.model.unknowns.REFINEMENTS`."""


@dataclass(frozen=True)
class InitialiseSettings:
    """How the first estimate is made.

    Args:
        min_common_points: fewest points, over all frames, that relate two cameras.
        max_points: points of a pair that RANSAC looks at.
        threshold_px: distance from the epipolar line up to which a point agrees with a pair.
    """

    min_common_points: PositiveInt = 20
    max_points: PositiveInt = 200
    threshold_px: Positive = 4.0


@dataclass(frozen=True)
class ScaleSettings:
    """A length that sets the scale where no stick does: from the mean of some named points to the mean of others.

    Args:
        start: names of the points at one end.
        end: names of the points at the other end.
        length_m: the mean length over the session, metres.
    """

    start: list[str]
    end: list[str]
    length_m: Positive


@dataclass(frozen=True)
class Stage:
    """One minimisation.

    In a configuration the losses stand in the stage's table under their own names. ``reprojection`` is there unless it is
    removed.

    Args:
        cameras: whether the cameras are estimated too, or fixed.
        losses: the losses that are minimised, by name: settings of :data:`torchstickcal.losses.LOSSES`.
        reject_sigmas: residual, in standard deviations, beyond which a keypoint is rejected before the stage begins; None to
            keep all.
        rescale: whether the scene is brought to scale in closed form afterwards.
        max_iterations: limit of iterations.
        cost_tolerance: relative decrease of the cost at which the stage has converged.
    """

    cameras: Literal["free", "held"] = "free"
    losses: dict[str, LossSettings] = field(default_factory=lambda: {"reprojection": ReprojectionSettings()})
    reject_sigmas: Positive | None = None
    rescale: bool = False
    max_iterations: PositiveInt = 100
    cost_tolerance: Positive = 1e-9

    @staticmethod
    def of_table(value: Any, where: str, path: tuple[str, ...]) -> Stage:
        """A stage from its table; arguments and errors as of :func:`torchstickcal.settings.build`."""
        if not isinstance(value, dict):
            raise ConfigError("unusable value", where=f"{where}: {'.'.join(path)}", got=repr(value), expected="a table")
        own = [field.name for field in dataclasses.fields(Stage) if field.name != "losses"]
        if ambiguous := set(own) & set(LOSSES):
            raise ConfigError(
                "a loss has the name of a stage's setting", where="losses", got=", ".join(ambiguous), expected="another name"
            )
        for key in value:
            check_key(key, [*own, *LOSSES], where, path)
        tables = {"reprojection": {}} | {key: item for key, item in value.items() if key not in own}
        built = {name: build(LOSSES[name] | None, table, where, (*path, name)) for name, table in tables.items()}
        losses = {name: settings for name, settings in built.items() if settings is not None}
        if not any(issubclass(settings.loss, CameraPointLoss) for settings in losses.values()):
            raise ConfigError(
                "no loss compares points with keypoints",
                where=f"{where}: {'.'.join(path)}",
                got=", ".join(losses) or "no loss",
                expected="reprojection, or another loss of a camera and a point",
            )
        settings = build_dataclass(Stage, {key: item for key, item in value.items() if key in own}, where, path)
        return dataclasses.replace(settings, losses=losses)


@dataclass(frozen=True)
class Config:
    """A whole calibration.

    Args:
        stages: the minimisations, in order, by name.
        points: which points take part: all, only stick ends, or only joints.
        solver: which solver minimises.
        precision: of the arrays that have an entry per keypoint. Unknowns and sums over keypoints are float64 in any case.
            ``float32`` halves the memory and suits graphics cards that are slow in float64.
        initialise: the first estimate.
        relabel: whether label errors are undone: left and right of the body or the ends of a stick exchanged, another person.
        incomplete: what to do with cameras that share too little to be one rig: ``refuse`` them, or calibrate the ``largest``
            part of them alone and name the others.
        scale: a length between points that sets the scale instead of the sticks.
        height_m: body height of the athlete, metres, which sets the scale where neither ``scale`` nor a stick does.
        refine: what else is estimated of the cameras, in every stage that estimates them; ``auto`` for what the keypoints
            contradict.
        camera_groups: a label for each camera; cameras with the same label share what is shared. Empty: all cameras do.
        synchronise: whether ``auto`` may estimate clocks.
        max_offset_s: largest time offset from the first camera that is searched for, seconds. Where the motion repeats itself,
            choose less than half its period.
        noise: whether losses whose ``sigma_px`` is ``estimated`` take it from the session, or from what is ``given`` here. The
            choice of outliers always goes by the estimate.
        sigma_px: where the noise is given, the standard deviation along each axis of a keypoint of confidence 1, pixels: one
            number, or a list with one for each point.

    Example:
        >>> config = load_config({"extends": "default", "stages": {"metric": {"stick_length": {"sigma_m": 0.003}}}})
        >>> list(config.stages)
        ['unscaled', 'metric', 'selected', 'refined', 'trajectories']
        >>> config.stages["metric"].losses["stick_length"]
        StickLengthSettings(sigma_m=0.003, kernel='cauchy', kernel_scale=3.0, weight=1.0)
    """

    stages: dict[str, Stage]
    points: Literal["all", "sticks", "joints"] = "all"
    solver: Literal["gauss_newton", "lbfgs"] = "gauss_newton"
    precision: Literal["float64", "float32"] = "float64"
    initialise: InitialiseSettings = field(default_factory=InitialiseSettings)
    relabel: bool = False
    incomplete: Literal["refuse", "largest"] = "refuse"
    scale: ScaleSettings | None = None
    height_m: Positive | None = None
    refine: list[Refine] | Literal["auto"] = field(default_factory=list)
    camera_groups: list[str] = field(default_factory=list)
    synchronise: bool = True
    max_offset_s: Positive = 2.0
    noise: Literal["estimated", "given"] = "estimated"
    sigma_px: Positive | list[Positive] = 1.0

    def __post_init__(self) -> None:
        least, most = _HEIGHTS_M
        if self.height_m is not None and not least <= self.height_m <= most:
            raise ConfigError(
                "not the height of a person",
                where="height_m",
                got=self.height_m,
                expected=f"{least:g} to {most:g}",
                remedy="Give it in metres.",
            )

    @property
    def given_sigma_px(self) -> Tensor | None:
        """The given standard deviations of the keypoints, () or (P,), pixels; None where they are estimated."""
        return None if self.noise == "estimated" else torch.tensor(self.sigma_px, dtype=torch.float64)


def config_names() -> list[str]:
    """The names of the configurations shipped with the package.

    Example:
        >>> "default" in config_names()
        True
    """
    files = resources.files("torchstickcal.configs").iterdir()
    return sorted(Path(file.name).stem for file in files if file.name.endswith(".toml"))


def load_config(config: str | Path | Mapping[str, Any] | Config = "default") -> Config:
    """A configuration from its name, from a TOML file, from a mapping of the same keys, or as it is.

    Args:
        config: any of these. A mapping or a file that ``extends`` a configuration states only what differs from it.

    Raises:
        ConfigError: for an unknown name, an unknown key (with the nearest known one), or an unusable value.

    Example:
        >>> load_config("lbfgs").solver
        'lbfgs'
        >>> load_config({"extends": "default", "refine": ["focal", "radial"]}).refine
        ['focal', 'radial']
    """
    if isinstance(config, Config):
        return config
    if not isinstance(config, str | Path | Mapping):
        expected = "the name of a configuration, a TOML file, a mapping of its keys, or a Config"
        raise ConfigError("not a configuration", where="config", got=type(config).__name__, expected=expected)
    return _built(_keys(config, Path(), ()), "mapping" if isinstance(config, Mapping) else str(config))


def with_settings(config: Config, settings: Sequence[str]) -> Config:
    """A configuration with some of its keys set, each by a line of TOML; a later line has precedence.

    Raises:
        ConfigError: if a line is not one key with its value, and as for :func:`load_config`.

    Example:
        >>> changed = with_settings(load_config("default"), ["stages.metric.reject_sigmas = 5", "relabel = false"])
        >>> changed.stages["metric"].reject_sigmas, changed.relabel
        (5.0, False)
    """
    keys = _tables(config)
    for line in settings:
        changes = _setting(line)
        _check_stage_names(keys, changes, _SET)
        keys = _merged(keys, changes)
    return _built(keys, _SET) if settings else config


def config_toml(config: Config) -> str:
    """A configuration with all its keys as TOML, from which :func:`load_config` reads an equal one.

    Example:
        >>> print(config_toml(load_config("paper"))[:60])
        points = "all"
        solver = "gauss_newton"
        precision = "float64"
    """
    return toml_text(_tables(config))


def with_noise(config: Config, noise: Any) -> Config:
    """A configuration whose noise is ``estimated`` or ``given``.

    Raises:
        ConfigError: if it is to be neither.
    """
    return dataclasses.replace(config, noise=build(typing.get_type_hints(Config)["noise"], noise, "argument", ("noise",)))


def with_refine(config: Config, refine: Any) -> Config:
    """A configuration that refines something else.

    Raises:
        ConfigError: if that is not a list of :data:`Refine`, or ``auto``.
    """
    chosen = build(typing.get_type_hints(Config, include_extras=True)["refine"], refine, "calibrate", ("refine",))
    return dataclasses.replace(config, refine=chosen)


def _built(keys: Mapping[str, Any], where: str) -> Config:
    """The configuration of some keys; ``where`` they come from is for messages."""
    built: Config = build(Config, keys, where, ())
    if not built.stages:
        raise ConfigError("nothing to do", where=f"{where}: stages", got="no stage", expected="at least one")
    return built


def _tables(settings: Any) -> dict[str, Any]:
    """Settings as the tables from which they are built; the losses of a stage stand among its own keys."""
    tables = {field.name: _as_value(getattr(settings, field.name)) for field in dataclasses.fields(settings)}
    if isinstance(settings, Stage):
        tables |= {"reprojection": False} | tables.pop("losses")
    return tables


def _as_value(value: Any) -> Any:
    if dataclasses.is_dataclass(value):
        return _tables(value)
    if isinstance(value, Mapping):
        return {key: _as_value(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_as_value(item) for item in value]
    return False if value is None else value


def _setting(line: str) -> dict[str, Any]:
    """The key, within its tables, that a line of TOML sets."""
    try:
        found = parse_toml(line.encode())
        why = "" if found and len(line.splitlines()) == 1 and not line.lstrip().startswith("[") else "not one key with a value"
    except ValueError as error:
        found, why = {}, str(error)
    if why:
        raise ConfigError(
            "a setting is not KEY=VALUE",
            where=_SET,
            got=f"{line!r}: {why}",
            expected="a key and its value as in a configuration file, such as stages.metric.reject_sigmas=5",
            remedy="""A text is in quotation marks of its own: 'points="sticks"'.""",
        )
    return found


def _keys(config: str | Path | Mapping[str, Any], folder: Path, extending: tuple[str, ...]) -> dict[str, Any]:
    """The keys of a mapping, a named configuration or a file, with what it extends filled in.

    Args:
        config: which.
        folder: where files with relative paths are.
        extending: what extends it, from the first on.
    """
    if isinstance(config, Mapping):
        name, keys = "mapping", dict(config)
    else:
        name, folder, content = _content(config, folder)
        keys = _parsed(content, name)
    if name in extending:
        circle = " -> ".join((*extending, name))
        raise ConfigError("configurations extend each other in a circle", where=_EXTENDS, got=circle, expected="an end")
    base = keys.pop(_EXTENDS, None)
    if base is None:
        return keys
    if not isinstance(base, str):
        raise ConfigError("unusable value", where=f"{name}: {_EXTENDS}", got=repr(base), expected="a configuration's name")
    extended = _keys(base, folder, (*extending, name))
    _check_stage_names(extended, keys, name)
    return _merged(extended, keys)


def _content(config: str | Path, folder: Path) -> tuple[str, Path, bytes]:
    """The name, the folder and the content of a configuration that is given by its name or its file."""
    names = config_names()
    if config in names:
        return str(config), folder, (resources.files("torchstickcal.configs") / f"{config}.toml").read_bytes()
    path = folder / config
    try:
        if path.is_file():
            return str(path), path.parent, read_bytes(path)
    except (OSError, ValueError) as error:
        got = f"{type(error).__name__}: {error}"
        raise ConfigError("a file cannot be read", where="config", got=got, expected="a TOML file") from error
    raise ConfigError(
        "unknown configuration",
        where="config",
        got=repr(str(config)),
        expected=f"a TOML file or one of {', '.join(names)}",
        remedy=suggestion(str(config), names),
    )


def _parsed(content: bytes, where: str) -> dict[str, Any]:
    try:
        return parse_toml(content)
    except ValueError as error:
        raise ConfigError("a configuration is not TOML", where=where, got=str(error), expected="TOML in UTF-8") from error


def _check_stage_names(base: dict[str, Any], changes: dict[str, Any], where: str) -> None:
    """Refuse a new stage with almost the name of one that is extended: it is a spelling mistake."""
    old, new = base.get("stages"), changes.get("stages")
    if not isinstance(old, dict) or not isinstance(new, dict):
        return
    for name in new:
        if name not in old and (near := suggestion(str(name), old, cutoff=0.8)):
            expected = f"one of {', '.join(old)}, or a clearly different name for a new stage"
            raise ConfigError("unknown stage", where=f"{where}: stages", got=repr(name), expected=expected, remedy=near)


def _merged(base: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    merged = dict(base)
    for key, value in changes.items():
        nested = isinstance(value, dict) and isinstance(base.get(key), dict)
        merged[key] = _merged(base[key], value) if nested else value
    return merged
