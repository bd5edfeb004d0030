"""What may be unknown of a camera beside its pose: lens and clock, each kind one column or two of a keypoint's Jacobian.

The values of a kind are deviations from what was given, zero where that is right, with a normal prior around zero. A camera
may have its own value or share one with others: the unknowns of a rig are a vector (K,), and a camera's own values are a
linear map of it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from torchstickcal.errors import ConfigError
from torchstickcal.geometry.cameras import Intrinsics, PixelMap

Columns = slice | Tensor
"""Some of the columns N: a slice of whole frames, or indices."""

_FOCAL_PRIOR = 0.1
_CENTRE_PRIOR = 0.02
_RADIAL_PRIOR = 0.3


class ImageMotion(NamedTuple):
    """How keypoints move, and where in the image they are read."""

    velocity: Tensor
    """(B, C, 2, N), pixels a frame"""
    row: Tensor
    """(B, C, N), how far below the middle row the keypoint is, as a share of the image's height"""
    reckoned: Tensor
    """(B, K), values of the unknowns at which the keypoints were placed"""

    def at(self, columns: Columns) -> ImageMotion:
        """That of some of the columns N."""
        return ImageMotion(self.velocity[..., columns], self.row[..., columns], self.reckoned)


class Sight(NamedTuple):
    """Points as the cameras see them: all that a column may depend on."""

    u: Tensor
    v: Tensor
    """normalised coordinates, (..., C, N)"""
    pixel: PixelMap
    cameras: Intrinsics
    motion: ImageMotion | None
    """None where no clock is among the unknowns"""


class Kind(ABC):
    """One number per camera."""

    name: str

    @abstractmethod
    def prior(self, cameras: Intrinsics) -> Tensor:
        """Standard deviation of the values before anything is seen, (..., C)."""

    @abstractmethod
    def column(self, sight: Sight) -> tuple[Tensor, Tensor]:
        """Derivatives of a keypoint's projection (x, y) by the value, each (..., C, N), or (..., C, 1) where all are alike."""

    def applied(self, cameras: Intrinsics, values: Tensor) -> Intrinsics:
        """The cameras at values (..., C)."""
        del values
        return cameras


class ClockKind(Kind):
    """A number that says when a camera looked: its column is the keypoints' motion in the image times a factor."""

    prior_frames: float

    @abstractmethod
    def factor(self, row: Tensor) -> Tensor:
        """The delay of keypoints in rows (..., C, N), of :class:`ImageMotion`, for a value of 1, frames."""

    def prior(self, cameras: Intrinsics) -> Tensor:
        return torch.full_like(cameras.focal_px, self.prior_frames)

    def column(self, sight: Sight) -> tuple[Tensor, Tensor]:
        assert sight.motion is not None
        x, y = (sight.motion.velocity * self.factor(sight.motion.row).unsqueeze(-2)).unbind(-2)
        return x, y


class Focal(Kind):
    """Logarithm of the true focal length over the given one."""

    name = "focal"

    def prior(self, cameras: Intrinsics) -> Tensor:
        return torch.full_like(cameras.focal_px, _FOCAL_PRIOR)

    def column(self, sight: Sight) -> tuple[Tensor, Tensor]:
        centre = sight.cameras.matrix[..., :2, 2:]
        return sight.pixel.x - centre[..., 0, :], sight.pixel.y - centre[..., 1, :]

    def applied(self, cameras: Intrinsics, values: Tensor) -> Intrinsics:
        factor = torch.ones_like(cameras.matrix)
        factor[..., :2, :2] = values.exp()[..., None, None]
        return replace(cameras, matrix=cameras.matrix * factor)


class Centre(Kind):
    """Shift of the principal point along one axis, pixels.

    Args:
        axis: 0 for x, 1 for y.
    """

    def __init__(self, axis: int) -> None:
        self.axis, self.name = axis, f"centre_{'xy'[axis]}"

    def prior(self, cameras: Intrinsics) -> Tensor:
        return _CENTRE_PRIOR * cameras.focal_px

    def column(self, sight: Sight) -> tuple[Tensor, Tensor]:
        one = torch.ones_like(sight.cameras.matrix[..., 0, :1])
        return (one, torch.zeros_like(one)) if self.axis == 0 else (torch.zeros_like(one), one)

    def applied(self, cameras: Intrinsics, values: Tensor) -> Intrinsics:
        shift = torch.zeros_like(cameras.matrix)
        shift[..., self.axis, 2] = values
        return replace(cameras, matrix=cameras.matrix + shift)


