"""What is measured on: sessions with known truth, of a folder of files or of a preset of the simulator."""

from __future__ import annotations

import re
import zlib
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from torchstickcal.errors import CalibrationError, FileFormatError
from torchstickcal.io import Truth, read_session
from torchstickcal.observations import Observations
from torchstickcal.simulate import PRESETS, SPORTS, Cube, CubeViews, SessionSpec, SimulatedSession, preset, read_simulated
from torchstickcal.simulate.rigs import CameraRig
from torchstickcal.simulate.skeleton import STANDING_HEIGHT_M

_SUFFIXES = {".npz", ".pkl"}
_NOISE = re.compile(r"_noise(\d+(?:\.\d+)?)(?:_|$)")


@dataclass(frozen=True, eq=False)
class Case:
    """A session with its truth, and what else is known about it."""

    name: str
    observations: Observations
    truth: Truth
    inliers: NDArray[np.bool_] | None = None
    """(C, F, P), False where a keypoint was drawn with a gross error"""
    sigma_px: NDArray[np.float64] | None = None
    """(C, F, P), standard deviation along each axis that a keypoint was drawn with"""
    cube: CubeViews | None = None
    height_m: float | None = None
    """of the athlete, standing"""

    @property
    def noise_px(self) -> float | None:
        """The noise level of the paper's grid, which the name tells; None outside it."""
        found = _NOISE.search(self.name)
        return float(found[1]) if found else None

    @property
    def regime(self) -> str:
        """What makes the case hard: its noise level in the paper's grid, else what its name begins with, before the sport."""
        if self.noise_px is not None:
            return f"{self.noise_px:g} px"
        positions = [position for sport in SPORTS if (position := self.name.find(f"_{sport}")) >= 0]
        return self.name[: min(positions)].rstrip("0123456789") if positions else "-"

    @property
    def seed(self) -> int:
        """For whatever is drawn for this case; the same in every process."""
        return zlib.crc32(self.name.encode())

    def first(self, frames: int) -> Case:
        """The case cut down to its first frames."""
        given, truth = self.observations, self.truth
        return replace(
            self,
            observations=replace(
                given,
                keypoints=given.keypoints[:, :frames],
                confidence=None if given.confidence is None else given.confidence[:, :frames],
            ),
            truth=truth if truth.points is None else replace(truth, points=truth.points[:frames]),
            inliers=None if self.inliers is None else self.inliers[:, :frames],
            sigma_px=None if self.sigma_px is None else self.sigma_px[:, :frames],
        )


@dataclass(frozen=True)
class Source:
    """Where a case comes from: a file, or a specification to generate it from."""

    name: str
    origin: Path | SessionSpec

    def load(self) -> Case | None:
        """The case; None if the session carries no truth.

        Raises:
            CalibrationError: if it cannot be read.
        """
        if isinstance(self.origin, SessionSpec):
            return _of_simulated(self.origin.generate())
        if self.origin.suffix == ".npz":
            try:
                return replace(_of_simulated(read_simulated(self.origin)), name=self.name)
            except FileFormatError:
                pass
        observations, truth = read_session(self.origin)
        if truth is None:
            return None
        case = Case(self.name, observations, truth)
        return case if self.origin.suffix == ".npz" else _completed(case)


def sources(place: str, count: int | None = None) -> tuple[Source, ...]:
    """The cases of a folder, by name, or of a preset, in its order; the first ``count``, by default all.

    Raises:
        CalibrationError: if there is neither such a folder nor such a preset, or no session in it.
    """
    folder = Path(place)
    if folder.is_dir():
        files = sorted(path for path in folder.iterdir() if path.suffix in _SUFFIXES)
        if not files:
            raise FileFormatError("no sessions", where=place, got="no such file", expected="files .npz or .pkl")
        found = tuple(Source(path.stem, path) for path in files)
    elif place in PRESETS:
        found = tuple(Source(spec.name, spec) for spec in preset(place))
    else:
        expected = f"a folder of sessions, or a preset: {', '.join(PRESETS)}"
        raise CalibrationError("nothing to measure on", where="benchmark", got=repr(place), expected=expected)
    return found[:count]


def _of_simulated(session: SimulatedSession) -> Case:
    return Case(
        session.name,
        session.observations,
        session.truth,
        session.inliers,
        session.sigma_px,
        session.cube,
        session.height_m,
    )


def _completed(case: Case) -> Case:
    """A sequence of Sports-Stick-Syn with what its file leaves out: its noise is Gaussian, its skeleton the simulator's."""
    given, noise = case.observations, case.noise_px
    assert given.image_size is not None
    width, height = given.image_size.expand(given.num_cameras, 2)[0].round().int().tolist()
    rig = CameraRig(
        case.truth.rotations.numpy(),
        case.truth.translations.numpy(),
        given.cameras.matrix.numpy(),
        None,
        (width, height),
    )
    visible = given.visible.numpy()
    return replace(
        case,
        inliers=np.ones_like(visible),
        sigma_px=None if noise is None else np.full(visible.shape, noise),
        cube=None if noise is None else Cube().seen_by(rig, noise, np.random.default_rng(case.seed)),
        height_m=STANDING_HEIGHT_M,
    )
