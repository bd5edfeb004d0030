"""Configurations: what the calibration does, as data.

A configuration is a TOML file. Those shipped with the package are found by name; a user's own may start from one of them
with ``extends = "default"`` and state only what differs. ``false`` in place of a loss's table removes the loss.
"""

from __future__ import annotations

import dataclasses
import math
import tomllib
import types
import typing
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal

from torchstickcal.errors import ConfigError
from torchstickcal.losses import LOSSES, CameraPointLoss, LossSettings, ReprojectionSettings
from torchstickcal.model.unknowns import REFINEMENTS
from torchstickcal.registry import Registry, suggestion

_EXTENDS = "extends"
_UNIONS = (types.UnionType, typing.Union)


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

    min_common_points: int = 20
    max_points: int = 200
    threshold_px: float = 4.0


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
    length_m: float


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
    reject_sigmas: float | None = None
    rescale: bool = False
    max_iterations: int = 100
    cost_tolerance: float = 1e-9


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
        scale: a length between points that sets the scale instead of the sticks.
        refine: what else is estimated of the cameras, in every stage that estimates them; ``auto`` for what the keypoints
            contradict.
        camera_groups: a label for each camera; cameras with the same label share what is shared. Empty: all cameras do.
        synchronise: whether ``auto`` may estimate clocks.
        max_offset_s: largest time offset from the first camera that is searched for, seconds. Where the motion repeats itself,
            choose less than half its period.

    Example:
        >>> config = load_config({"extends": "default", "stages": {"metric": {"stick_length": {"sigma_m": 0.003}}}})
        >>> list(config.stages)
        ['unscaled', 'metric', 'refined', 'trajectories']
        >>> config.stages["metric"].losses["stick_length"]
        StickLengthSettings(sigma_m=0.003, weight=1.0)
    """

    stages: dict[str, Stage]
    points: Literal["all", "sticks", "joints"] = "all"
    solver: Literal["gauss_newton", "lbfgs"] = "gauss_newton"
    precision: Literal["float64", "float32"] = "float64"
    initialise: InitialiseSettings = field(default_factory=InitialiseSettings)
    scale: ScaleSettings | None = None
    refine: list[Refine] | Literal["auto"] = field(default_factory=list)
    camera_groups: list[str] = field(default_factory=list)
    synchronise: bool = True
    max_offset_s: float = 2.0


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
    where = "mapping" if isinstance(config, Mapping) else str(config)
    keys = _extended(dict(config), where) if isinstance(config, Mapping) else _read(config)
    built: Config = _build(Config, keys, where, ())
    if not built.stages:
        raise ConfigError("nothing to do", where=f"{where}: stages", got="no stage", expected="at least one")
    return built


def with_refine(config: Config, refine: Any) -> Config:
    """A configuration that refines something else.

    Raises:
        ConfigError: if that is not a list of :data:`Refine`, or ``auto``.
    """
    chosen = _build(typing.get_type_hints(Config, include_extras=True)["refine"], refine, "calibrate", ("refine",))
    return dataclasses.replace(config, refine=chosen)


def _read(config: str | Path) -> dict[str, Any]:
    """The keys of a named configuration or a file, with what it extends filled in."""
    names = config_names()
    if str(config) in names:
        text = (resources.files("torchstickcal.configs") / f"{config}.toml").read_text("utf-8")
    elif Path(config).is_file():
        text = Path(config).read_text("utf-8")
    else:
        raise ConfigError(
            "unknown configuration",
            where="config",
            got=repr(str(config)),
            expected=f"a TOML file or one of {', '.join(names)}",
            remedy=suggestion(str(config), names),
        )
    try:
        keys = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError("a configuration is not TOML", where=str(config), got=str(error), expected="TOML") from error
    return _extended(keys, str(config))


def _extended(keys: dict[str, Any], where: str) -> dict[str, Any]:
    base = keys.pop(_EXTENDS, None)
    if base is None:
        return keys
    if not isinstance(base, str):
        raise ConfigError("unusable value", where=f"{where}: {_EXTENDS}", got=repr(base), expected="a configuration's name")
    return _merged(_read(base), keys)


def _merged(base: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    merged = dict(base)
    for key, value in changes.items():
        nested = isinstance(value, dict) and isinstance(base.get(key), dict)
        merged[key] = _merged(base[key], value) if nested else value
    return merged


def _build(kind: Any, value: Any, where: str, path: tuple[str, ...]) -> Any:
    """A value of a type built from TOML, or a ConfigError that names the key."""
    if isinstance(kind, type) and isinstance(value, kind) and dataclasses.is_dataclass(kind):
        return value
    if kind is Stage:
        return _build_stage(value, where, path)
    if dataclasses.is_dataclass(kind):
        return _build_dataclass(typing.cast(type, kind), value, where, path)
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin in _UNIONS:
        if value is False and type(None) in arguments:
            return None
        options = [option for option in arguments if option is not type(None)]
        matching = [option for option in options if _fits(option, value)]
        if matching:
            return _build(matching[0], value, where, path)
    elif origin is dict and isinstance(value, dict):
        return {key: _build(arguments[1], item, where, (*path, key)) for key, item in value.items()}
    elif origin is list and isinstance(value, list | tuple):
        return [_build(arguments[0], item, where, (*path, str(number))) for number, item in enumerate(value)]
    elif _fits(kind, value):
        return float(value) if kind is float else value
    raise ConfigError(
        "unusable value", where=f"{where}: {'.'.join(path) or 'top level'}", got=repr(value), expected=_description(kind)
    )


def _build_dataclass(kind: type, value: Any, where: str, path: tuple[str, ...]) -> Any:
    if not isinstance(value, dict):
        raise ConfigError("unusable value", where=f"{where}: {'.'.join(path)}", got=repr(value), expected="a table")
    hints, fields = typing.get_type_hints(kind, include_extras=True), dataclasses.fields(kind)
    for key in value:
        _check_key(key, [field.name for field in fields], where, path)
    required = [field.name for field in fields if field.default is field.default_factory is dataclasses.MISSING]
    missing = [name for name in required if name not in value]
    if missing:
        table = ".".join(path) or "top level"
        raise ConfigError("missing key", where=f"{where}: {table}", got=", ".join(value) or "nothing", expected=missing[0])
    return kind(**{key: _build(hints[key], item, where, (*path, key)) for key, item in value.items()})


def _build_stage(value: Any, where: str, path: tuple[str, ...]) -> Stage:
    """A stage, in whose table the losses stand beside the stage's own settings."""
    if not isinstance(value, dict):
        raise ConfigError("unusable value", where=f"{where}: {'.'.join(path)}", got=repr(value), expected="a table")
    own = [field.name for field in dataclasses.fields(Stage) if field.name != "losses"]
    for key in value:
        _check_key(key, [*own, *LOSSES], where, path)
    tables = {"reprojection": {}} | {key: item for key, item in value.items() if key not in own}
    built = {name: _build(LOSSES[name] | None, table, where, (*path, name)) for name, table in tables.items()}
    losses = {name: settings for name, settings in built.items() if settings is not None}
    if not any(issubclass(settings.loss, CameraPointLoss) for settings in losses.values()):
        raise ConfigError(
            "no loss compares points with keypoints",
            where=f"{where}: {'.'.join(path)}",
            got=", ".join(losses) or "no loss",
            expected="reprojection, or another loss of a camera and a point",
        )
    settings = _build_dataclass(Stage, {key: item for key, item in value.items() if key in own}, where, path)
    return dataclasses.replace(settings, losses=losses)


