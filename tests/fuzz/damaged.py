"""Damaged files of every kind. A short description of each, which a failing test prints, makes the same file again."""

from __future__ import annotations

import functools
import pickle
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from hypothesis import strategies as st

from fuzz.damage import Damage, any_file, npz, pickles, toml
from fuzz.sessions import Spoiled
from torchstickcal import Calibration, calibrate
from torchstickcal.io import read_calibration, read_session, write_camera_toml, write_npz
from torchstickcal.simulate import SessionSpec, read_simulated, write_simulated


@dataclass(frozen=True)
class Kind:
    """A kind of file: how a whole one is made, how it is read, and what may happen to it."""

    suffix: str
    whole: Callable[[], bytes]
    read: Callable[[Path], object]
    damages: tuple[dict[str, Damage], ...]


@dataclass(frozen=True)
class Damaged:
    """A file, and what was done to it."""

    kind: str
    damages: tuple[str, ...] = ()
    seed: int = 0

    def content(self) -> bytes:
        content, rng = KINDS[self.kind].whole(), np.random.default_rng(self.seed)
        known = {name: damage for damages in KINDS[self.kind].damages for name, damage in damages.items()}
        for name in sorted(self.damages, key=list(known).index):
            content = known[name](content, rng)
        return content


def damaged(kind: str) -> st.SearchStrategy[Damaged]:
    """Files of a kind to which one to three things were done: first to what they say, then to their bytes."""
    names = [name for damages in KINDS[kind].damages for name in damages]
    own = [name for name in names if name not in any_file.DAMAGES]
    chosen = st.one_of(
        st.lists(st.sampled_from(own), min_size=1, max_size=2, unique=True),
        st.lists(st.sampled_from(names), min_size=1, max_size=3, unique=True),
    )
    return st.builds(Damaged, kind=st.just(kind), damages=chosen.map(tuple), seed=st.integers(0, 2**31))


def _written(write: Callable[[Path], object]) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        write(Path(folder, "file"))
        return Path(folder, "file").read_bytes()


@functools.cache
def _calibration() -> Calibration:
    return calibrate(Spoiled().observations())


@functools.cache
def _session() -> bytes:
    return _written(lambda path: write_npz(path, Spoiled().observations()))


@functools.cache
def _simulated() -> bytes:
    spec = SessionSpec("fuzz", "golf", cameras=3, frames=8, fps=5.0)
    return _written(lambda path: write_simulated(path, spec.generate()))


@functools.cache
def _saved() -> bytes:
    return _written(_calibration().save)


@functools.cache
def _cameras() -> bytes:
    return _written(lambda path: write_camera_toml(path, _calibration()))


@functools.cache
def _sequence() -> bytes:
    """A small sequence in the layout of Sports-Stick-Syn."""
    keypoints, cameras, frames = Spoiled().simulated()["keypoints"], 3, 8
    data = {
        "stick_length": 1.2,
        "K": np.array([[1600.0, 0, 600], [0, 1600, 600], [0, 0, 1]]),
        "cameras": [{"name": f"Camera_{number}"} for number in range(cameras)],
        "Rs_gt": np.tile(np.eye(3), (cameras, 1, 1)),
        "ts_gt": np.zeros((cameras, 3, 1)),
        "pose_3d_gt": np.zeros((frames, 19, 3)),
        "stick_3d_gt": np.zeros((frames, 2, 3)),
        "all_pose_projections_2d": keypoints[:, :, :19],
        "all_projection_masks": np.ones((cameras, frames, 19), dtype=bool),
        "all_observed_points_2d": keypoints[:, :, 19:],
    }
    return pickle.dumps(data, protocol=4)


KINDS = {
    "session .npz": Kind(".npz", _session, read_session, (npz.DAMAGES, any_file.DAMAGES)),
    "session .pkl": Kind(
        ".pkl", _sequence, lambda path: read_session(path, "sports-stick-syn"), (pickles.DAMAGES, any_file.DAMAGES)
    ),
    "simulated .npz": Kind(".npz", _simulated, read_simulated, (npz.DAMAGES, any_file.DAMAGES)),
    "calibration .npz": Kind(".npz", _saved, Calibration.load, (npz.DAMAGES, any_file.DAMAGES)),
    "cameras .toml": Kind(".toml", _cameras, read_calibration, (toml.DAMAGES, any_file.DAMAGES)),
}
