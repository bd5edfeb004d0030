"""Datasets of the package movement, which reads files of several trackers itself."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from torchstickcal.io.recording import Recording, View
from torchstickcal.untrusted import reading


def recording_of_movement(datasets: Mapping[str, Any], fps: float | None = None) -> Recording:
    """The recording of some cameras, from a dataset of movement for each of them.

    Args:
        datasets: by the names of the cameras, datasets (``xarray.Dataset``) of poses with ``position`` over time, space,
            keypoints and individuals, in pixels, and ``confidence`` if there is one.
        fps: frames per second; None for the ``fps`` of the first dataset.

    Raises:
        FileFormatError: if one of them is no such dataset, or they do not fit together.

    Example::

        from movement.io import load_poses
        from torchstickcal import Stick
        from torchstickcal.io import Given, complete, recording_of_movement

        cameras = {name: load_poses.from_sleap_file(f"{name}.slp", fps=120) for name in ("left", "right")}
        given = Given(Stick("knob", "barrel", 0.864), intrinsics="Calib.toml")
        observations, notes = complete(recording_of_movement(cameras), given)
    """
    with reading("datasets of movement", "for each camera a dataset with position over time, space, keypoints and individuals"):
        views = [_view(name, dataset) for name, dataset in datasets.items()]
        stated = next((dataset.attrs.get("fps") for dataset in datasets.values()), None) if fps is None else fps
        return Recording.of(views, fps=None if stated is None else float(stated))


def _view(name: str, dataset: Any) -> View:
    position = dataset["position"].transpose("individuals", "time", "keypoints", "space")
    places = np.asarray(position.values, dtype=np.float64)
    if places.ndim != 4 or places.shape[3] != 2:
        raise ValueError(f"positions of camera {name!r} of the shape {places.shape}, not with two coordinates")
    scores = np.ones(places.shape[:3])
    if "confidence" in dataset:
        scores = np.asarray(dataset["confidence"].transpose("individuals", "time", "keypoints").values, dtype=np.float64)
        scores = np.where(np.isnan(scores), 1.0, scores)
    return View.of_tracks(
        name, np.concatenate([places, scores[..., None]], axis=3), [str(n) for n in dataset["keypoints"].values]
    )
