"""What a baseline is given and what it returns; how it appears in the tables; the registry of baselines."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from typing import Any, Literal, NamedTuple, TypeVar, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchstickcal.errors import CalibrationError, ConfigError
from torchstickcal.model.state import State
from torchstickcal.observations import Observations
from torchstickcal.registry import Registry
from torchstickcal.result import Calibration
from torchstickcal.simulate import CubeViews

Array = NDArray[np.float64]

ComparisonTable = Literal["sota", "inputs", "ablation"]
"""The tables that have a counterpart in the paper: comparison of methods, input variants, ablation of the last stage."""

OWN_CONFIGURATIONS = 60
"""Positions from here on belong to the library's own configurations: at the end of the tables."""


class MissingInputError(CalibrationError):
    """A baseline needs an input that is not given."""


@dataclass(frozen=True)
class Inputs:
    """Everything that a baseline may use; each baseline takes what it needs, and inputs that are not known are None.

    Args:
        observations: keypoints of the joints and of the stick, intrinsics, stick length.
        height_m: height of the athlete, metres: the distance from the top of the head to the middle of the ankles.
        bone_lengths_m: lengths of bones in metres, by the names of the two joints.
        cube: keypoints of a calibration cube.
        orientations: unit direction vectors of the limbs :data:`BONES` in the frame of each camera, (C, F, B, 3); NaN where
            not known.
        case: name of the session.

    Example:
        >>> from torchstickcal.benchmark.baselines import BASELINES, Inputs
        >>> from torchstickcal.simulate import golf_session
        >>> observations, truth = golf_session(cameras=4, frames=30)
        >>> estimate = BASELINES["kineo"](Inputs(observations, height_m=1.72))
        >>> estimate.status, estimate.rotations.shape
        ('converged', torch.Size([4, 3, 3]))
    """

    observations: Observations
    height_m: float | None = None
    bone_lengths_m: Mapping[tuple[str, str], float] | None = None
    cube: CubeViews | None = None
    orientations: Array | None = None
    case: str = ""


@dataclass(frozen=True)
class Estimate:
    """Extrinsics of all cameras, as a baseline returns them: world to camera, with the first camera as the world.

    Args:
        rotations: (C, 3, 3).
        translations: (C, 3), metres. NaN for a camera whose pose could not be estimated.
        status: ``converged``, or one sentence that says why not.
        up_to_scale: whether the unit of the translations is not known: the size of the rig is then fitted to the truth.

    Example:
        >>> identity = torch.eye(3, dtype=torch.float64).expand(4, 3, 3)
        >>> Estimate(identity, torch.zeros(4, 3, dtype=torch.float64), "converged").translations.shape
        torch.Size([4, 3])
    """

    rotations: Tensor
    translations: Tensor
    status: str
    up_to_scale: bool = False

    @staticmethod
    def of_state(state: State, status: str) -> Estimate:
        """The cameras of the first session of a state."""
        return Estimate(state.rotations[0], state.translations[0], status)

    @staticmethod
    def of_calibration(calibration: Calibration, scale: float = 1.0) -> Estimate:
        """The cameras of a calibration, with translations multiplied by a scale."""
        translations = calibration.translations.to(torch.float64) * scale
        return Estimate(calibration.rotations.to(torch.float64), translations, calibration.status)


class PublishedErrors(NamedTuple):
    """Mean errors of a method in the paper, and the variation that it calls variances (of the size of standard deviations)."""

    rotation_deg: float
    translation_m: float
    rotation_variation_deg: float | None = None
    translation_variation_m: float | None = None