def _check_key(key: str, known: list[str], where: str, path: tuple[str, ...]) -> None:
    if key not in known:
        raise ConfigError(
            "unknown key",
            where=f"{where}: {'.'.join((*path, key))}",
            got=repr(key),
            expected=f"one of {', '.join(known)}",
            remedy=suggestion(key, known),
        )


def _registry(kind: Any) -> Registry[Any] | None:
    """The registry whose names a type stands for; None for other types."""
    return typing.get_args(kind)[1] if typing.get_origin(kind) is Annotated else None


def _fits(kind: Any, value: Any) -> bool:
    if (registry := _registry(kind)) is not None:
        return isinstance(value, str) and value in registry
    if typing.get_origin(kind) is Literal:
        return isinstance(value, str) and value in typing.get_args(kind)
    if typing.get_origin(kind) is list:
        return isinstance(value, list | tuple)
    if dataclasses.is_dataclass(kind):
        return isinstance(value, dict | typing.cast(type, kind))
    if kind is float:
        return isinstance(value, int | float) and not isinstance(value, bool) and 0 < value < math.inf
    if kind is int:
        return isinstance(value, int) and not isinstance(value, bool) and value > 0
    return isinstance(kind, type) and isinstance(value, kind)


def _description(kind: Any) -> str:
    if (registry := _registry(kind)) is not None:
        return f"one of {', '.join(registry)}"
    if typing.get_origin(kind) is Literal:
        return " or ".join(repr(option) for option in typing.get_args(kind))
    if typing.get_origin(kind) is list:
        return f"a list of {_description(typing.get_args(kind)[0])}"
    if typing.get_origin(kind) in _UNIONS:
        return " or ".join("false" if option is type(None) else _description(option) for option in typing.get_args(kind))
    if dataclasses.is_dataclass(kind):
        return "a table"
    return {float: "a number above 0", int: "a whole number above 0", bool: "true or false", str: "a text"}.get(kind, str(kind))
