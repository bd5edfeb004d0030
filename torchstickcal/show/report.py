"""A calibration as a table for people, and as JSON for programs."""

from __future__ import annotations

import dataclasses
from typing import Any

from torch import Tensor

from torchstickcal.files import without_nan
from torchstickcal.model.unknowns import all_unknowns
from torchstickcal.result import Calibration, CameraParameter


def table(calibration: Calibration) -> str:
    """The calibration as a text to print: cameras, sticks, stages."""
    cameras = zip(
        map(printable, calibration.camera_names),
        calibration.camera_centres.tolist(),
        calibration.camera_std_m.tolist(),
        calibration.camera_std_deg.tolist(),
        calibration.reprojection_median_px.tolist(),
        _keypoints_used(calibration),
        strict=True,
    )
    rows = [["camera", "centre x, y, z (m)", "+- mm", "+- deg", "reprojection (px)", "keypoints"]]
    rows += [
        [
            name,
            " ".join(f"{v:8.4f}" for v in centre),
            f"{1000 * std_m:.2f}",
            f"{std_deg:.4f}",
            f"{px:.3f}",
            str(used),
        ]
        for name, centre, std_m, std_deg, px, used in cameras
    ]
    text = [aligned(rows), _frame(calibration), ""]
    for name, parameter in calibration.unknowns.items():
        known = bool(parameter.by_component("suggested").isfinite().any())
        if known and (parameter.refined or all_unknowns()[name].noticeable_prior_share is not None):
            text += [aligned(_parameter_rows(calibration, parameter)), ""]
    if calibration.sticks:
        rows = [["stick", "given (m)", "mean (m)", "spread (mm)", "frames"]]
        for stick, lengths in zip(calibration.sticks, calibration.stick_lengths_m.mT, strict=True):
            known = lengths[lengths.isfinite()]
            spread = f"{1000 * float(known.std()):.2f}" if len(known) > 1 else "-"
            ends = " - ".join(printable(_point_name(calibration, end)) for end in stick.ends)
            mean = f"{float(known.mean()):.5f}" if len(known) else "-"
            rows.append([ends, f"{stick.length_m:.5f}", mean, spread, str(len(known))])
        text += [aligned(rows), ""]
    rows = [["stage", "iterations", "cost", "time (ms)", ""]]
    rows.append(["initialise", "", "", f"{1000 * calibration.seconds['initialise']:.1f}", ""])
    for stage in calibration.stages:
        last = stage.iterations[-1]
        rows.append([stage.name, str(last.iteration), f"{last.cost:.6g}", f"{1000 * stage.seconds:.1f}", str(stage.stop)])
    rows.append(["total", "", "", f"{1000 * calibration.seconds['total']:.1f}", ""])
    text.append(aligned(rows))
    text += ["", *(f"warning: {warning}" for warning in calibration.warnings)] if calibration.warnings else []
    return "\n".join(text)


