"""The cases of a benchmark: sessions with known truth, from a folder of files or from a preset of the simulator."""

from __future__ import annotations

import re
import zlib
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from torchstickcal.errors import CalibrationError, FileFormatError
from torchstickcal.io import SESSION_READERS, Truth, find_reader
from torchstickcal.observations import Observations
from torchstickcal.registry import suggestion
from torchstickcal.simulate import (
    PRESETS,
    SPORTS,
    Cube,
    CubeViews,
    SessionSpec,
    SimulatedSession,
    read_simulated,
    session_specs,
)
from torchstickcal.simulate.rigs import CameraRig
from torchstickcal.simulate.skeleton import STANDING_HEIGHT_M

_NOISE = re.compile(r"_noise(\d+(?:\.\d+)?)(?:_|$)")


@dataclass(frozen=True, eq=False)
class Case:
    """A session with its truth and further known values."""

    name: str
    observations: Observations
    truth: Truth
    inliers: NDArray[np.bool_] | None = None
    """(C, F, P), False for outliers"""
    sigma_px: NDArray[np.float64] | None = None
    """(C, F, P), standard deviation of the noise along each image axis, pixels"""
    cube: CubeViews | None = None
    """keypoints of a calibration cube"""
    height_m: float | None = None
    """stature of the athlete, metres"""

    @property
    def noise_px(self) -> float | None:
        """Noise level in pixels, if the name contains one as those of the paper's sequences do (``_noise0.3``); else None."""
        found = _NOISE.search(self.name)
        return float(found[1]) if found else None

    @property
    def regime(self) -> str:
        """The group of the case in the tables: its noise level, else the part of its name before the name of a sport."""
        if self.noise_px is not None:
            return f"{self.noise_px:g} px"
        positions = [position for sport in SPORTS if (position := self.name.find(f"_{sport}")) >= 0]
        return self.name[: min(positions)].rstrip("0123456789") if positions else "-"

    @property
    def seed(self) -> int:
        """Seed of random numbers for this case, the same in every process."""
        return zlib.crc32(self.name.encode())

    def first(self, frames: int) -> Case:
        """The case with only its first frames."""
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
    """Origin of a case: a file, or a specification of a simulated session."""

    name: str
    origin: Path | SessionSpec

    def load(self) -> Case | None:
        """Read or generate the case; None if the session has no truth.

        Raises:
            CalibrationError: if the session cannot be read.
        """
        if isinstance(self.origin, SessionSpec):
            return _of_simulated(self.origin.generate())
        reader = find_reader(self.origin, SESSION_READERS)
        if reader is SESSION_READERS["npz"]:
            try:
                return replace(_of_simulated(read_simulated(self.origin)), name=self.name)
            except FileFormatError:
                pass
        observations, truth = reader.read(self.origin)
        if truth is None:
            return None
        case = Case(self.name, observations, truth)
        return _completed(case) if reader is SESSION_READERS["sports-stick-syn"] else case


def sources(place: str, count: int | None = None) -> tuple[Source, ...]:
    """The cases of a folder, sorted by name, or those of a preset or a sport, in their order.

    Args:
        place: a folder of sessions of any known format, or the name of a preset or a sport. Other files in the folder are
            ignored.
        count: number of cases, from the first one; None for all, and for one session of a sport.

    Raises:
        CalibrationError: if there is no such folder, preset or sport, no session in the folder, or for a count below 1.

    Example:
        >>> from torchstickcal.benchmark import sources
        >>> [source.name for source in sources("hard", 2)]
        ['hard00_golf_hemisphere_cam2', 'hard01_baseball_random_cam2']
    """
    if count is not None and count < 1:
        raise CalibrationError("no sessions to measure", where="count", got=count, expected="1 or more")
    folder = Path(place)
    if folder.is_dir():
        paths = sorted(filter(_is_session, folder.iterdir()))
        if not paths:
            expected = f"sessions of a known format: {', '.join(SESSION_READERS)}"
            raise FileFormatError("no sessions", where=place, got="none in the folder", expected=expected)
        found = tuple(Source(path.stem, path) for path in paths)
    elif place in PRESETS or place in SPORTS:
        found = tuple(Source(spec.name, spec) for spec in session_specs(place, count))
    else:
        known = [*PRESETS, *SPORTS]
        raise CalibrationError(
            "no such folder, preset or sport",
            where="benchmark",
            got=repr(place),
            expected=f"a folder of sessions, or one of {', '.join(known)}",
            remedy=suggestion(place, known),
        )
    return found[:count]


def _is_session(path: Path) -> bool:
    """Whether a file or a folder is a session of a known format, even if it is damaged."""
    try:
        find_reader(path, SESSION_READERS)
    except FileFormatError as error:
        return isinstance(error.__cause__, OSError)  # it cannot be opened: that is reported later
    return True


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
    """A sequence of Sports-Stick-Syn with the values that its file lacks: noise (Gaussian), cube, stature."""
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
