"""SLEAP: analysis files, an .h5 file for each camera."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from torchstickcal.io.deeplabcut import HDF5
from torchstickcal.io.formats import camera_reader
from torchstickcal.io.recording import View
from torchstickcal.untrusted import open_h5


def _is_analysis(path: Path) -> bool:
    with open_h5(path) as file:
        return "tracks" in file and "node_names" in file


@camera_reader(
    "sleap",
    "SLEAP: an analysis file (.h5) for each camera (needs h5py)",
    recognises=lambda path, head: head.startswith(HDF5) and _is_analysis(path),
)
def read_sleap(path: Path) -> View:
    """Read the tracks of all animals. What has no score counts as seen with certainty."""
    with open_h5(path) as file:
        tracks = np.moveaxis(file.array("tracks"), (0, 3, 2, 1), (0, 1, 2, 3))  # (tracks, 2, nodes, frames)
        scores = np.ones(tracks.shape[:3])
        if "point_scores" in file:
            scores = file.array("point_scores").transpose(0, 2, 1)
            scores = np.where(np.isfinite(scores), scores, 1.0)
        return View.of_tracks(path.stem, np.concatenate([tracks, scores[..., None]], axis=3), file.texts("node_names"))