class Radial(Kind):
    """Correction of a lens's coefficient k1 or k2.

    Args:
        order: 1 or 2.
    """

    def __init__(self, order: int) -> None:
        self.order, self.name = order, f"k{order}"

    def prior(self, cameras: Intrinsics) -> Tensor:
        return torch.full_like(cameras.focal_px, _RADIAL_PRIOR)

    def column(self, sight: Sight) -> tuple[Tensor, Tensor]:
        return sight.cameras.pixels_by_radial(sight.u, sight.v, self.order)

    def applied(self, cameras: Intrinsics, values: Tensor) -> Intrinsics:
        given = cameras.distortion
        if given is None:
            given = cameras.matrix.new_zeros(*cameras.matrix.shape[:-2], 4)
        correction = torch.zeros_like(given)
        correction[..., self.order - 1] = values
        return replace(cameras, distortion=given + correction)


class TimeOffset(ClockKind):
    """How much later than reckoned with a camera's frames are exposed in their middle row, frames."""

    name = "time_offset"
    prior_frames = 0.5

    def factor(self, row: Tensor) -> Tensor:
        return torch.ones_like(row)


class Readout(ClockKind):
    """How much longer than reckoned with it takes from the first row of an image to the last, frames."""

    name = "readout"
    prior_frames = 2.0

    def factor(self, row: Tensor) -> Tensor:
        return row


class Refinement(NamedTuple):
    """Kinds that are found together, and how cameras share them."""

    kinds: tuple[Kind, ...]
    shared: bool = False
    """one value for all cameras of a group instead of one each"""
    against_first: bool = False
    """whether only differences to the first camera can be seen, which is the reference"""


REFINEMENTS = {
    "focal": Refinement((Focal(),)),
    "focal_shared": Refinement((Focal(),), shared=True),
    "principal_point": Refinement((Centre(0), Centre(1))),
    "radial": Refinement((Radial(1), Radial(2))),
    "time_offset": Refinement((TimeOffset(),), against_first=True),
    "readout": Refinement((Readout(),), shared=True),
}
"""What may be refined, by the name that configurations use."""

CLOCKS = {name for name, refinement in REFINEMENTS.items() if any(isinstance(kind, ClockKind) for kind in refinement.kinds)}
"""Those that say when a camera looked."""


