"""The unknowns of a whole rig, as one vector that the solvers estimate beside poses and points."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from torchstickcal.errors import ConfigError
from torchstickcal.geometry.cameras import Intrinsics, PixelMap
from torchstickcal.model.unknowns.base import CameraUnknown, ClockUnknown, ImageMotion, Sharing, View
from torchstickcal.model.unknowns.registered import REFINEMENTS

_IN_COMMON = 0.5
"""Share of the variance of calibrated values that the cameras of a rig have in common: one target, one way of calibrating."""


@dataclass(frozen=True)
class RigUnknowns:
    """The unknowns (K,) of a rig's C cameras, k numbers per camera, in B sessions. K is 0 where only poses are unknown.

    Args:
        unknowns: the unknowns; together they have k components.
        share: (C, k, K), a camera's own values as a linear map of the rig's.
        prior_sigma: (B, K), standard deviations of the values before anything was seen.
    """

    unknowns: tuple[CameraUnknown, ...]
    share: Tensor
    prior_sigma: Tensor

    @staticmethod
    def of(names: Sequence[str], cameras: Intrinsics, groups: Sequence[object] = ()) -> RigUnknowns:
        """The unknowns that some of :data:`REFINEMENTS` stand for.

        Args:
            names: the refinements.
            cameras: as given, (B, C).
            groups: a label for each camera; cameras with the same label are a group. Empty: all cameras are one group.

        Raises:
            ConfigError: for an unknown name, and if there are labels, but not one for each camera.
        """
        sessions, count = cameras.focal_px.shape
        labels = list(groups) if groups else [None] * count
        if len(labels) != count:
            raise ConfigError(
                "camera groups do not fit the cameras",
                where="camera_groups",
                got=f"{len(labels)} labels",
                expected=f"{count}, one for each camera",
            )
        chosen = [REFINEMENTS[name] for name in names]
        columns = [
            (component, members)
            for component, sharing in enumerate(sharing for unknown, sharing in chosen for _ in unknown.components)
            for members in _sharing_cameras(sharing, labels)
        ]
        components = sum(len(unknown.components) for unknown, _ in chosen)
        shared = np.zeros((count, components, len(columns)))
        for column, (component, members) in enumerate(columns):
            shared[members, component, column] = 1.0
        share = torch.from_numpy(shared).to(cameras.matrix)
        priors = torch.cat(
            [cameras.matrix.new_zeros(sessions, count, 0), *(unknown.prior(cameras) for unknown, _ in chosen)], -1
        )
        prior_sigma = priors.flatten(1) @ share.flatten(0, 1) / share.sum((0, 1))
        return RigUnknowns(tuple(unknown for unknown, _ in chosen), share, prior_sigma)

    @staticmethod
    def stack(sessions: Sequence[RigUnknowns]) -> RigUnknowns:
        """The same unknowns in several sessions as one batch."""
        return replace(sessions[0], prior_sigma=torch.cat([session.prior_sigma for session in sessions]))

    def __getitem__(self, sessions: slice | list[int]) -> RigUnknowns:
        """The unknowns of some of the sessions."""
        return replace(self, prior_sigma=self.prior_sigma[sessions])

    @property
    def count(self) -> int:
        """K"""
        return self.share.shape[2]

    @property
    def components(self) -> int:
        """k"""
        return self.share.shape[1]

    @property
    def clocked(self) -> bool:
        """Whether clocks are among them."""
        return any(isinstance(unknown, ClockUnknown) for unknown in self.unknowns)

    @property
    def given(self) -> Tensor:
        """(B, K), the values of cameras as given: zero."""
        return torch.zeros_like(self.prior_sigma)

    def by_camera(self, values: Tensor) -> Tensor:
        """Every camera's own values (B, C, k), of the rig's (B, K)."""
        return (values @ self.share.flatten(0, 1).mT).unflatten(1, self.share.shape[:2])

    def by_name(self, values: Tensor) -> dict[str, Tensor]:
        """Every camera's own values (B, C, n) by the name of the unknown, of the rig's (B, K)."""
        return {unknown.name: own for unknown, own in self._split(self.by_camera(values))}

    def variances(self, covariance: Tensor) -> dict[str, Tensor]:
        """Variances (C, n) of every camera's own values by the name of the unknown, of the rig's covariance (K, K)."""
        own = ((self.share @ covariance) * self.share).sum(-1)
        return {unknown.name: part[0] for unknown, part in self._split(own[None])}

    def of_cameras(self, own: Mapping[str, Tensor]) -> Tensor:
        """Values (B, K) from every camera's own (B, C, n) by the name of the unknown; zero without; means where shared."""
        sessions, cameras = len(self.prior_sigma), len(self.share)
        zero = self.share.new_zeros(sessions, cameras, 0)
        known = [own.get(u.name, zero.new_zeros(sessions, cameras, len(u.components))) for u in self.unknowns]
        return torch.cat([*known, zero], dim=-1).flatten(1) @ self.share.flatten(0, 1) / self.share.sum((0, 1))

    def taken_over(self, others: RigUnknowns, values: Tensor) -> Tensor:
        """Values (B, K) from those (B, K') of other unknowns, as by :meth:`of_cameras`."""
        return self.of_cameras(others.by_name(values))

    @property
    def columns(self) -> dict[str, Tensor]:
        """Which of the K values belong to each unknown, by its name."""
        parts = self._split(self.share.sum(0).mT)
        return {unknown.name: part.any(-1).nonzero().flatten() for unknown, part in parts}

    @property
    def usual_sigma(self) -> Tensor:
        """Standard deviations (B, K) of calibrated values around the truth; a little smaller for means of several cameras."""
        usual = torch.zeros_like(self.prior_sigma)
        for unknown in self.unknowns:
            usual[:, self.columns[unknown.name]] = unknown.usual_prior_share
        in_mean = _IN_COMMON + (1 - _IN_COMMON) / self.share.sum((0, 1))
        return usual * self.prior_sigma * in_mean.sqrt()

    def applied(self, cameras: Intrinsics, values: Tensor) -> Intrinsics:
        """The cameras at values (B, K)."""
        return self.applied_by_camera(cameras, self.by_camera(values))

    def applied_by_camera(self, cameras: Intrinsics, values: Tensor) -> Intrinsics:
        """The cameras at each camera's own values (B, C, k)."""
        for unknown, own in self._split(values):
            cameras = unknown.applied(cameras, own)
        return cameras

    def delays(self, row: Tensor, values: Tensor) -> Tensor:
        """Delays (B, C, N) of the keypoints' exposures in frames, at values (B, K), for rows of :class:`ImageMotion`."""
        return self.delays_by_camera(row, self.by_camera(values))

    def delays_by_camera(self, row: Tensor, values: Tensor) -> Tensor:
        """:meth:`delays` at each camera's own values (B, C, k)."""
        delays = torch.zeros_like(row)
        for unknown, own in self._split(values):
            if isinstance(unknown, ClockUnknown):
                delays = delays + unknown.factor(row) * own.to(row)
        return delays

    def displaced(self, pixels: Tensor, values: Tensor, motion: ImageMotion | None) -> Tensor:
        """Keypoints (B, C, 2, N) moved along their motion to where other values (B, K) of the clocks place them."""
        if motion is None:
            return pixels
        return pixels - motion.velocity * self.delays(motion.row, values - motion.reference).unsqueeze(-2)

    def projection_derivatives(
        self, u: Tensor, v: Tensor, pixel: PixelMap, cameras: Intrinsics, motion: ImageMotion | None
    ) -> tuple[Tensor, Tensor]:
        """Derivatives of projections (x, y) by each camera's own values, each (B, C, k, N).

        Args:
            u, v: normalised coordinates, (B, C, N).
            pixel: the projections there.
            cameras: as they are.
            motion: of the keypoints, where clocks are among the unknowns.
        """
        view = View(u, v, pixel, cameras, motion)
        found = [unknown.projection_derivatives(view) for unknown in self.unknowns]
        points = u.shape[-1]
        x, y = (torch.cat([c.expand(*c.shape[:-1], points) for c in axis], dim=-2) for axis in zip(*found, strict=True))
        return x, y

    def _split(self, by_camera: Tensor) -> list[tuple[CameraUnknown, Tensor]]:
        """Each unknown with its own part (..., n) of values (..., k)."""
        sizes = [len(unknown.components) for unknown in self.unknowns]
        return list(zip(self.unknowns, by_camera.split(sizes, dim=-1), strict=True)) if sizes else []


def _sharing_cameras(sharing: Sharing, labels: Sequence[object]) -> list[list[int]]:
    """The cameras that have each value in common."""
    everyone = range(len(labels))
    if sharing is Sharing.GROUP:
        return [[camera for camera in everyone if labels[camera] == label] for label in dict.fromkeys(labels)]
    return [[camera] for camera in everyone[int(sharing is Sharing.RELATIVE) :]]
