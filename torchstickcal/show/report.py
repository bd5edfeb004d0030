"""A calibration as a table for people, and as JSON for programs."""

from __future__ import annotations

import dataclasses
from typing import Any

from torchstickcal.files import without_nan
from torchstickcal.quality.finding import Severity
from torchstickcal.result import Calibration, CameraParameter
from torchstickcal.show.look import wrapped
from torchstickcal.show.tables import (
    camera_facts,
    camera_table,
    length_spread_m,
    point_name,
    point_table,
    stage_table,
    stick_table,
    unknown_tables,
)


def table(calibration: Calibration, verbose: bool = True) -> str:
    """The calibration as a text to print: cameras, what was estimated of them, and the findings.

    Args:
        calibration: what was found.
        verbose: whether also what was only checked of the cameras, sticks, points and stages are shown.
    """
    tables = [camera_table(camera_facts(calibration)), *unknown_tables(calibration, only_refined=not verbose)]
    if verbose:
        tables += [stick for stick in (stick_table(calibration),) if stick is not None]
        tables += [point_table(calibration), stage_table(calibration)]
    text = [f"{one.title}\n{one.text()}" if number else one.text() for number, one in enumerate(tables)]
    text.insert(1, "\n".join(wrapped(frame_sentence(calibration))))
    if verbose:
        notes = [finding for finding in calibration.quality.findings if finding.severity == Severity.NOTE]
        text += ["\n".join(line for finding in notes for line in wrapped(f"note: {finding.text}"))] if notes else []
    return "\n\n".join(text)


def frame_sentence(calibration: Calibration) -> str:
    """The frame of the world, and how well it is known."""
    world, known = calibration.world, ""
    if world.vertical_std_deg is not None and world.floor_std_m is not None:
        known = f" Vertical ± {world.vertical_std_deg:.1f} deg, floor ± {1000 * world.floor_std_m:.0f} mm."
    return world.description + known


def summary(calibration: Calibration) -> dict[str, Any]:
    """The calibration without its arrays, as JSON can hold it: None where a number is not known."""
    return without_nan(
        {
            "quality": calibration.quality.as_json(),
            "status": calibration.status,
            "converged": calibration.converged,
            "world": dataclasses.asdict(calibration.world),
            "cameras": [
                {
                    "name": facts.name,
                    "centre_m": facts.centre_m,
                    "rotation": rotation,
                    "translation_m": translation,
                    "centre_std_m": facts.std_m,
                    "rotation_std_deg": facts.std_deg,
                    "reprojection_median_px": facts.median_px,
                    "keypoints": facts.used,
                    "frames_relabelled": relabelled,
                    "frames_of_another_person": other,
                }
                for facts, rotation, translation, relabelled, other in zip(
                    camera_facts(calibration),
                    calibration.rotations.tolist(),
                    calibration.translations.tolist(),
                    calibration.relabelled.any(-1).sum(-1).tolist(),
                    calibration.other_person.sum(-1).tolist(),
                    strict=True,
                )
            ],
            "refined": list(calibration.refined),
            "unknowns": {name: _parameter_summary(calibration, parameter) for name, parameter in calibration.unknowns.items()},
            "points": [
                {"name": point_name(calibration, index), "sigma_px": sigma}
                for index, sigma in enumerate(calibration.sigma_px.tolist())
            ],
            "scale_std": float(calibration.scale_std),
            "sticks": [
                {
                    "start": stick.ends[0],
                    "end": stick.ends[1],
                    "length_m": stick.length_m,
                    "mean_m": float(lengths.nanmean()),
                    "spread_m": length_spread_m(lengths),
                    "frames": int(lengths.isfinite().sum()),
                }
                for stick, lengths in zip(calibration.sticks, calibration.stick_lengths_m.mT, strict=True)
            ],
            "stages": [
                {
                    "name": stage.name,
                    "stop": stage.stop.value,
                    "converged": stage.stop.converged,
                    "iterations": stage.iterations[-1].iteration,
                    "cost": stage.iterations[-1].cost,
                    "seconds": stage.seconds,
                }
                for stage in calibration.stages
            ],
            "seconds": calibration.seconds,
            "warnings": list(calibration.warnings),
        }
    )


def _parameter_summary(calibration: Calibration, parameter: CameraParameter) -> dict[str, Any]:
    """One unknown of the cameras as JSON can hold it."""
    names = ("value", "std", "given", "suggested", "suggested_std")
    tensors = {name: parameter.by_component(name).tolist() for name in names}
    return {
        "label": parameter.label,
        "unit": parameter.unit,
        "refined": parameter.refined,
        "cameras": [
            {"name": name}
            | {tensor: dict(zip(parameter.components, rows[camera], strict=True)) for tensor, rows in tensors.items()}
            for camera, name in enumerate(calibration.camera_names)
        ],
    }
