"""Configurations: those that anyone might try, tables of known keys with odd values, and text that is hardly TOML."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping
from typing import Any

from hypothesis import strategies as st

from torchstickcal.config import Config, InitialiseSettings, ScaleSettings, Stage, config_names
from torchstickcal.losses import LOSSES
from torchstickcal.model.unknowns import REFINEMENTS

REFINE = ["focal", "focal_shared", "principal_point", "radial", "time_offset", "readout"]


POSITIVE = st.sampled_from([1.0, 1e-3, 1e3, 1e-9, 1e300, 1e-300])


@st.composite
def _some(draw: st.DrawFn, most: int, **values: st.SearchStrategy[Any]) -> dict[str, Any]:
    """A table with some of these keys."""
    keys = draw(st.lists(st.sampled_from(list(values)), max_size=most, unique=True))
    return {key: draw(values[key]) for key in keys}


def usable() -> st.SearchStrategy[dict[str, Any]]:
    """Configurations that should work: everything allowed, in unusual combinations and sizes."""
    names = [name for name in config_names() if name != "lbfgs"]
    extends = st.sampled_from(["default"] * 12 + names * 2 + ["lbfgs"])
    refine = st.one_of(st.just("auto"), st.just([]), st.lists(st.sampled_from(REFINE), unique=True))
    initialise = _some(
        1,
        min_common_points=st.sampled_from([1, 5, 100_000]),
        max_points=st.sampled_from([8, 1, 10**9]),
        threshold_px=st.sampled_from([100.0, 0.01, 1e-300, 1e300]),
    )
    more = _some(
        2,
        precision=st.just("float32"),
        points=st.sampled_from(["sticks", "joints"]),
        synchronise=st.booleans(),
        max_offset_s=st.sampled_from([0.1, 1e-9, 30.0, 1e308]),
        camera_groups=st.sampled_from([["a"] * count for count in range(5)] + [["a", "b"], ["a", "b", "a"]]),
        initialise=initialise,
        stages=_some(2, metric=_stage(), refined=_stage(), trajectories=_stage(), another=_stage()),
    )
    return st.builds(lambda extends, refine, more: {"extends": extends, "refine": refine, **more}, extends, refine, more)


def _stage() -> st.SearchStrategy[dict[str, Any]]:
    kernels = st.sampled_from(["none", "cauchy", "huber", "geman_mcclure"])
    estimated = st.one_of(st.just("estimated"), POSITIVE)
    return _some(
        3,
        cameras=st.sampled_from(["free", "held"]),
        reject_sigmas=st.one_of(st.just(False), POSITIVE),
        rescale=st.booleans(),
        max_iterations=st.sampled_from([1, 2, 100]),
        cost_tolerance=POSITIVE,
        reprojection=_some(3, sigma_px=estimated, kernel=kernels, kernel_scale=POSITIVE, weight=POSITIVE),
        stick_length=st.one_of(st.just(False), _some(2, sigma_m=POSITIVE, weight=POSITIVE)),
        smoothness=st.one_of(st.just(False), _some(2, sigma_m=estimated, weight=POSITIVE)),
    )


ODD_VALUES: list[Any] = [
    *(0, -1, 1, 2, 10**20, 10**400, 0.5, -0.0, 1e-300, 1e308, math.nan, math.inf, -math.inf),
    *(True, False, "", "auto", "default", "estimated", "\x7f", "ä", "a" * 5000, [], [[]], [1, "a"], ["focal"], {}, {"": {}}),
]


def odd() -> st.SearchStrategy[dict[str, Any]]:
    """Tables whose keys are mostly known and whose values mostly do not belong there."""
    known = [
        *(field.name for kind in (Config, InitialiseSettings, ScaleSettings, Stage) for field in dataclasses.fields(kind)),
        *LOSSES,
        *(field.name for settings in LOSSES.values() for field in dataclasses.fields(settings)),
        *("extends", "metric", "refined", "", "a b", "é", '"', "\n"),
    ]
    values = st.one_of(st.sampled_from(ODD_VALUES), st.sampled_from(list(REFINEMENTS)), st.sampled_from(config_names()))
    tables = st.recursive(values, lambda inner: st.dictionaries(st.sampled_from(known), inner, max_size=3), max_leaves=8)
    return st.dictionaries(st.sampled_from(known), tables, min_size=1, max_size=4).flatmap(
        lambda table: st.sampled_from([table, {"extends": "default"} | table])
    )


def toml(table: Mapping[str, Any]) -> str:
    """A table as TOML, with everything in one line per key."""
    return "".join(f"{_key(key)} = {_value(value)}\n" for key, value in table.items())


def _key(key: str) -> str:
    return json.dumps(key)


def _value(value: Any) -> str:
    if isinstance(value, Mapping):
        return f"{{ {', '.join(f'{_key(key)} = {_value(item)}' for key, item in value.items())} }}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_value, value))}]"
    return str(value) if isinstance(value, float | int) and not isinstance(value, bool) else json.dumps(value)


def texts() -> st.SearchStrategy[bytes]:
    """Files that are TOML, almost TOML, or not at all."""
    written = st.one_of(usable(), odd()).map(lambda table: toml(table).encode())
    return st.one_of(
        written,
        usable().map(lambda table: toml(table).encode()),
        st.tuples(written, st.integers(0, 400), st.binary(max_size=3)).map(
            lambda cut: cut[0][: cut[1]] + cut[2] + cut[0][cut[1] :]
        ),
        st.tuples(written, st.integers(0, 400)).map(lambda cut: cut[0][: cut[1]]),
        st.tuples(written, st.sampled_from(["utf-16", "utf-8-sig", "utf-32"])).map(lambda how: how[0].decode().encode(how[1])),
        st.text(max_size=60).map(lambda text: text.encode("utf-8", "surrogatepass")),
        st.binary(max_size=60),
        st.integers(1, 5000).map(lambda depth: b"a = " + b"[" * depth + b"]" * depth),
        st.integers(1, 3000).map(lambda depth: b"[" + b".".join([b"a"] * depth) + b"]"),
        st.integers(1, 3000).map(lambda depth: b"a = " + b"{ b = " * depth + b"1" + b" }" * depth),
        st.sampled_from(
            [b'extends = "self.toml"', b'extends = "/"', b'extends = "\\u0000"', b"max_offset_s = 1" + b"0" * 5000]
        ),
    )
