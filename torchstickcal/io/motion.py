"""Points in space over time, as files hold them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from torchstickcal.errors import CalibrationError
from torchstickcal.world import World

_MOST_EMPTY = 20
"""Frames that a file may have for each frame that is known."""


class Scene(Protocol):
    """What has points in space: a calibration, or what was triangulated with one."""

    @property
    def points(self) -> Tensor: ...
    @property
    def points_std_m(self) -> Tensor: ...
    @property
    def times(self) -> Tensor | None: ...
    @property
    def fps(self) -> float | None: ...
    @property
    def point_names(self) -> tuple[str, ...] | None: ...
    @property
    def world(self) -> World: ...


@dataclass(frozen=True, eq=False)
class Motion:
    """P points in G frames, metres."""

    points: NDArray[np.float64]
    """(G, P, 3), NaN where not known"""
    names: tuple[str, ...]
    """P names"""
    rate_hz: float | None = None
    """frames per second"""
    times: NDArray[np.float64] | None = None
    """(G,), seconds; None without a frame rate"""
    std_m: NDArray[np.float64] | None = None
    """(G, P), standard deviations of the points; NaN or None where not known"""
    world: World | None = None
    """the frame; None where a file does not say it"""
    events: tuple[tuple[str, float], ...] = ()
    """names and times of events, seconds on the clock of ``times``; formats without events leave them out"""

    @staticmethod
    def of(scene: Scene | Motion) -> Motion:
        """The points of a calibration, or of what was triangulated with one."""
        if isinstance(scene, Motion):
            return scene
        times = None if scene.times is None else scene.times.double().cpu().numpy()
        steps = np.diff(times) if times is not None and len(times) > 1 else np.array([])
        rate = scene.fps or (float(1 / np.median(steps)) if len(steps) else None)
        points = scene.points.double().cpu().numpy()
        names = scene.point_names or tuple(f"point {number}" for number in range(points.shape[1]))
        return Motion(points, names, rate, times, scene.points_std_m.double().cpu().numpy(), scene.world)

    def evenly(self, what: str) -> Motion:
        """The same with a frame for every instant, empty ones where the recording pauses, for formats without times.

        Args:
            what: the format, for the message.

        Raises:
            CalibrationError: if the frame rate is not known, or if nearly all frames would be empty.
        """
        if self.rate_hz is None:
            raise CalibrationError(
                "a format that needs a frame rate",
                where=what,
                got="a recording without one",
                expected="frames per second",
                remedy="Give it with --fps.",
            )
        if self.times is None or not len(self.times):
            return self
        places = np.rint((self.times - self.times[0]) * self.rate_hz).astype(np.int64)
        if np.array_equal(places, np.arange(len(places))):
            return self
        if len(np.unique(places)) != len(places) or places[-1] >= _MOST_EMPTY * len(places):
            got = f"{len(places)} frames within {places[-1] + 1}"
            raise CalibrationError(
                "frames that are not evenly spaced", where=what, got=got, expected="frames at equal intervals"
            )

        def spread(values: NDArray[Any]) -> NDArray[Any]:
            filled = np.full((int(places[-1]) + 1, *values.shape[1:]), np.nan)
            filled[places] = values
            return filled

        times = self.times[0] + np.arange(int(places[-1]) + 1) / self.rate_hz
        std_m = None if self.std_m is None else spread(self.std_m)
        return replace(self, points=spread(self.points), times=times, std_m=std_m)

    def known(self) -> Motion:
        """The points that are known in some frame."""
        kept = np.asarray(np.isfinite(self.points).all(-1).any(0))
        names = tuple(name for name, keep in zip(self.names, kept, strict=True) if keep)
        return replace(
            self, points=self.points[:, kept], names=names, std_m=None if self.std_m is None else self.std_m[:, kept]
        )

    def with_y_up(self) -> Motion:
        """The same with y up: z of the frame becomes y; in the frame of a camera, y and z are turned round.

        The frame of a camera is upright in this way as far as the camera is.
        """
        x, y, z = np.moveaxis(self.points, -1, 0)
        turned = (x, -y, -z) if self.world is not None and self.world.name == "camera" else (x, z, -y)
        return replace(self, points=np.stack(turned, axis=-1))
