"""Trial of a new camera unknown on some cameras, when it is registered: a mistake is reported there, by name."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import torch
from torch import Tensor

from torchstickcal.errors import CalibrationError, ConfigError
from torchstickcal.geometry.cameras import Intrinsics
from torchstickcal.model.unknowns.base import (
    CameraUnknown,
    ClockUnknown,
    ImageMotion,
    LensUnknown,
    RigEstimate,
    Sharing,
    View,
)

_STEP = 0.1
"""Deviations that are tried, as a fraction of the prior's standard deviation."""
_TOLERANCE = 1e-9


def try_unknown(unknown: CameraUnknown, others: Iterable[CameraUnknown], replace: bool) -> None:
    """Try an unknown.

    Args:
        unknown: the unknown.
        others: those that are registered already.
        replace: whether one of them may have the same name.

    Raises:
        ConfigError: if it does not do what :class:`CameraUnknown` says.
    """
    _check_attributes(unknown)
    if not replace and any(other.name == unknown.name for other in others):
        raise _fault(unknown, "another unknown has this name", f"name = {unknown.name!r}", "another name, or replace=True")
    for cameras in _sample_cameras():
        try:
            _check_on(unknown, cameras, [other for other in others if other.name != unknown.name])
        except CalibrationError:
            raise
        except Exception as error:
            lens = "no distortion (cameras.distortion is None)" if cameras.distortion is None else "distortion"
            got = f"{type(error).__name__}: {error}"
            raise _fault(unknown, f"it fails on cameras with {lens}", got, "an unknown that works for all lenses") from error


def _check_attributes(unknown: CameraUnknown) -> None:
    for attribute in ("name", "label", "unit"):
        if not isinstance(value := getattr(unknown, attribute, None), str):
            raise _fault(unknown, f"attribute `{attribute}`", repr(value), "a text")
    components = getattr(unknown, "components", None)
    if not isinstance(components, tuple) or not components or not all(isinstance(name, str) for name in components):
        raise _fault(unknown, "attribute `components`", repr(components), "a tuple with the name of each number")
    variants = getattr(unknown, "variants", None)
    if not isinstance(variants, dict) or not variants or not all(isinstance(s, Sharing) for s in variants.values()):
        raise _fault(unknown, "attribute `variants`", repr(variants), "a dictionary from names to members of Sharing")
    if not isinstance(unknown, LensUnknown | ClockUnknown):
        raise _fault(unknown, "base class", type(unknown).__mro__[1].__name__, "LensUnknown or ClockUnknown")


def _check_on(unknown: CameraUnknown, cameras: Intrinsics, others: list[CameraUnknown]) -> None:
    count = len(unknown.components)
    prior = unknown.prior(cameras)
    if prior.shape != (1, 2, count) or not bool((prior > 0).all()):
        got = f"{tuple(prior.shape)}, {prior.flatten().tolist()}"
        raise _fault(unknown, "prior", got, f"(..., cameras, {count}), above 0, one number for each of `components`")
    if isinstance(unknown, LensUnknown) and (shape := unknown.values(cameras).shape) != (1, 2, count):
        raise _fault(unknown, "values", tuple(shape), f"(..., cameras, {count}), one number for each of `components`")
    _check_deviations(unknown, cameras, _STEP * prior, others)
    u, v = (
        torch.tensor([[[-0.3, 0.1, 0.4]]]).double().expand(1, 2, 3),
        torch.tensor([[[0.2, -0.2, 0.1]]]).double().expand(1, 2, 3),
    )
    row = torch.tensor([-0.4, 0.1, 0.3], dtype=torch.float64).expand(1, 2, 3)
    motion = ImageMotion(torch.ones(1, 2, 2, 3, dtype=torch.float64), row, prior.new_zeros(1, 0))
    derivatives = unknown.projection_derivatives(View(u, v, cameras.pixels_with_jacobian(u, v), cameras, motion))
    for axis in derivatives:
        if axis.shape not in {(1, 2, count, 3), (1, 2, count, 1)} or not bool(axis.isfinite().all()):
            raise _fault(unknown, "projection_derivatives", f"{tuple(axis.shape)}", f"finite, (1, 2, {count}, 3 or 1)")
    if not any(bool(axis.any()) for axis in derivatives):
        raise _fault(unknown, "a deviation", "the same projections", "other projections")
    estimate = RigEstimate(
        cameras[0], cameras[0], 0.02, prior.new_zeros(2), 0.0, {u.name: prior.new_zeros(2, len(u.components)) for u in others}
    )
    estimate.deviations.setdefault("readout", prior.new_zeros(2, 1))
    estimate.deviations[unknown.name] = prior.new_zeros(2, count)
    for values in unknown.in_units(estimate):
        if values.shape != (2, count):
            raise _fault(unknown, "in_units", tuple(values.shape), f"(cameras, {count}), one number for each of `components`")


def _check_deviations(unknown: CameraUnknown, cameras: Intrinsics, step: Tensor, others: list[CameraUnknown]) -> None:
    """No deviation changes nothing, deviations add up, and the order of different unknowns does not matter."""
    matrix = cameras.matrix.clone()
    unknown.applied(cameras, step)
    if not torch.equal(matrix, cameras.matrix):
        raise _fault(unknown, "applied", "it changes the cameras that it is given", "a changed copy")
    if not _alike(unknown.applied(cameras, torch.zeros_like(step)), cameras):
        raise _fault(unknown, "applied, no deviation", "other cameras", "the same cameras")
    twice = unknown.applied(unknown.applied(cameras, step), step)
    if not _alike(twice, unknown.applied(cameras, 2 * step)):
        raise _fault(unknown, "applied, a deviation twice", "not twice the deviation", "deviations that add up")
    for other in others:
        own = torch.full_like(other.prior(cameras), _STEP) * other.prior(cameras)
        first = other.applied(unknown.applied(cameras, step), own)
        if not _alike(first, unknown.applied(other.applied(cameras, own), step)):
            expected = "the same in any order: write what adds to a multiple of the focal length as a fraction of it"
            raise _fault(unknown, f"applied before or after {other.name!r}", "other cameras", expected)


def _alike(some: Intrinsics, others: Intrinsics) -> bool:
    def numbers(cameras: Intrinsics) -> Tensor:
        coefficients = cameras.matrix.new_zeros(14) if cameras.distortion is None else cameras.distortion
        coefficients = torch.nn.functional.pad(coefficients, (0, 14 - coefficients.shape[-1]))
        return torch.cat([cameras.matrix.flatten(-2), coefficients.expand(*cameras.matrix.shape[:-2], 14)], dim=-1)

    return torch.allclose(numbers(some), numbers(others), rtol=_TOLERANCE, atol=_TOLERANCE)


def _sample_cameras() -> Iterator[Intrinsics]:
    """A pair of cameras with each kind of lens; they have a little skew."""
    matrix = torch.tensor([[1200.0, 3, 640], [0, 1190, 350], [0, 0, 1]], dtype=torch.float64).repeat(1, 2, 1, 1)
    yield Intrinsics(matrix)
    yield Intrinsics(matrix, torch.tensor([-0.1, 0.02, 1e-3, -1e-3, 0.01], dtype=torch.float64).expand(1, 2, 5))
    yield Intrinsics(matrix, torch.tensor([-0.02, 0.004, 0.0, 0.001], dtype=torch.float64).expand(1, 2, 4), fisheye=True)


def _fault(unknown: CameraUnknown, what: str, got: object, expected: str) -> ConfigError:
    return ConfigError("unusable camera unknown", where=f"{type(unknown).__name__}: {what}", got=got, expected=expected)