@dataclass(frozen=True)
class CameraUnknowns:
    """The unknowns (K,) of a rig's C cameras, of k kinds, in B sessions.

    Args:
        kinds: k of them.
        share: (C, k, K), a camera's own values as a linear map of the rig's.
        prior_sigma: (B, K), standard deviations of the values before anything is seen.
    """

    kinds: tuple[Kind, ...]
    share: Tensor
    prior_sigma: Tensor

    @staticmethod
    def of(names: Sequence[str], cameras: Intrinsics, groups: Sequence[object] | None = None) -> CameraUnknowns:
        """Those of some of :data:`REFINEMENTS`.

        Args:
            names: which.
            cameras: as given, (B, C).
            groups: a label for each camera; those with the same share what is shared, None if all do.

        Raises:
            ConfigError: if there are groups, but not a label for each camera.
        """
        count = cameras.focal_px.shape[-1]
        labels = list(groups) if groups else [None] * count
        if len(labels) != count:
            raise ConfigError(
                "camera groups do not fit the cameras",
                where="camera_groups",
                got=f"{len(labels)} labels",
                expected=f"{count}, one for each camera",
            )
        members = [[c for c in range(count) if labels[c] == label] for label in dict.fromkeys(labels)]
        kinds: list[Kind] = []
        columns: list[tuple[int, list[int]]] = []
        priors: list[Tensor] = []
        for refinement in (REFINEMENTS[name] for name in names):
            for kind in refinement.kinds:
                own = [[camera] for camera in range(int(refinement.against_first), count)]
                columns += [(len(kinds), sharing) for sharing in (members if refinement.shared else own)]
                kinds.append(kind)
        share = cameras.matrix.new_zeros(count, len(kinds), len(columns))
        for column, (kind, sharing) in enumerate(columns):
            share[sharing, kind, column] = 1.0
            priors.append(kinds[kind].prior(cameras)[..., sharing].mean(-1))
        return CameraUnknowns(tuple(kinds), share, torch.stack(priors, dim=-1))

    @staticmethod
    def stack(sessions: Sequence[CameraUnknowns]) -> CameraUnknowns:
        """The same unknowns in several sessions as those of one batch."""
        return replace(sessions[0], prior_sigma=torch.cat([session.prior_sigma for session in sessions]))

    def __getitem__(self, sessions: slice | list[int]) -> CameraUnknowns:
        """Those of some of the sessions."""
        return replace(self, prior_sigma=self.prior_sigma[sessions])

    @property
    def count(self) -> int:
        """K"""
        return self.share.shape[2]

    @property
    def clocked(self) -> bool:
        """Whether clocks are among them."""
        return any(isinstance(kind, ClockKind) for kind in self.kinds)

    def by_camera(self, values: Tensor) -> Tensor:
        """Every camera's own values (B, C, k), of the rig's (B, K)."""
        return torch.einsum("ckj,bj->bck", self.share, values)

    def by_kind(self, values: Tensor) -> dict[str, Tensor]:
        """Every camera's own values (B, C) by the name of the kind, of the rig's (B, K)."""
        return dict(zip((kind.name for kind in self.kinds), self.by_camera(values).unbind(-1), strict=True))

    def taken_over(self, others: CameraUnknowns, values: Tensor) -> Tensor:
        """Values (B, K) that are those of others (B, K') where these know the kind, else zero; shared ones are means."""
        by_kind = others.by_kind(values)
        nothing = values.new_zeros(len(values), len(self.share))
        own = torch.stack([by_kind.get(kind.name, nothing) for kind in self.kinds], dim=-1)
        return torch.einsum("ckj,bck->bj", self.share, own) / self.share.sum((0, 1))

    def unshared(self) -> CameraUnknowns:
        """The same where every camera has a value of its own of every kind: K = C k, :meth:`by_camera` flattened."""
        cameras, kinds, _ = self.share.shape
        share = torch.eye(cameras * kinds).to(self.share).unflatten(0, (cameras, kinds))
        return CameraUnknowns(self.kinds, share, self.by_camera(self.prior_sigma).flatten(1))

    def applied(self, cameras: Intrinsics, values: Tensor) -> Intrinsics:
        """The cameras at values (B, K)."""
        for kind, own in zip(self.kinds, self.by_camera(values).unbind(-1), strict=True):
            cameras = kind.applied(cameras, own)
        return cameras

    def delays(self, row: Tensor, values: Tensor) -> Tensor:
        """How much later than reckoned with keypoints (B, C, N) were exposed at values (B, K), frames.

        Args:
            row: of :class:`ImageMotion`, (B, C, N).
            values: of the unknowns.
        """
        delays = torch.zeros_like(row)
        for kind, own in zip(self.kinds, self.by_camera(values).unbind(-1), strict=True):
            if isinstance(kind, ClockKind):
                delays = delays + kind.factor(row) * own[..., None]
        return delays

    def displaced(self, pixels: Tensor, values: Tensor, motion: ImageMotion | None) -> Tensor:
        """Keypoints (B, C, 2, N) placed at other values (B, K) of the clocks than those reckoned with."""
        if motion is None:
            return pixels
        return pixels - motion.velocity * self.delays(motion.row, values - motion.reckoned).unsqueeze(-2)

    def columns(
        self, u: Tensor, v: Tensor, pixel: PixelMap, cameras: Intrinsics, motion: ImageMotion | None
    ) -> tuple[Tensor, Tensor]:
        """Derivatives of projections (x, y) by each camera's own values, each (B, C, k, N).

        Args:
            u, v: normalised coordinates, (B, C, N).
            pixel: the projections there.
            cameras: as they are.
            motion: of the keypoints, where clocks are among the unknowns.
        """
        sight = Sight(u, v, pixel, cameras, motion)
        found = [kind.column(sight) for kind in self.kinds]
        x, y = (torch.stack([axis.expand_as(sight.u) for axis in axes], dim=-2) for axes in zip(*found, strict=True))
        return x, y

    def moved(
        self, u: Tensor, v: Tensor, pixel: PixelMap, cameras: Intrinsics, motion: ImageMotion | None, step: Tensor
    ) -> tuple[Tensor, Tensor]:
        """How projections (x, y), each (B, C, N), move with a step (B, K); the rest as of :meth:`columns`."""
        own = self.by_camera(step)[..., None]
        x, y = self.columns(u, v, pixel, cameras, motion)
        return (own * x).sum(-2), (own * y).sum(-2)
