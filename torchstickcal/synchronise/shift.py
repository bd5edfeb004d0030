"""Sessions on a common frame axis."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from torchstickcal.errors import ObservationError
from torchstickcal.observations import Observations


def shifted(observations: Observations, shifts: Tensor) -> tuple[Observations, int]:
    """A session whose cameras' frames are moved by whole frames: camera c's frame f becomes the common frame f + shifts[c].

    Args:
        observations: the session.
        shifts: whole numbers of frames (C,).

    Returns:
        The session on the common frames that two cameras or more have, NaN where a camera has none; and the first of these.

    Raises:
        ObservationError: if no two cameras have a frame in common, or the stick is never seen by two cameras there.
    """
    frames, moves = observations.num_frames, [int(shift) for shift in shifts]
    first, end = sorted(moves)[1], sorted(moves)[-2] + frames
    if end <= first:
        raise ObservationError(
            "no two cameras have a frame in common",
            where="shifts",
            got=moves,
            expected=f"shifts less than {frames} frames apart",
        )

    def moved(values: Tensor, fill: float) -> Tensor:
        placed = values.new_full((len(moves), end - first, *values.shape[2:]), fill)
        for camera, shift in enumerate(moves):
            start, stop = max(first, shift), min(end, shift + frames)
            placed[camera, start - first : stop - first] = values[camera, start - shift : stop - shift]
        return placed

    confidence = observations.confidence
    return replace(
        observations,
        keypoints=moved(observations.keypoints, torch.nan),
        confidence=None if confidence is None else moved(confidence, 0.0),
    ), first
