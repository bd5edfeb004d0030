"""What a comparison method is given and what it gives back."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from torchstickcal.errors import CalibrationError
from torchstickcal.model.measurements import Measurements
from torchstickcal.model.state import State
from torchstickcal.observations import Observations
from torchstickcal.pipeline.initialise.triangulate import triangulate
from torchstickcal.pipeline.scale import Ruler, scale_factors
from torchstickcal.simulate import CubeViews

Array = NDArray[np.float64]

_TRIANGULATION_RADIUS_PX = 40.0

BONES = (
    ("neck", "head"), ("head", "head_top"),
    ("right_shoulder", "right_elbow"), ("right_elbow", "right_wrist"), ("right_wrist", "right_hand"),
    ("left_shoulder", "left_elbow"), ("left_elbow", "left_wrist"), ("left_wrist", "left_hand"),
    ("right_knee", "right_shin"), ("right_shin", "right_ankle"),
    ("left_knee", "left_shin"), ("left_shin", "left_ankle"),
)  # fmt: skip
"""The limbs, by the names of their joints: those whose length does not change with posture."""


class MissingInputError(CalibrationError):
    """A method lacks an input that it cannot do without."""


@dataclass(frozen=True)
class Inputs:
    """Everything that some method may use; each takes what it needs."""

    observations: Observations
    height_m: float | None = None
    """the athlete's stature, from the top of the head to the ankles"""
    bone_lengths_m: Mapping[tuple[str, str], float] | None = None
    """lengths of bones by the names of their ends"""
    cube: CubeViews | None = None
    orientations: Array | None = None
    """(C, F, B, 3), unit directions of the limbs ``BONES`` in each camera's frame, NaN where not known"""


@dataclass(frozen=True)
class Estimate:
    """Poses of all cameras, world to camera, metres; the first camera is the world."""

    rotations: Tensor
    """(C, 3, 3)"""
    translations: Tensor
    """(C, 3)"""
    status: str
    """``converged``, or one sentence why not"""

    @staticmethod
    def of(state: State, status: str) -> Estimate:
        """The cameras of one session's state."""
        return Estimate(state.rotations[0], state.translations[0], status)


Baseline = Callable[[Inputs], Estimate]


def required(inputs: Inputs, name: str) -> Any:
    """An input by its name.

    Raises:
        MissingInputError: if it was not given.
    """
    value = getattr(inputs, name)
    if value is None:
        raise MissingInputError("the method lacks an input", where=f"Inputs.{name}", got="None", expected=name)
    return value


def joint_measurements(observations: Observations) -> Measurements:
    """The joints' measurements, without the sticks."""
    ends = {end for stick in observations.sticks for end in stick.ends}
    return Measurements.of(observations, [point for point in range(observations.num_points) if point not in ends])


def bone_indices(observations: Observations) -> list[tuple[int, int]]:
    """The points' indices of the limbs ``BONES``.

    Raises:
        ObservationError: if the session has no such joint.
    """
    return [(observations.point_index(start), observations.point_index(end)) for start, end in BONES]


def scaled_by_height(inputs: Inputs, measurements: Measurements, state: State) -> State:
    """The scene brought to scale by the athlete's height, as the paper does with the stick: by its mean over the session.

    The mean distance from the top of the head to the middle of the ankles is set to the stature. An athlete in motion is
    shorter than that by some percent, which is the weakness of this ruler.

    Raises:
        MissingInputError: if the height is not given.
    """
    top, *ankles = (inputs.observations.point_index(name) for name in ("head_top", "left_ankle", "right_ankle"))
    height_m = measurements.lengths_m.new_full((1,), required(inputs, "height_m"))
    ruler = Ruler((top,), tuple(ankles), height_m, rigid=False)
    return state.scaled(scale_factors(measurements, state.points, [ruler]))


def triangulated(measurements: Measurements, rotations: Tensor, translations: Tensor) -> State:
    """The points of all frames at poses (1, C, 3, 3), (1, C, 3), zero where fewer than two cameras see them."""
    rays = measurements.cameras[0].undistort(measurements.pixels[0].movedim(1, -1)).movedim(-1, 1)
    weights = measurements.confidence[0] * rays.isfinite().all(1)
    scale = _TRIANGULATION_RADIUS_PX / float(measurements.cameras.focal_px.mean())
    points = triangulate(rotations[0], translations[0], rays.nan_to_num(), weights, scale=scale)
    return State.of(rotations, translations, points.nan_to_num()[None])
