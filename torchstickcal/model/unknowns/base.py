"""What may be unknown of a camera beside its pose, and how a new such unknown is added.

An unknown is one class in one file of this folder. It says what its numbers are called, how large they may be, and what they do
to a camera. Configurations, both solvers, the covariance, the check of the given cameras, ``auto``, results, tables and the
command line take it from there.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from enum import Enum
from typing import ClassVar, Literal, NamedTuple

import torch
from torch import Tensor

from torchstickcal.dual import dual, dual_numbers, tangent
from torchstickcal.geometry.cameras import Intrinsics, PixelMap

Columns = slice | Tensor
"""Some of the columns N: a slice of whole frames, or indices."""


class Sharing(Enum):
    """Which cameras have one value in common."""

    OWN = "each camera has its own value"
    GROUP = "the cameras of a group have one value in common"
    RELATIVE = "each camera but the first has its own value, relative to the first"


class ImageMotion(NamedTuple):
    """How keypoints move in the image, and in which row they lie."""

    velocity: Tensor
    """(B, C, 2, N), pixels per frame"""
    row: Tensor
    """(B, C, N), distance below the middle row as a fraction of the image height"""
    reference: Tensor
    """(B, K), the values of the unknowns for which the keypoints were moved to the common clock"""

    def at(self, columns: Columns) -> ImageMotion:
        """The motion at some of the columns N."""
        return ImageMotion(self.velocity[..., columns], self.row[..., columns], self.reference)


class View(NamedTuple):
    """Points as the cameras see them: everything that a derivative may depend on."""

    u: Tensor
    v: Tensor
    """normalised image coordinates, (..., C, N)"""
    pixel: PixelMap
    """the projections there"""
    cameras: Intrinsics
    motion: ImageMotion | None
    """motion of the keypoints; None where no clock is unknown"""


class RigEstimate(NamedTuple):
    """Where an estimated rig ended, for :meth:`CameraUnknown.in_units`."""

    given: Intrinsics
    """the C cameras as given"""
    found: Intrinsics
    """the C cameras as found"""
    frame_period_s: float
    """duration of a frame; NaN where the frame rate is not known"""
    frame_offsets: Tensor
    """(C,), offsets in frames by which the cameras' frames were moved before the adjustment"""
    readout_s: float
    """the read-out time given, seconds"""
    deviations: dict[str, Tensor]
    """(C, n), the deviations found, by the name of the unknown"""


class InUnits(NamedTuple):
    """An unknown's numbers in its unit."""

    value: Tensor
    """(C, n), as found; as given where it was not refined"""
    given: Tensor
    """(C, n), as given"""
    per_deviation: Tensor
    """(C, n), derivative of the value by the deviation: the factor between their standard deviations"""


class CameraUnknown(ABC):
    """Something that is unknown of each camera: n numbers, estimated as deviations from what was given.

    A deviation is zero where the camera is as given, and has a normal prior around zero.

    A new unknown subclasses :class:`LensUnknown` or :class:`ClockUnknown`, sets the class attributes below, and is registered
    with :func:`register_unknown`.
    """

    name: ClassVar[str]
    """what results call it"""
    label: ClassVar[str]
    """what people call it"""
    unit: ClassVar[str]
    """of its values"""
    components: ClassVar[tuple[str, ...]]
    """names of its n numbers"""
    variants: ClassVar[dict[str, Sharing]]
    """the names by which configurations refine it, and which cameras then share a value"""
    family: ClassVar[Literal["lens", "clock"]]
    """``auto`` tries every combination of the unknowns of one family"""
    tried_by_auto: ClassVar[bool] = True
    """whether ``auto`` may refine it"""
    noticeable_prior_share: ClassVar[float | None] = None
    """difference from the given value that is worth a warning, as a fraction of the prior's standard deviation; None for no
    warning"""

    usual_prior_share: ClassVar[float] = 0.0
    """how far values that were calibrated usually are from the truth: the standard deviation, as a fraction of the prior's; 0
    where there is no usual error. ``auto`` leaves values alone that are not farther from the given ones"""

    @abstractmethod
    def prior(self, cameras: Intrinsics) -> Tensor:
        """Standard deviation of the deviations before anything was seen, (..., C, n)."""

    def applied(self, cameras: Intrinsics, deviations: Tensor) -> Intrinsics:
        """The cameras at deviations (..., C, n).

        Deviations add up: applying a and then b is applying a + b. The order in which different unknowns are applied does not
        matter: write what adds to a multiple of the focal length as a fraction of it. :func:`register_unknown` tries both.
        """
        del deviations
        return cameras

    @abstractmethod
    def projection_derivatives(self, view: View) -> tuple[Tensor, Tensor]:
        """Derivatives of the projections (x, y) by the deviations, each (..., C, n, N) or (..., C, n, 1), pixels."""

    @abstractmethod
    def in_units(self, estimate: RigEstimate) -> InUnits:
        """The numbers in the unknown's unit."""


