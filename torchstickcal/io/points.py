"""Points in space, written for other programs: TRC for OpenSim, C3D, a table, and arrays."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path
from typing import Any

import numpy as np

from torchstickcal.archives import save_arrays
from torchstickcal.errors import CalibrationError
from torchstickcal.files import atomic_path, check_text
from torchstickcal.io.about import about, comments
from torchstickcal.io.formats import point_writer
from torchstickcal.io.motion import Motion
from torchstickcal.io.rig import METRES

_PER_METRE = 1 / METRES["mm"]
_UNKNOWN_RESIDUAL = -1.0
"""What C3D writes for a point that is not known."""


@point_writer("trc", "points as OpenSim reads them, y up, in millimetres (.trc)", file_name="points.trc", needs_rate=True)
def write_trc(path: Path, motion: Motion) -> None:
    """Write the points with y up. Cells are empty where a point is not known; a point that never is has no columns.

    Time begins at 0.
    """
    motion = motion.evenly("TRC").with_y_up().known()
    names = [_word(name) for name in motion.names]
    frames, points = motion.points.shape[:2]
    rate = f"{motion.rate_hz:.10g}"
    lines = [
        ["PathFileType", "4", "(X/Y/Z)", path.name],
        ["DataRate", "CameraRate", "NumFrames", "NumMarkers", "Units", "OrigDataRate", "OrigDataStartFrame", "OrigNumFrames"],
        [rate, rate, str(frames), str(points), "mm", rate, "1", str(frames)],
        ["Frame#", "Time", *(cell for name in names for cell in (name, "", ""))],
        ["", "", *(f"{axis}{number}" for number in range(1, points + 1) for axis in "XYZ")],
    ]
    assert motion.rate_hz is not None
    for frame, row in enumerate((_PER_METRE * motion.points).reshape(frames, -1)):
        cells = ("" if np.isnan(value) else f"{value:.4f}" for value in row.tolist())
        lines.append([str(frame + 1), f"{frame / motion.rate_hz:.6f}", *cells])
    with atomic_path(path) as temporary:
        temporary.write_text("".join("\t".join(line) + "\n" for line in lines), "utf-8")


@point_writer("c3d", "points as C3D, in millimetres; needs ezc3d (.c3d)", file_name="points.c3d", needs_rate=True)
def write_c3d(path: Path, motion: Motion) -> None:
    """Write the points in the axes of the calibration, with their standard deviations as residuals."""
    try:
        import ezc3d
    except ImportError as error:
        raise CalibrationError(
            "C3D files need the package ezc3d",
            where="c3d",
            got="no such package",
            expected="ezc3d",
            remedy="Install it: pip install ezc3d",
        ) from error
    motion = motion.evenly("C3D")
    frames, points = motion.points.shape[:2]
    known = np.asarray(np.isfinite(motion.points).all(-1))
    data = np.ones((4, points, frames))
    data[:3] = np.moveaxis(np.where(known[..., None], _PER_METRE * motion.points, 0.0), -1, 0).swapaxes(1, 2)
    std = np.zeros_like(known, dtype=np.float64) if motion.std_m is None else np.nan_to_num(motion.std_m)
    file = ezc3d.c3d()
    file["parameters"]["POINT"]["UNITS"]["value"] = ["mm"]
    file["parameters"]["POINT"]["RATE"]["value"] = [motion.rate_hz]
    file["parameters"]["POINT"]["LABELS"]["value"] = list(motion.names)
    y_down = motion.world is not None and motion.world.name == "camera"
    file.add_parameter("POINT", "X_SCREEN", ["+X"])
    file.add_parameter("POINT", "Y_SCREEN", ["-Y" if y_down else "+Z"])
    for key, text in about("millimetres", motion.world).items():
        file.add_parameter("TORCHSTICKCAL", key.upper(), [text])
    if motion.events:
        _add_events(file, motion)
    file["data"]["points"] = data
    file["data"]["meta_points"]["residuals"] = np.where(known, _PER_METRE * std, _UNKNOWN_RESIDUAL).T[None]
    with atomic_path(path) as temporary:
        file.write(str(temporary))


def _add_events(file: Any, motion: Motion) -> None:
    """The group EVENT: times are minutes and seconds since the first frame."""
    first_s = 0.0 if motion.times is None or not len(motion.times) else float(motion.times[0])
    seconds = np.array([time for _, time in motion.events]) - first_s
    minutes = np.floor(seconds / 60)
    file.add_parameter("EVENT", "USED", [len(seconds)])
    file.add_parameter("EVENT", "CONTEXTS", ["General"] * len(seconds))
    file.add_parameter("EVENT", "LABELS", [label for label, _ in motion.events])
    file.add_parameter("EVENT", "TIMES", np.stack([minutes, seconds - 60 * minutes]))


@point_writer("csv", "points as a table, in metres (.csv)", file_name="points.csv")
def write_csv(path: Path, motion: Motion) -> None:
    """Write a row for each point that is known, after lines of comments that begin with ``#``."""
    text = io.StringIO()
    text.write(comments(about("metres", motion.world)))
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(["frame", "time_s", "point", "x_m", "y_m", "z_m", "std_m"])
    known = np.isfinite(motion.points).all(-1)
    for frame, point in np.argwhere(known).tolist():
        time = "" if motion.times is None else repr(float(motion.times[frame]))
        std = "" if motion.std_m is None or np.isnan(motion.std_m[frame, point]) else repr(float(motion.std_m[frame, point]))
        place = map(repr, motion.points[frame, point].tolist())
        rows.writerow([frame, time, motion.names[point], *place, std])
    for name in motion.names:
        check_text(name, "point_names")
    with atomic_path(path) as temporary:
        temporary.write_text(text.getvalue(), "utf-8")


@point_writer("npz", "points as arrays of NumPy, in metres (.npz)", file_name="points_m.npz")
def write_point_arrays(path: Path, motion: Motion) -> None:
    """Write ``points_m`` (G, P, 3), ``std_m`` (G, P), ``times_s`` (G,), ``names`` (P,) and ``about``, a text in JSON."""
    arrays = {
        "points_m": motion.points,
        "names": np.array(motion.names),
        "about": np.array(json.dumps(about("metres", motion.world))),
    }
    if motion.std_m is not None:
        arrays["std_m"] = motion.std_m
    if motion.times is not None:
        arrays["times_s"] = motion.times
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        save_arrays(file, arrays)


def _word(name: str) -> str:
    """A name of a point as one word, as formats that are separated by tabs and spaces need it."""
    check_text(name, "point_names")
    return "_".join(name.split()) or "point"