def summary(calibration: Calibration) -> dict[str, Any]:
    """The calibration without its arrays, as JSON can hold it: None where a number is not known."""
    return without_nan(
        {
            "status": calibration.status,
            "converged": calibration.converged,
            "world": dataclasses.asdict(calibration.world),
            "cameras": [
                {
                    "name": name,
                    "centre_m": centre,
                    "rotation": rotation,
                    "translation_m": translation,
                    "centre_std_m": std_m,
                    "rotation_std_deg": std_deg,
                    "reprojection_median_px": median_px,
                    "keypoints": keypoints,
                    "frames_relabelled": relabelled,
                    "frames_of_another_person": other,
                }
                for name, centre, rotation, translation, std_m, std_deg, median_px, keypoints, relabelled, other in zip(
                    calibration.camera_names,
                    calibration.camera_centres.tolist(),
                    calibration.rotations.tolist(),
                    calibration.translations.tolist(),
                    calibration.camera_std_m.tolist(),
                    calibration.camera_std_deg.tolist(),
                    calibration.reprojection_median_px.tolist(),
                    _keypoints_used(calibration),
                    calibration.relabelled.any(-1).sum(-1).tolist(),
                    calibration.other_person.sum(-1).tolist(),
                    strict=True,
                )
            ],
            "refined": list(calibration.refined),
            "unknowns": {name: _parameter_summary(calibration, parameter) for name, parameter in calibration.unknowns.items()},
            "points": [
                {"name": _point_name(calibration, index), "sigma_px": sigma}
                for index, sigma in enumerate(calibration.sigma_px.tolist())
            ],
            "scale_std": float(calibration.scale_std),
            "sticks": [
                {
                    "start": stick.ends[0],
                    "end": stick.ends[1],
                    "length_m": stick.length_m,
                    "mean_m": float(lengths.nanmean()),
                    "spread_m": float(lengths[lengths.isfinite()].std(correction=0)),
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


def _frame(calibration: Calibration) -> str:
    """The frame of the world, and how well it is known, in one line."""
    world = calibration.world
    known = ""
    if world.vertical_std_deg is not None and world.floor_std_m is not None:
        known = f" Vertical ± {world.vertical_std_deg:.1f} deg, floor ± {1000 * world.floor_std_m:.0f} mm."
    return world.description + known


def printable(text: str) -> str:
    r"""A text for one place in a table: line ends and other characters that have no shape of their own are escaped.

    Example:
        >>> print(printable("left\ncamera"))
        left\ncamera
    """
    return "".join(letter if letter.isprintable() else letter.encode("unicode_escape").decode() for letter in text)


def _parameter_rows(calibration: Calibration, parameter: CameraParameter) -> list[list[str]]:
    """A table of one unknown of the cameras: what was given, what was used, and what the keypoints suggest."""
    factor, unit = (1000, "ms") if parameter.unit == "s" else (1, parameter.unit)
    components = parameter.components
    in_unit = f" ({unit})" if unit else ""
    heads = "estimated" if parameter.refined else "as given", "suggested"
    rows = [[parameter.label, *(f"{component}{in_unit}: {head}" for component in components for head in heads)]]

    def quantity(values: Tensor, stds: Tensor) -> str:
        value, std = factor * float(values), factor * float(stds)
        return f"{value:.5g}" if std != std else f"{value:.5g} ± {std:.2g}"

    for camera, label in enumerate(calibration.camera_names):
        cells = [
            quantity(parameter.by_component(value)[camera, number], parameter.by_component(std)[camera, number])
            for number in range(len(components))
            for value, std in (("value", "std"), ("suggested", "suggested_std"))
        ]
        rows.append([printable(label), *cells])
    return rows


def _parameter_summary(calibration: Calibration, parameter: CameraParameter) -> dict[str, Any]:
    """One unknown of the cameras as JSON can hold it."""
    tensors = ("value", "std", "given", "suggested", "suggested_std")
    return {
        "label": parameter.label,
        "unit": parameter.unit,
        "refined": parameter.refined,
        "cameras": [
            {"name": name}
            | {
                tensor: dict(zip(parameter.components, parameter.by_component(tensor)[camera].tolist(), strict=True))
                for tensor in tensors
            }
            for camera, name in enumerate(calibration.camera_names)
        ],
    }


def _keypoints_used(calibration: Calibration) -> list[int]:
    return calibration.inliers.flatten(1).sum(1).tolist()


def _point_name(calibration: Calibration, index: int) -> str:
    return calibration.point_names[index] if calibration.point_names else f"point {index}"


def aligned(rows: list[list[str]]) -> str:
    """Rows of cells as a table, the first row as its head."""
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    lines = [
        "  ".join(cell.ljust(w) if column == 0 or (not cell[:1].isdigit() and cell[:1] not in "- ") else cell.rjust(w)
                  for column, (cell, w) in enumerate(zip(row, widths, strict=True))).rstrip()
        for row in rows
    ]  # fmt: skip
    return "\n".join([lines[0], "-" * max(map(len, lines)), *lines[1:]])