@dataclass(frozen=True)
class Listing:
    """How a method appears in the tables of the benchmark.

    Args:
        title: of its rows.
        tables: the tables of the paper in which it has a row, ``"sota"`` (comparison of methods), ``"inputs"`` (input
            variants) or ``"ablation"``, each with the errors that the paper reports, or None if it reports none. All methods
            appear in the other tables (efficiency, success, failures).
        reasons: why its errors may differ from the published ones; shown if they differ by more than 30 %.
        position: the rows of a table are sorted by it, smallest first.
        row: title of a row that it shares with other methods of the same ``row``, in the tables of the paper: their mean.

    Raises:
        ConfigError: for an unknown table.
    """

    title: str
    tables: Mapping[ComparisonTable, PublishedErrors | None] = field(default_factory=dict)
    reasons: tuple[str, ...] = ()
    position: int = 50
    row: str = ""

    def __post_init__(self) -> None:
        _check_names(self.tables, get_args(ComparisonTable), "unknown table", f"tables of {self.title!r}")


@dataclass(frozen=True)
class Baseline:
    """A comparison method: call it with :class:`Inputs` to get an :class:`Estimate`.

    Args:
        estimate: the method.
        listing: how it appears in the tables.
        needs: names of the fields of :class:`Inputs` that it cannot do without.
        title_in_motion: title of a second row, in which the method is given the true mean height of the athlete during the
            session instead of the stature; empty for no such row.

    Raises:
        ConfigError: for an unknown input in ``needs``.

    Example:
        >>> from torchstickcal.benchmark import BASELINES
        >>> BASELINES["kineo"].needs, BASELINES["kineo"].title_in_motion
        (('height_m',), 'Kineo, true mean height in motion')
    """

    estimate: Callable[[Inputs], Estimate]
    listing: Listing
    needs: tuple[str, ...] = ()
    title_in_motion: str = ""

    def __post_init__(self) -> None:
        _check_names(self.needs, [entry.name for entry in fields(Inputs)], "unknown input", f"needs of {self.listing.title!r}")

    def __call__(self, inputs: Inputs) -> Estimate:
        """Estimate the cameras.

        Raises:
            MissingInputError: if an input that the method needs is not given.
            CalibrationError: if the method cannot use the observations.
        """
        for name in self.needs:
            required(inputs, name)
        return self.estimate(inputs)


BASELINES: Registry[Baseline] = Registry("baseline", "torchstickcal.benchmark.baselines")
"""The comparison methods, by name. A module of this folder, or one of your own, adds one with :func:`baseline`."""


_Function = TypeVar("_Function", bound=Callable[[Inputs], Estimate])


def baseline(
    name: str, listing: Listing, *, needs: tuple[str, ...] = (), title_in_motion: str = "", replace: bool = False
) -> Callable[[_Function], _Function]:
    """A decorator that registers a function as a comparison method of the benchmark, and returns it unchanged.

    Args:
        name: of the method, as in ``benchmark --methods``.
        listing, needs, title_in_motion: as of :class:`Baseline`.
        replace: whether to replace a baseline of that name.

    Raises:
        ConfigError: if the name is in use, or for an unknown input in ``needs``.

    Example::

        from torchstickcal import calibrate
        from torchstickcal.benchmark import Estimate, Inputs, Listing, baseline

        @baseline("tall", Listing("Human, 1 % too tall", {"inputs": None}), needs=("height_m",))
        def tall(inputs: Inputs) -> Estimate:
            config = {"extends": "human_only", "scale": {"length_m": 1.01 * inputs.height_m}}
            return Estimate.of_calibration(calibrate(inputs.observations, config))
    """

    def register(estimate: _Function) -> _Function:
        BASELINES.register(name, Baseline(estimate, listing, needs, title_in_motion), replace=replace)
        return estimate

    return register


def required(inputs: Inputs, name: str) -> Any:
    """An input by its name.

    Raises:
        MissingInputError: if it is not given.
    """
    value = getattr(inputs, name)
    if value is None:
        raise MissingInputError(
            "the baseline needs an input that is not given", where=f"Inputs.{name}", got="None", expected=name
        )
    return value


def _check_names(names: Mapping[Any, Any] | tuple[str, ...], known: Any, what: str, where: str) -> None:
    """Raise a ConfigError for the first name that is not known."""
    for name in names:
        if name not in known:
            raise ConfigError(what, where=where, got=repr(name), expected=f"one of {', '.join(known)}")
