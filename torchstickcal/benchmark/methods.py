"""The methods that the benchmark measures: the library's configurations and the baselines, by name."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial

from torchstickcal.benchmark.baselines import BASELINES, Estimate, Inputs, Listing, bone_lengths, limb_orientations
from torchstickcal.benchmark.baselines.base import OWN_CONFIGURATIONS
from torchstickcal.benchmark.cases import Case
from torchstickcal.benchmark.configurations import LISTINGS, PROFILED, listing_of
from torchstickcal.config import config_names
from torchstickcal.errors import ConfigError
from torchstickcal.pipeline.calibrate import calibrate
from torchstickcal.registry import suggestion

LIMB_SIGMA_DEG = 5.0
"""Noise of the limb directions that CalibPerson is given, along each of two axes, degrees: that of a good network."""

_FEW_FRAMES = (5, 10, 20)


@dataclass(frozen=True)
class Method:
    """A way to calibrate, as the benchmark measures it.

    Args:
        listing: how it appears in the tables.
        estimate: the method.
        height_in_motion: whether it is given the true mean distance from head to ankles in the session, which is known only
            from the truth, instead of the athlete's stature.
        frames: number of frames of a session that it is given, from the first one; None for all.
        profiled: whether its memory is measured too, in calls of their own.
        timed: whether its run time says something: not where it only reads what was computed elsewhere.
    """

    listing: Listing
    estimate: Callable[[Inputs], Estimate]
    height_in_motion: bool = False
    frames: int | None = None
    profiled: bool = False
    timed: bool = True

    @property
    def title(self) -> str:
        """Title of its rows in the tables."""
        return self.listing.title

    def inputs(self, case: Case) -> Inputs:
        """What the method may use of a case."""
        given = Inputs(case.observations, height_m=case.height_m, cube=case.cube, case=case.name)
        names, points = case.observations.point_names, case.truth.points
        if names is None or points is None or "head_top" not in names:
            return replace(given, height_m=None)
        if self.height_in_motion:
            ankles = points[:, [names.index("left_ankle"), names.index("right_ankle")]].mean(1)
            given = replace(given, height_m=float((points[:, names.index("head_top")] - ankles).norm(dim=1).mean()))
        return replace(
            given,
            bone_lengths_m=bone_lengths(points, names),
            orientations=limb_orientations(case.truth.rotations, points, LIMB_SIGMA_DEG, case.seed, names),
        )


class _Methods(Mapping[str, Method]):
    """Computed at each look-up, so that a baseline that is registered later is found."""

    def __getitem__(self, name: str) -> Method:
        return _all_methods()[name]

    def __iter__(self) -> Iterator[str]:
        return iter(_all_methods())

    def __len__(self) -> int:
        return len(_all_methods())


METHODS: Mapping[str, Method] = _Methods()
"""All methods by name: the library's configurations, the baselines, and variants of both."""


EXTERNAL: dict[str, Method] = {}
"""Methods that only read what was computed elsewhere, while there are some (:mod:`torchstickcal.benchmark.external`)."""


def method(name: str) -> Method:
    """A method by its name.

    Raises:
        ConfigError: if there is no method of that name; the message lists the methods.

    Example:
        >>> method("kineo").title
        'Kineo'
    """
    known = _all_methods()
    if name not in known:
        expected = f"one of {', '.join(known)}"
        raise ConfigError(
            "unknown method", where="--methods", got=repr(name), expected=expected, remedy=suggestion(name, known)
        )
    return known[name]


def _all_methods() -> dict[str, Method]:
    """The library's own configurations first, then the methods that they are compared with, by position, then variants."""
    configured = {name: _configured(name) for name in dict.fromkeys([*LISTINGS, *config_names()])}
    baselines = {name: Method(entry.listing, entry) for name, entry in BASELINES.items()}
    if taken := sorted(configured.keys() & baselines.keys()):
        raise ConfigError(
            "a baseline has the name of a configuration",
            where="register a baseline",
            got=repr(taken[0]),
            expected="another name",
        )
    own = {name: method for name, method in configured.items() if method.listing.position >= OWN_CONFIGURATIONS}
    by_position = dict(sorted((configured | baselines).items(), key=lambda item: item[1].listing.position))
    return own | by_position | _in_motion() | _shortened() | EXTERNAL


def _configured(config: str) -> Method:
    """The calibration with one of the library's configurations."""
    return Method(listing_of(config), partial(_calibrated, config=config), profiled=config in PROFILED)


def _calibrated(inputs: Inputs, config: str) -> Estimate:
    return Estimate.of_calibration(calibrate(inputs.observations, config))


def _in_motion() -> dict[str, Method]:
    """The variants that are given the true mean height in motion; the paper has no figures for them."""
    return {
        f"{name}_in_motion": Method(
            replace(entry.listing, title=entry.title_in_motion, tables=dict.fromkeys(entry.listing.tables), reasons=(), row=""),
            entry,
            height_in_motion=True,
        )
        for name, entry in sorted(BASELINES.items(), key=lambda item: item[1].listing.position)
        if entry.title_in_motion
    }


def _shortened() -> dict[str, Method]:
    """The default configuration on the first frames of a session."""
    return {
        f"default_{frames}_frames": replace(
            _configured("default"), listing=Listing(f"`default`, {frames} frames"), frames=frames, profiled=False
        )
        for frames in _FEW_FRAMES
    }
