"""DeepLabCut: tables of x, y and likelihood, a .csv or .h5 file for each camera."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchstickcal.io import safe_pickle
from torchstickcal.io.formats import camera_reader
from torchstickcal.io.recording import View, last_number
from torchstickcal.untrusted import H5File, h5_can_be_read, open_h5, read_rows

HDF5 = b"\x89HDF\r\n\x1a\n"
"""The first bytes of an HDF5 file."""
_TABLES = ("df_with_missing", "keypoints")
"""The names under which DeepLabCut saves tables of predictions and of labels."""
_NETWORK = re.compile(r"[-_ ]?DLC[-_]?(?=[A-Z_a-z]).*$")
"""What DeepLabCut adds to the name of a video."""
_SHARED = "single"
"""The individual that stands for points which belong to no animal."""
_Column = Sequence[str]
"""Scorer, individual (not in files of one animal), body part and coordinate."""


@camera_reader(
    "deeplabcut",
    "DeepLabCut: a .csv file for each camera",
    recognises=lambda path, head: re.match(rb"(\xef\xbb\xbf)?scorer[,;\t]", head) is not None,
)
def read_deeplabcut(path: Path) -> View:
    """Read a table with a row for each frame. An image's name in the place of a frame counts by its last number."""
    rows = read_rows(path)
    levels = next(number for number, row in enumerate(rows) if row[0] == "coords") + 1
    names = [row[0] for row in rows[:levels]]
    if names not in (["scorer", "bodyparts", "coords"], ["scorer", "individuals", "bodyparts", "coords"]):
        raise ValueError(f"rows of names called {names}")
    first = next(column for column, name in enumerate(rows[levels - 1]) if name in ("x", "y"))
    columns = list(zip(*(row[first:] for row in rows[:levels]), strict=True))
    values = np.array([[float(cell) if cell else np.nan for cell in row[first:]] for row in rows[levels:]], dtype=np.float64)
    return _view(path, columns, values, [_frame(row[:first]) for row in rows[levels:]])


def _is_table(path: Path) -> bool:
    if not h5_can_be_read():
        return True  # so that the reader says what to install
    with open_h5(path) as file:
        return any(name in file for name in _TABLES)


@camera_reader(
    "deeplabcut-h5",
    "DeepLabCut: a .h5 file for each camera (needs h5py)",
    recognises=lambda path, head: head.startswith(HDF5) and _is_table(path),
)
def read_deeplabcut_h5(path: Path) -> View:
    """Read a table with a row for each frame, as pandas saves it in its formats ``table`` and ``fixed``."""
    with open_h5(path) as file:
        name = next(name for name in _TABLES if name in file)
        if f"{name}/table" in file:
            table = file.array(f"{name}/table")
            columns = safe_pickle.loads(bytes(file.attribute(f"{name}/table", "values_block_0_kind")))
            return _view(path, columns, table["values_block_0"], table["index"].tolist())
        return _view(
            path, _fixed_columns(file, name), file.array(f"{name}/block0_values"), file.array(f"{name}/axis1").tolist()
        )


def camera_name(path: Path) -> str:
    """The name of a video, of the file of its keypoints: without what the program adds.

    Example:
        >>> camera_name(Path("camA_DLC_resnet50_golfMay1shuffle1_100000_filtered.csv")), camera_name(Path("left.csv"))
        ('camA', 'left')
    """
    return _NETWORK.sub("", path.stem) or path.stem


def _fixed_columns(file: H5File, name: str) -> list[_Column]:
    levels = int(file.attribute(name, "axis0_nlevels"))
    return list(
        zip(
            *(
                [file.texts(f"{name}/axis0_level{level}")[code] for code in file.array(f"{name}/axis0_label{level}").tolist()]
                for level in range(levels)
            ),
            strict=True,
        )
    )


def _frame(index: Sequence[str]) -> int:
    """The number of a frame, from the cells before its values: a number, or the parts of an image's path."""
    number = last_number(Path(index[-1]).stem) if index else None
    if number is None:
        raise ValueError(f"a row {list(index)} without the number of a frame")
    return number


def _view(path: Path, columns: Sequence[_Column], values: NDArray[Any], frames: Sequence[int]) -> View:
    """The view of a table (rows, columns)."""
    if values.ndim != 2 or values.shape[1] != len(columns):
        raise ValueError(f"{len(columns)} columns with names, and values of the shape {values.shape}")
    parts = list(dict.fromkeys(column[-2] for column in columns))
    individuals = list(dict.fromkeys(column[1] if len(column) > 3 else "" for column in columns))
    animals = [individual for individual in individuals if individual != _SHARED] or individuals
    tracks = np.full((len(animals), len(values), len(parts), 3), [np.nan, np.nan, 1.0])
    for column, numbers in zip(columns, values.T, strict=True):
        owner = column[1] if len(column) > 3 else ""
        people = [animals.index(owner)] if owner in animals else range(len(animals))
        for person in people:
            tracks[person, :, parts.index(column[-2]), ("x", "y", "likelihood").index(column[-1])] = numbers
    return View.of_tracks(camera_name(path), tracks, parts, frames=frames)
