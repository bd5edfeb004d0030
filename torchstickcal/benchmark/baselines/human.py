"""The athlete alone: the project's own calibration on the joints, its scale from a height or from bones."""

from __future__ import annotations

from torchstickcal.benchmark.baselines.base import Estimate, Inputs, required
from torchstickcal.errors import ObservationError
from torchstickcal.pipeline.calibrate import calibrate


def human_height(inputs: Inputs, offset_m: float = 0.0) -> Estimate:
    """Scale from the athlete's stature, as the mean distance from the top of the head to the ankles (the paper's ablation).

    Args:
        inputs: needs ``height_m``.
        offset_m: error of a guessed height.

    Raises:
        MissingInputError: if the height is not given.
    """
    height_m = required(inputs, "height_m") + offset_m
    calibration = calibrate(inputs.observations, {"extends": "human_only", "scale": {"length_m": height_m}})
    return Estimate(calibration.rotations, calibration.translations, calibration.status)


def human_bones(inputs: Inputs) -> Estimate:
    """Scale from true bone lengths L, ``s = sum L l / sum l^2`` over the bones' mean reconstructed lengths l.

    Args:
        inputs: needs ``bone_lengths_m``.

    Raises:
        MissingInputError: if no bone lengths are given.
        ObservationError: if none of the bones is ever seen whole.
    """
    lengths_m = required(inputs, "bone_lengths_m")
    calibration = calibrate(inputs.observations, "human_only")
    measured_by_known, measured_squared = 0.0, 0.0
    for (start, end), known in lengths_m.items():
        first, second = (inputs.observations.point_index(name) for name in (start, end))
        measured = float((calibration.points[:, second] - calibration.points[:, first]).norm(dim=1).nanmean())
        if measured == measured:
            measured_by_known += measured * known
            measured_squared += measured**2
    if not measured_squared:
        raise ObservationError(
            "no bone of known length is ever seen whole",
            where="Inputs.bone_lengths_m",
            got=", ".join(f"{start}-{end}" for start, end in lengths_m) or "no bone",
            expected="a bone whose ends are seen by two cameras in some frame",
        )
    scale = measured_by_known / measured_squared
    return Estimate(calibration.rotations, calibration.translations * scale, calibration.status)
