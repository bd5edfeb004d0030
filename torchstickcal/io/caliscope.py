"""Caliscope: a table of the points that all cameras saw (.csv), and an array of cameras (.toml)."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from torchstickcal.files import toml_string
from torchstickcal.io.about import about
from torchstickcal.io.camera_toml import camera_table, write_tables
from torchstickcal.io.formats import calibration_reader, camera_writer, keypoint_reader, reading
from torchstickcal.io.recording import Detection, Recording, View, last_number
from torchstickcal.io.rig import Rig, RigCamera
from torchstickcal.untrusted import read_rows, read_toml

_POINTS = "Caliscope: points seen by all cameras (.csv)"
_CAMERAS = "cameras of Caliscope, in metres (.toml)"
_MOST_POINTS = 200
"""Numbers of points from here on are names of their own, not places in a skeleton."""


@keypoint_reader(
    "caliscope",
    _POINTS,
    recognises=lambda path, head: b"sync_index" in head.partition(b"\n")[0] and b"img_loc_x" in head.partition(b"\n")[0],
)
def read_caliscope_points(path: Path) -> Recording:
    """Read the points by camera and ``sync_index``. The frame rate is that of ``frame_time``."""
    header, *rows = read_rows(path)
    column = {name.strip(): place for place, name in enumerate(header)}
    camera, point = ("cam_id", "keypoint_id") if "cam_id" in column else ("port", "point_id")

    def numbers(name: str, default: float = 0.0) -> Any:
        if name not in column:
            return np.full(len(rows), default)
        return np.array([row[column[name]] or "nan" for row in rows], dtype=np.float64)

    frames, cameras = (np.array([int(float(row[column[name]])) for row in rows]) for name in ("sync_index", camera))
    points = np.stack([numbers("object_id"), np.array([int(float(row[column[point]])) for row in rows])], axis=1)
    places = np.stack([numbers("img_loc_x", np.nan), numbers("img_loc_y", np.nan)], axis=1)
    known, index = _numbered(points)
    views = []
    for number in np.unique(cameras).tolist():
        own = np.flatnonzero(cameras == number)
        instants, at = np.unique(frames[own], return_inverse=True)
        keypoints = np.full((len(instants), len(known), 2), np.nan)
        keypoints[at, index[own]] = places[own]
        found = [Detection(int(frame), one) for frame, one in zip(instants, keypoints, strict=True)]
        views.append(View.of(f"cam_{number}", found, known))
    return Recording.of(views, fps=_rate(frames, numbers("frame_time", np.nan)))


@calibration_reader("caliscope", _CAMERAS, recognises=lambda path, head: re.search(rb"(?m)^\[cameras\.\w+\]", head) is not None)
def read_caliscope_cameras(path: str | Path) -> Rig:
    """Read the cameras of a ``camera_array.toml``. Where one has no pose, only the intrinsics are known."""
    with reading(path, _CAMERAS):
        return Rig.of([_camera(key, table) for key, table in read_toml(path)["cameras"].items()])


@camera_writer("caliscope", "cameras of Caliscope, in metres (.toml)", file_name="camera_array.toml")
def write_caliscope(path: Path, rig: Rig) -> None:
    """Write the cameras. Their numbers are those in their names, if each has one of its own; else they are counted."""
    numbers = [last_number(name) for name in rig.names]
    if None in numbers or len(set(numbers)) != len(numbers):
        numbers = list(range(len(rig.names)))
    tables = []
    for camera, number in enumerate(numbers):
        table = camera_table(rig, camera)
        table |= {"cam_id": number, "size": list(map(round, rig.size(camera))), "rotation_count": 0}
        table |= {"distortions": rig.coefficients(camera, 5, 5, "Caliscope"), "fisheye": str(rig.fisheye[camera]).lower()}
        tables.append((f"cameras.{number}", table))
    metadata = {key: toml_string(text) for key, text in about("metres", rig.world).items()}
    write_tables(path, tables, metadata)


def _camera(key: str, table: dict[str, Any]) -> RigCamera:
    return RigCamera(
        name=str(table.get("name", f"cam_{table.get('cam_id', table.get('port', key))}")),
        matrix=table["matrix"],
        distortion=table["distortions"],
        fisheye=bool(table.get("fisheye", False)),
        image_size=table.get("size"),
        rotation=table.get("rotation"),
        translation=table.get("translation"),
    )


def _numbered(points: Any) -> tuple[list[str], Any]:
    """The names of points, given as object and number (n, 2), and for each row which of them it is."""
    distinct, index = np.unique(points, axis=0, return_inverse=True)
    if len(np.unique(distinct[:, 0])) > 1:
        return [f"object {int(thing)} point {int(number)}" for thing, number in distinct], index.reshape(-1)
    numbers = distinct[:, 1].astype(int)
    if numbers.min() >= 0 and numbers.max() < _MOST_POINTS:  # a skeleton of which some points were never seen
        return [f"point {number}" for number in range(numbers.max() + 1)], points[:, 1].astype(int)
    return [f"point {number}" for number in numbers], index.reshape(-1)


def _rate(frames: Any, times: Any) -> float | None:
    """Frames per second, of the times of frames; None if they are not known."""
    known = np.isfinite(times)
    if not known.any():
        return None
    numbers, first = np.unique(frames[known], return_index=True)
    steps, frames_between = np.diff(times[known][first]), np.diff(numbers)
    rates = frames_between[steps > 0] / steps[steps > 0]
    return float(np.median(rates)) if len(rates) else None
