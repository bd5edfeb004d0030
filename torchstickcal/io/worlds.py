"""Frames of the world that files fix: of known points, and of another calibration."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from torchstickcal.errors import CalibrationError
from torchstickcal.io.results import read_result
from torchstickcal.io.rig import Rig
from torchstickcal.result import Calibration
from torchstickcal.skeletons import point_named
from torchstickcal.untrusted import read_rows, reading
from torchstickcal.world import Frame, frame_of_cameras, frame_of_points

_COLUMNS = ("point", "x", "y", "z")


def world_of_points(path: str | Path) -> Callable[[Calibration], Frame]:
    """The frame of points whose positions a table gives.

    Args:
        path: of a table (.csv) with the columns point, x, y, z (metres), and frame if a point is there in this frame alone,
            such as the ends of a stick on marks. Without a frame the point is at rest.

    Returns:
        A function that finds the frame for a calibration. It raises a CalibrationError if a point is none of the calibration's.

    Raises:
        FileFormatError: if the table is damaged.
        FileNotFoundError: if there is no such file.
    """
    with reading(path, f"a table with the columns {', '.join(_COLUMNS)} and perhaps frame, of positions in metres"):
        header, *rows = read_rows(path)
        column = {name.strip().lower(): place for place, name in enumerate(header)}
        places = [[float(row[column[axis]]) for axis in _COLUMNS[1:]] for row in rows]
        points = [row[column["point"]].strip() for row in rows]
        frames = [row[column["frame"]].strip() if "frame" in column else "" for row in rows]
        numbers = [int(frame) if frame else None for frame in frames]
        known = torch.tensor(places, dtype=torch.float64).reshape(-1, 3)

    def frame(calibration: Calibration) -> Frame:
        found = [_position(calibration, point, number) for point, number in zip(points, numbers, strict=True)]
        return frame_of_points(torch.stack(found) if found else known, known)

    return frame


def world_of_calibration(path: str | Path, unit: str | None = None) -> Callable[[Calibration], Frame]:
    """The frame of another calibration of some of the same cameras, which are matched by name.

    Args:
        path: of the calibration, as of :func:`torchstickcal.io.read_result`.
        unit: of length, where the file does not say it.

    Returns:
        A function that finds the frame for a calibration. It raises a CalibrationError if no camera has the name of another.

    Raises:
        CalibrationError: if it has no poses in a known unit. Others as of :func:`torchstickcal.io.read_result`.
    """
    given = read_result(path)
    rig = given if isinstance(given, Rig) else Rig.of_calibration(given)
    with reading(path, "a calibration with poses in a known unit"):
        known = _named(rig.names, *rig.poses(unit if rig.unit is None else None))
    return lambda calibration: frame_of_cameras(
        _named(calibration.camera_names, calibration.rotations, calibration.translations), known
    )


def _named(names: tuple[str, ...], rotations: Tensor, translations: Tensor) -> dict[str, tuple[Tensor, Tensor]]:
    return dict(zip(names, zip(rotations, translations, strict=True), strict=True))


def _position(calibration: Calibration, point: str, number: int | None) -> Tensor:
    """Where a point is, in a frame of the first camera, or in the middle of all where it is at rest."""
    names = calibration.point_names or tuple(f"point {index}" for index in range(calibration.points.shape[1]))
    name = point_named(point, names)
    if name not in names:
        raise CalibrationError("a known point that was not tracked", where="world", got=point, expected=", ".join(names))
    track = calibration.points[:, names.index(name)].double().cpu()
    if number is None:
        return track.nanmedian(0).values
    own = calibration.frame_index[0]
    if not 0 <= number < len(own) or int(own[number]) < 0:
        expected = f"0 to {len(own) - 1}"
        raise CalibrationError("a frame that is not in the recording", where="world", got=number, expected=expected)
    return track[int(own[number])]
