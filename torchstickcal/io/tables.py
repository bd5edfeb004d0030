"""Plain tables of points (.csv): a row for each point, also as `detect` writes them; DLTdv's and Argus's columns."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from torchstickcal.io.formats import keypoint_reader
from torchstickcal.io.recording import Recording, View
from torchstickcal.untrusted import read_json, read_rows

_LONG = ("camera", "frame", "point", "x", "y")
_SCORES = ("score", "confidence", "likelihood")
_DETECTED = ("keypoints.csv", "videos.json")
_SAME_RATE = 1e-3
"""Differences of frame rates, as a share, that come from the rounding of times."""
_WIDE = re.compile(r"(?P<point>.+?)[_ ]cam[_ ]?(?P<camera>\w+?)[_ ](?P<axis>[xy])", re.IGNORECASE)


def _header(head: bytes) -> list[str]:
    first = head.decode("utf-8-sig", "replace").partition("\n")[0]
    return [cell.strip().strip('"') for cell in re.split(r"[,;\t]", first)]


@keypoint_reader(
    "csv",
    "a table (.csv) with the columns camera, frame, point, x, y, and score if there is one",
    recognises=lambda path, head: {name.lower() for name in _header(head)} >= set(_LONG),
)
def read_table(path: Path) -> Recording:
    """Read a table with a row for each point that was seen, in pixels. Points that have no row were not seen."""
    header, *rows = read_rows(path)
    column = {name.strip().lower(): place for place, name in enumerate(header)}
    score = next((column[name] for name in _SCORES if name in column), None)
    points = list(dict.fromkeys(row[column["point"]] for row in rows))
    places = {point: place for place, point in enumerate(points)}
    frames = [int(row[column["frame"]]) for row in rows]
    views = []
    for camera in dict.fromkeys(row[column["camera"]] for row in rows):
        own = [number for number, row in enumerate(rows) if row[column["camera"]] == camera]
        numbers = sorted({frames[number] for number in own})
        at = {frame: place for place, frame in enumerate(numbers)}
        track = np.full((1, len(numbers), len(points), 3), [np.nan, np.nan, 0.0])
        for number in own:
            row = rows[number]
            place = 0, at[frames[number]], places[row[column["point"]]]
            if not np.isnan(track[place][0]):
                raise ValueError(f"camera {camera}, frame {frames[number]}: two rows of point {row[column['point']]!r}")
            track[place] = [_number(row[column["x"]]), _number(row[column["y"]]), 1.0 if score is None else _number(row[score])]
        views.append(View.of_tracks(camera, track, points, frames=numbers))
    return Recording.of(views)


@keypoint_reader(
    "detected",
    "a folder that `torchstickcal detect` wrote (keypoints.csv, videos.json)",
    recognises=lambda path, head: all((path / name).is_file() for name in _DETECTED),
)
def read_detected(path: Path) -> Recording:
    """Read the table of a folder, with image sizes and frame rate of the videos."""
    table, about = path / _DETECTED[0], read_json(path / _DETECTED[1])
    recording = read_table(table)
    views = []
    for view in recording.views:
        width, height = about[view.name]["image_size"]
        views.append(replace(view, image_size=(float(width), float(height))))
    rates = [float(about[view.name]["fps"]) for view in views]
    alike = max(rates) - min(rates) <= _SAME_RATE * max(rates)
    note = f"The videos have different frame rates: {', '.join(f'{rate:g}' for rate in rates)} Hz."
    return replace(
        recording, views=tuple(views), fps=float(np.median(rates)) if alike else None, notes=() if alike else (note,)
    )


@keypoint_reader(
    "dltdv",
    "DLTdv or Argus: a table (.csv) with the columns pt1_cam1_X, pt1_cam1_Y, ...",
    recognises=lambda path, head: len(names := _header(head)) > 3 and all(_WIDE.fullmatch(name) for name in names),
)
def read_dltdv(path: Path) -> Recording:
    """Read a table with a row for each frame, in pixels with y downward, as DLTdv8 writes them."""
    header, *rows = read_rows(path)
    found = [match for name in header if (match := _WIDE.fullmatch(name.strip()))]
    if len(found) != len(header):
        raise ValueError("a column that is not called like pt1_cam1_X")
    values = np.array([[_number(cell) for cell in row] for row in rows], dtype=np.float64)
    points, cameras = (list(dict.fromkeys(match[group] for match in found)) for group in ("point", "camera"))
    tracks = np.full((len(cameras), 1, len(values), len(points), 2), np.nan)
    for match, column in zip(found, values.T, strict=True):
        axis = "xy".index(match["axis"].lower())
        tracks[cameras.index(match["camera"]), 0, :, points.index(match["point"]), axis] = column
    views = [View.of_tracks(f"cam{camera}", track, points) for camera, track in zip(cameras, tracks, strict=True)]
    note = "The origin is taken to be the upper left corner of the image; older versions of DLTdv and Argus use the lower left."
    return Recording.of(views, notes=(note,))


def _number(cell: str) -> float:
    return float(cell) if cell.strip() else np.nan
