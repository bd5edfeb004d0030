"""Poses that were computed elsewhere, as one more method: a calibration of any format for each session."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from torchstickcal.benchmark.baselines import Estimate, Inputs, Listing, MissingInputError
from torchstickcal.benchmark.methods import EXTERNAL, Method
from torchstickcal.errors import CalibrationError
from torchstickcal.io import Rig
from torchstickcal.io.lenses import matched
from torchstickcal.io.results import read_result

_POSITION = 45
"""After the methods with a reference in the paper."""


@dataclass(frozen=True)
class ExternalPoses:
    """A folder with a calibration for each session: a file, or a folder, that is called after the session.

    Args:
        name: of the program that computed them.
        folder: where they are.
        unit: of lengths, where the files do not say it; None if they are up to scale then.

    Raises:
        CalibrationError: if there is no such folder.
    """

    name: str
    folder: Path
    unit: str | None = None

    def __post_init__(self) -> None:
        if not self.folder.is_dir():
            raise CalibrationError(
                "no poses from elsewhere", where=f"--external {self.name}", got=str(self.folder), expected="a folder"
            )

    def file_of(self, case: str) -> Path | None:
        """The calibration of a session; None if there is none.

        Raises:
            CalibrationError: if there are several.
        """
        found = [path for path in sorted(self.folder.iterdir()) if case in (path.name, path.stem)]
        if len(found) > 1:
            got = ", ".join(path.name for path in found)
            raise CalibrationError("several calibrations of one session", where=str(self.folder), got=got, expected="one")
        return found[0] if found else None

    def check(self, cases: Sequence[str]) -> bool:
        """Read the calibrations of all sessions; whether some of them are up to scale.

        Raises:
            CalibrationError: if there are none, or if one cannot be read or has no poses.
        """
        rigs = [self._rig(file) for case in cases if (file := self.file_of(case)) is not None]
        if not rigs:
            raise CalibrationError(
                "no calibration of any session",
                where=f"--external {self.name}",
                got=str(self.folder),
                expected=f"files or folders that are called after the sessions, such as {cases[0]}.toml",
            )
        return any(self._up_to_scale(rig) for rig in rigs)

    def __call__(self, inputs: Inputs) -> Estimate:
        """The poses of a session, in the order of its cameras.

        Raises:
            MissingInputError: if there is no calibration of it.
            CalibrationError: if its cameras are not those of the session.
        """
        file = self.file_of(inputs.case)
        if file is None:
            raise MissingInputError(
                "no calibration of this session", where=str(self.folder), got="none", expected=f"one called {inputs.case}"
            )
        rig = self._rig(file)
        order, _ = matched(rig.names, inputs.observations.camera_labels)
        up_to_scale = self._up_to_scale(rig)
        rotations, translations = rig.poses("m" if up_to_scale else self._unit(rig))
        return Estimate(rotations[order], translations[order], "converged", up_to_scale)

    def _rig(self, file: Path) -> Rig:
        """The cameras of a file.

        Raises:
            CalibrationError: if it has no poses.
        """
        found = read_result(file)
        rig = found if isinstance(found, Rig) else Rig.of_calibration(found)
        if rig.rotations is None:
            raise CalibrationError("a calibration without poses", where=str(file), got="intrinsics alone", expected="poses")
        return rig

    def _up_to_scale(self, rig: Rig) -> bool:
        return rig.unit is None and self.unit is None

    def _unit(self, rig: Rig) -> str | None:
        return self.unit if rig.unit is None else None


@contextmanager
def external_methods(externals: Sequence[ExternalPoses], up_to_scale: Mapping[str, bool]) -> Iterator[None]:
    """A block in which poses from elsewhere are methods of the benchmark.

    Args:
        externals: the poses.
        up_to_scale: for each name, whether the size of some rigs is fitted to the truth.
    """
    add_external_methods(externals, up_to_scale)
    try:
        yield
    finally:
        for external in externals:
            del EXTERNAL[external.name]


def add_external_methods(externals: Sequence[ExternalPoses], up_to_scale: Mapping[str, bool]) -> None:
    """Make poses from elsewhere methods of the benchmark in this process, until it ends; arguments as above."""
    for external in externals:
        fitted = "; size fitted to the truth" if up_to_scale[external.name] else ""
        listing = Listing(f"{external.name} (elsewhere{fitted})", {"sota": None}, position=_POSITION)
        EXTERNAL[external.name] = Method(listing, external, timed=False)
