"""The pixels of a marker, and where its centre is along the stick although the stick hides a part of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_CORE = 0.5
"""Share of a marker in a pixel, over the usual one, from which the pixel is inside the marker."""
_OUTER = 0.55
"""A stick is narrower than this share of the marker that goes around it."""
_COVERED = 0.3
"""Share of an end of a marker at which another thing is seen, more than at the opposite end, from which it may be covered."""
_LEAST_BESIDE = 0.12
"""Share of a marker that must be beside the stick."""


class _Layout(NamedTuple):
    """The pixels around a marker in the directions of the stick."""

    along: Array
    """(h, w), from the centre of what is seen of the marker"""
    across: Array
    """(h, w)"""
    around: NDArray[np.bool_]
    """(h, w), just outside the marker"""
    hidden_px: float
    """how far from the middle of the stick something hides the marker; 0 where nothing does"""
    width_px: float
    """half the width of the marker"""


@dataclass(frozen=True, eq=False)
class Patch:
    """The pixels of a marker in one frame.

    Args:
        shares: of the marker in each pixel, (h, w).
        other: where another thing than marker and background is seen, (h, w).
        corner: x, y of the first pixel.
    """

    shares: NDArray[np.float32]
    other: NDArray[np.bool_]
    corner: tuple[int, int]

    @property
    def centre(self) -> Array:
        """Centre x, y of what is seen of the marker, pixels of the image."""
        return (self._places() * self.shares).sum((1, 2)) / self.shares.sum()

    def centre_on(self, axis: Array) -> Array | None:
        """Centre x, y of a marker on a stick with the direction ``axis`` (2,), in the image; None where it is not sure.

        A ball is symmetric about its centre. Where the stick points at the camera, its near half hides a part of the ball, but
        not what is beside the stick: along the stick, only this counts. A marker that is covered has no sure centre.
        """
        unit = axis / np.linalg.norm(axis)
        layout = self._layout(unit)
        if self._is_covered(layout):
            return None
        beside = np.where(np.abs(layout.across) > layout.hidden_px, self.shares, 0.0)
        if beside.sum() < _LEAST_BESIDE * self.shares.sum():
            return None
        return self.centre + (beside * layout.along).sum() / beside.sum() * unit

    def is_covered(self, axis: Array) -> bool:
        """Whether beside a stick of direction ``axis`` (2,) another thing touches one end of the marker and not the other.

        It may be a hand that covers this end: where the end is cannot be said.
        """
        return self._is_covered(self._layout(axis / np.linalg.norm(axis)))

    def _places(self) -> Array:
        """(2, h, w), x and y of the pixels."""
        return np.indices(self.shares.shape, dtype=np.float64)[::-1] + np.array(self.corner, dtype=np.float64)[:, None, None]

    def _layout(self, unit: Array) -> _Layout:
        offsets = self._places() - self.centre[:, None, None]
        along = unit[0] * offsets[0] + unit[1] * offsets[1]
        across = unit[0] * offsets[1] - unit[1] * offsets[0]
        core = self.shares > _CORE * np.percentile(self.shares[self.shares > 0], 75)
        around = (cv2.dilate(core.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0) & ~core
        width_px = float(np.abs(across[core]).max())
        touching = np.abs(across[around & self.other & (np.abs(across) < width_px)])
        hidden_px = 1.5 * float(np.median(touching)) + 0.75 if len(touching) else 0.0
        return _Layout(along, across, around, hidden_px, width_px)

    def _is_covered(self, layout: _Layout) -> bool:
        aside = np.abs(layout.across)
        around = layout.around & (aside > max(layout.hidden_px, _OUTER * layout.width_px)) & (aside < layout.width_px + 0.5)
        ends = [self.other[around & (sign * layout.along > 0)] for sign in (-1, 1)]
        before, after = (float(end.mean()) if len(end) else 0.0 for end in ends)
        return abs(before - after) > _COVERED
