"""A calibration told to a person, as a table, and to a program, as JSON."""

from __future__ import annotations

from typing import Any

import torch

from torchstickcal.model.unknowns import CLOCKS
from torchstickcal.result import LENS_PARAMETERS, Calibration


def table(calibration: Calibration) -> str:
    """The calibration as a text to print: cameras, sticks, stages."""
    cameras = zip(
        calibration.camera_names,
        calibration.camera_centres.tolist(),
        calibration.camera_std_m.tolist(),
        calibration.camera_std_deg.tolist(),
        calibration.reprojection_median_px.tolist(),
        _keypoints_used(calibration),
        strict=True,
    )
    rows = [["camera", "centre x, y, z (m)", "+- mm", "+- deg", "reprojection (px)", "keypoints"]]
    rows += [
        [name, " ".join(f"{v:8.4f}" for v in centre), f"{1000 * std_m:.2f}", f"{std_deg:.4f}", f"{px:.3f}", str(used)]
        for name, centre, std_m, std_deg, px, used in cameras
    ]
    text = [_aligned(rows), ""]
    rows = [["lens", "focal (px)", "data / given", "found"]]
    for index, name in enumerate(calibration.camera_names):
        focal = float(calibration.intrinsics[index, [0, 1], [0, 1]].mean())
        ratio, std = float(calibration.focal_ratio[index]), float(calibration.focal_ratio_std[index])
        found = ", ".join(kind for kind in calibration.refined if kind not in CLOCKS)
        rows.append([name, f"{focal:.2f}", f"{ratio:.4f} +- {std:.4f}", found or "-"])
    text += [_aligned(rows), ""]
    if calibration.times is not None:
        rows = [["clock", "late (ms)", "data - used (ms)", "found"]]
        for index, name in enumerate(calibration.camera_names):
            offset, late = (_milliseconds(calibration, part, index) for part in ("time_offsets", "late"))
            rows.append([name, offset, late, ", ".join(kind for kind in calibration.refined if kind in CLOCKS) or "-"])
        text += [_aligned(rows), ""]
    if calibration.sticks:
        rows = [["stick", "given (m)", "mean (m)", "spread (mm)", "frames"]]
        for stick, lengths in zip(calibration.sticks, calibration.stick_lengths_m.mT, strict=True):
            known = lengths[lengths.isfinite()]
            spread = f"{1000 * float(known.std()):.2f}" if len(known) > 1 else "-"
            ends = f"{_point_name(calibration, stick.start)} - {_point_name(calibration, stick.end)}"
            mean = f"{float(known.mean()):.5f}" if len(known) else "-"
            rows.append([ends, f"{stick.length_m:.5f}", mean, spread, str(len(known))])
        text += [_aligned(rows), ""]
    rows = [["stage", "iterations", "cost", "time (ms)", ""]]
    rows.append(["initialise", "", "", f"{1000 * calibration.seconds['initialise']:.1f}", ""])
    for stage in calibration.stages:
        last = stage.iterations[-1]
        rows.append([stage.name, str(last.iteration), f"{last.cost:.6g}", f"{1000 * stage.seconds:.1f}", str(stage.stop)])
    rows.append(["total", "", "", f"{1000 * calibration.seconds['total']:.1f}", ""])
    text.append(_aligned(rows))
    text += ["", *(f"warning: {warning}" for warning in calibration.warnings)] if calibration.warnings else []
    return "\n".join(text)


def summary(calibration: Calibration) -> dict[str, Any]:
    """The calibration without its arrays, as JSON can hold it."""
    return {
        "status": calibration.status,
        "converged": calibration.converged,
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
            }
            for name, centre, rotation, translation, std_m, std_deg, median_px, keypoints in zip(
                calibration.camera_names,
                calibration.camera_centres.tolist(),
                calibration.rotations.tolist(),
                calibration.translations.tolist(),
                calibration.camera_std_m.tolist(),
                calibration.camera_std_deg.tolist(),
                calibration.reprojection_median_px.tolist(),
                _keypoints_used(calibration),
                strict=True,
            )
        ],
        "refined": list(calibration.refined),
        "lenses": [
            {
                "name": name,
                "focal_px": [matrix[0][0], matrix[1][1]],
                "principal_point_px": [matrix[0][2], matrix[1][2]],
                "focal_data_over_given": ratio,
                "focal_data_over_given_std": ratio_std,
                "std": dict(zip(LENS_PARAMETERS, lens_std, strict=True)),
            }
            for name, matrix, ratio, ratio_std, lens_std in zip(
                calibration.camera_names,
                calibration.intrinsics.tolist(),
                calibration.focal_ratio.tolist(),
                calibration.focal_ratio_std.tolist(),
                calibration.lens_std.tolist(),
                strict=True,
            )
        ],
        "clocks": [
            {
                "name": name,
                "time_offset_s": offset,
                "time_offset_std_s": offset_std,
                "data_minus_used_s": _finite(late),
                "data_minus_used_std_s": _finite(late_std),
                "readout_s": readout,
                "readout_std_s": readout_std,
            }
            for name, offset, offset_std, late, late_std, readout, readout_std in zip(
                calibration.camera_names,
                calibration.time_offsets.tolist(),
                calibration.time_offsets_std.tolist(),
                calibration.late,
                calibration.late_std,
                calibration.readout.tolist(),
                calibration.readout_std.tolist(),
                strict=True,
            )
        ],
        "points": [
            {"name": _point_name(calibration, index), "sigma_px": sigma}
            for index, sigma in enumerate(calibration.sigma_px.tolist())
        ],
        "scale_std": _finite(calibration.scale_std),
        "sticks": [
            {
                "start": stick.start,
                "end": stick.end,
                "length_m": stick.length_m,
                "mean_m": _finite(lengths.nanmean()),
                "spread_m": _finite(lengths[lengths.isfinite()].std(correction=0)),
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


def _milliseconds(calibration: Calibration, part: str, camera: int) -> str:
    value, std = (1000 * float(getattr(calibration, name)[camera]) for name in (part, f"{part}_std"))
    return f"{value:.2f} +- {std:.2f}"


def _keypoints_used(calibration: Calibration) -> list[int]:
    return calibration.inliers.flatten(1).sum(1).tolist()


def _point_name(calibration: Calibration, index: int) -> str:
    return calibration.point_names[index] if calibration.point_names else f"point {index}"


def _finite(value: torch.Tensor) -> float | None:
    """JSON has no NaN."""
    return float(value) if bool(value.isfinite()) else None


def _aligned(rows: list[list[str]]) -> str:
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    lines = [
        "  ".join(cell.ljust(w) if column == 0 or (not cell[:1].isdigit() and cell[:1] not in "- ") else cell.rjust(w)
                  for column, (cell, w) in enumerate(zip(row, widths, strict=True))).rstrip()
        for row in rows
    ]  # fmt: skip
    return "\n".join([lines[0], "-" * max(map(len, lines)), *lines[1:]])