class LensUnknown(CameraUnknown):
    """An unknown that changes the camera matrix or the distortion.

    ``applied`` and ``values`` are all that has to be written. Derivatives come from them by automatic differentiation; a
    subclass may give them in closed form, which is faster.
    """

    family = "lens"

    @abstractmethod
    def applied(self, cameras: Intrinsics, deviations: Tensor) -> Intrinsics: ...

    @abstractmethod
    def values(self, cameras: Intrinsics) -> Tensor:
        """The numbers of cameras in the unknown's unit, (..., C, n)."""

    def value_derivatives(self, cameras: Intrinsics) -> Tensor:
        """Derivative of each of :meth:`values` by its deviation, (..., C, n)."""

        def values(deviations: Tensor) -> tuple[Tensor]:
            return (self.values(self.applied(cameras, deviations)),)

        zero = torch.zeros_like(self.values(cameras))
        return torch.stack([_derivative(values, zero, n)[0][..., n] for n in range(len(self.components))], dim=-1)

    def projection_derivatives(self, view: View) -> tuple[Tensor, Tensor]:
        def projection(deviations: Tensor) -> tuple[Tensor, Tensor]:
            return self.applied(view.cameras, deviations).pixels(view.u, view.v)

        zero = view.cameras.matrix.new_zeros(*view.cameras.focal_px.shape, len(self.components))
        found = [_derivative(projection, zero, component) for component in range(len(self.components))]
        x, y = (torch.stack(axis, dim=-2) for axis in zip(*found, strict=True))
        return x, y

    def in_units(self, estimate: RigEstimate) -> InUnits:
        return InUnits(self.values(estimate.found), self.values(estimate.given), self.value_derivatives(estimate.found))


class ClockUnknown(CameraUnknown):
    """An unknown that says when a camera exposed its images: its deviations are counted in frames, its values in seconds.

    The derivative of a keypoint is its motion in the image times :meth:`factor`, which depends on its row in the image, not
    on its frame. ``readout.py`` is an example.
    """

    family = "clock"
    unit = "s"
    prior_frames: ClassVar[float]
    """standard deviation of the deviation before anything was seen, frames"""

    @staticmethod
    def seconds(frames: Tensor, estimate: RigEstimate) -> Tensor:
        """Frames as seconds; NaN where the frame rate is not known, but for zero."""
        return torch.where(frames == 0, 0.0, frames * estimate.frame_period_s)

    @abstractmethod
    def factor(self, row: Tensor) -> Tensor:
        """Delay of keypoints in rows (..., C, N), of :class:`ImageMotion`, for a deviation of 1, frames."""

    def prior(self, cameras: Intrinsics) -> Tensor:
        return torch.full_like(cameras.focal_px, self.prior_frames).unsqueeze(-1)

    def projection_derivatives(self, view: View) -> tuple[Tensor, Tensor]:
        assert view.motion is not None
        x, y = (view.motion.velocity * self.factor(view.motion.row).unsqueeze(-2)).unbind(-2)
        return x.unsqueeze(-2), y.unsqueeze(-2)


def _derivative(function: Callable[[Tensor], tuple[Tensor, ...]], at: Tensor, component: int) -> tuple[Tensor, ...]:
    """Derivatives of a function's tensors by one of the numbers of all cameras, of a point (..., C, n)."""
    direction = torch.zeros_like(at)
    direction[..., component] = 1.0
    with dual_numbers():
        return tuple(map(tangent, function(dual(at, direction))))
