"""The athlete's joints as the baselines use them: measurements, limbs, triangulation, and the scale from the height."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from torchstickcal.benchmark.baselines.base import Inputs, required
from torchstickcal.geometry.triangulation import triangulate
from torchstickcal.model.measurements import Measurements
from torchstickcal.model.state import State
from torchstickcal.observations import Observations
from torchstickcal.pipeline.scale import Ruler, check_scale, scale_factors

_TRIANGULATION_RADIUS_PX = 40.0

BONES = (
    ("neck", "head"), ("head", "head_top"),
    ("right_shoulder", "right_elbow"), ("right_elbow", "right_wrist"), ("right_wrist", "right_hand"),
    ("left_shoulder", "left_elbow"), ("left_elbow", "left_wrist"), ("left_wrist", "left_hand"),
    ("right_knee", "right_shin"), ("right_shin", "right_ankle"),
    ("left_knee", "left_shin"), ("left_shin", "left_ankle"),
)  # fmt: skip
"""The limbs: bones whose length is the same in all postures, by the names of their two joints."""


def joint_measurements(observations: Observations) -> Measurements:
    """The measurements of the joints, without those of the sticks."""
    ends = {end for stick in observations.sticks for end in stick.ends}
    return Measurements.of(observations, [point for point in range(observations.num_points) if point not in ends])


def bone_indices(observations: Observations) -> list[tuple[int, int]]:
    """Indices of the two points of each limb of :data:`BONES`.

    Raises:
        ObservationError: if a joint is not among the points.
    """
    return [(observations.point_index(start), observations.point_index(end)) for start, end in BONES]


def scaled_by_height(inputs: Inputs, measurements: Measurements, state: State) -> State:
    """The scene scaled so that the mean distance from the top of the head to the middle of the ankles is the height.

    If the stature is given as the height, the scale is some percent too large, because an athlete in motion bends.

    Raises:
        MissingInputError: if the height is not given.
        ObservationError: if these joints are not among the points.
    """
    top, *ankles = (inputs.observations.point_index(name) for name in ("head_top", "left_ankle", "right_ankle"))
    height_m = measurements.lengths_m.new_full((1,), required(inputs, "height_m"))
    ruler = Ruler((top,), tuple(ankles), height_m, rigid=False)
    return scaled_by_rulers(measurements, state, [ruler])


def scaled_by_rulers(measurements: Measurements, state: State, known: Sequence[Ruler]) -> State:
    """The scene of one session scaled to known lengths.

    Raises:
        ObservationError: if there is no frame in which two cameras see each point of a ruler.
    """
    check_scale(measurements, known)
    factors, _ = scale_factors(measurements, state.points, known)
    return state.scaled(factors)


def triangulated(measurements: Measurements, rotations: Tensor, translations: Tensor) -> State:
    """Triangulate the points of all frames.

    Args:
        measurements: of one session.
        rotations: (1, C, 3, 3). translations: (1, C, 3).

    Returns:
        The state; points that fewer than two cameras see are 0.
    """
    rays = measurements.cameras[0].undistort(measurements.pixels[0].movedim(1, -1)).movedim(-1, 1)
    weights = measurements.confidence[0] * rays.isfinite().all(1)
    scale = _TRIANGULATION_RADIUS_PX / float(measurements.cameras.focal_px.mean())
    points = triangulate(rotations[0], translations[0], rays.nan_to_num(), weights, scale=scale)
    return State.of(rotations, translations, points.nan_to_num()[None])
