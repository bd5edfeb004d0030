"""The athlete alone: the library's calibration from the joints, with the scale from a height or from bone lengths."""

from __future__ import annotations

from torchstickcal.benchmark.baselines.base import Estimate, Inputs, Listing, PublishedErrors, baseline, required
from torchstickcal.benchmark.baselines.reasons import CONVERGED, HEIGHT
from torchstickcal.errors import ObservationError
from torchstickcal.pipeline.calibrate import calibrate

_GUESSED_ERRORS = PublishedErrors(0.252, 0.043, 0.102, 0.022)
_GUESSED = (
    "A height error of 0.1 m of 1.76 m is a scale error of 5.7 %, which is 193 mm on these rigs for every method. The "
    "difference between the stature and the mean height during the motion reduces it to 108 mm for the lower guess and "
    "increases it to 287 mm for the higher one."
)


@baseline(
    "human_height",
    Listing("Human, true stature", {"inputs": PublishedErrors(0.217, 0.031, 0.089, 0.014)}, (HEIGHT, CONVERGED), position=10),
    needs=("height_m",),
    title_in_motion="Human, true mean height in motion",
)
def human_height(inputs: Inputs, offset_m: float = 0.0) -> Estimate:
    """Scale from the athlete's height, as the mean distance from the top of the head to the ankles (the paper's ablation).

    Args:
        inputs: needs ``height_m``.
        offset_m: error of the height, metres.
    """
    height_m = required(inputs, "height_m") + offset_m
    return Estimate.of_calibration(calibrate(inputs.observations, {"extends": "human_only", "scale": {"length_m": height_m}}))


def _guessed(title: str, position: int) -> Listing:
    """Both guesses share a row of the input variants."""
    row = "Human, stature - 0.1 m and + 0.1 m"
    return Listing(title, {"inputs": _GUESSED_ERRORS}, (_GUESSED, CONVERGED), position, row)


@baseline("human_guessed_low", _guessed("Human, stature - 0.1 m", position=11), needs=("height_m",))
def human_guessed_low(inputs: Inputs) -> Estimate:
    """Scale from a height that is 0.1 m too low."""
    return human_height(inputs, -0.1)


@baseline("human_guessed_high", _guessed("Human, stature + 0.1 m", position=12), needs=("height_m",))
def human_guessed_high(inputs: Inputs) -> Estimate:
    """Scale from a height that is 0.1 m too high."""
    return human_height(inputs, 0.1)


@baseline(
    "human_bones",
    Listing("Human, true bone lengths", {"inputs": None}, position=14),
    needs=("bone_lengths_m",),
)
def human_bones(inputs: Inputs) -> Estimate:
    """Scale from true bone lengths.

    It is ``s = sum L l / sum l^2`` with true lengths L and mean reconstructed lengths l of the bones.

    Args:
        inputs: needs ``bone_lengths_m``.

    Raises:
        ObservationError: if no bone is completely visible in any frame.
    """
    calibration = calibrate(inputs.observations, "human_only")
    lengths_m = required(inputs, "bone_lengths_m")
    measured_by_known, measured_squared = 0.0, 0.0
    for (start, end), known in lengths_m.items():
        first, second = (inputs.observations.point_index(name) for name in (start, end))
        measured = float((calibration.points[:, second] - calibration.points[:, first]).norm(dim=1).nanmean())
        if measured == measured:
            measured_by_known += measured * known
            measured_squared += measured**2
    if not measured_squared:
        raise ObservationError(
            "no bone of known length is completely visible in any frame",
            where="Inputs.bone_lengths_m",
            got=", ".join(f"{start}-{end}" for start, end in lengths_m) or "no bone",
            expected="a bone of which two cameras see both ends in the same frame",
        )
    return Estimate.of_calibration(calibration, scale=measured_by_known / measured_squared)
