"""What was triangulated, as a table for people and as JSON for programs."""

from __future__ import annotations

import dataclasses
from typing import Any

from torch import Tensor

from torchstickcal.files import without_nan
from torchstickcal.reconstruction import Reconstruction
from torchstickcal.show.tables import point_name, printable, stick_rows, text_table


def table(found: Reconstruction) -> str:
    """What was triangulated, as a text to print: cameras, points, sticks."""
    rows = [["camera", "reprojection (px)", "keypoints", "time offset (ms)"]]
    for name, px, used, offset in zip(
        found.camera_names, found.reprojection_median_px.tolist(), _used(found), _offsets(found), strict=True
    ):
        rows.append([printable(name), f"{px:.3f}", str(used), offset])
    text = [text_table(rows), ""]
    rows = [["point", "frames", "+- mm"]]
    for name, frames, std in zip(_names(found), _frames(found), found.points_std_m.nanmedian(0).values.tolist(), strict=True):
        rows.append([printable(name), str(frames), f"{1000 * std:.2f}" if std == std else "-"])
    text += [text_table(rows), ""]
    if found.sticks:
        heads = ("stick (not used)", "given (m)", "mean (m)", "spread (mm)", "frames")
        text += [text_table([heads, *stick_rows(found)]), ""]
    text.append(found.world.description)
    text += [f"warning: {warning}" for warning in found.warnings]
    return "\n".join(text)


def summary(found: Reconstruction) -> dict[str, Any]:
    """What was triangulated without its arrays, as JSON can hold it."""
    offsets = zip(found.time_offsets.tolist(), found.time_offsets_std.tolist(), strict=True)
    return without_nan(
        {
            "world": dataclasses.asdict(found.world),
            "cameras": [
                {
                    "name": name,
                    "reprojection_median_px": median,
                    "keypoints": used,
                    "time_offset_s": offset,
                    "time_offset_std_s": std,
                }
                for name, median, used, (offset, std) in zip(
                    found.camera_names, found.reprojection_median_px.tolist(), _used(found), offsets, strict=True
                )
            ],
            "points": [
                {"name": name, "frames": frames, "std_m": std, "sigma_px": sigma}
                for name, frames, std, sigma in zip(
                    _names(found),
                    _frames(found),
                    found.points_std_m.nanmedian(0).values.tolist(),
                    found.sigma_px.tolist(),
                    strict=True,
                )
            ],
            "sticks": [
                {"start": stick.ends[0], "end": stick.ends[1], "length_m": stick.length_m, "mean_m": float(lengths.nanmean())}
                for stick, lengths in zip(found.sticks, found.stick_lengths_m.mT, strict=True)
            ],
            "warnings": list(found.warnings),
        }
    )


def _names(found: Reconstruction) -> list[str]:
    return [point_name(found, number) for number in range(found.points.shape[1])]


def _used(found: Reconstruction) -> list[int]:
    return found.inliers.flatten(1).sum(1).tolist()


def _frames(found: Reconstruction) -> list[int]:
    return found.points.isfinite().all(-1).sum(0).tolist()


def _offsets(found: Reconstruction) -> list[str]:
    def quantity(offset: Tensor, std: Tensor) -> str:
        return f"{1000 * float(offset):.3f}" + (f" ± {1000 * float(std):.2g}" if bool(std > 0) else "")

    return [quantity(*pair) for pair in zip(found.time_offsets, found.time_offsets_std, strict=True)]
